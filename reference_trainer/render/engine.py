"""The choice of the engine that renders."""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.splats import Engine, MomentImages, Projected, Splats
from reference_trainer.render.torch.engine import TorchEngine

__all__ = [
    "ENGINES", "Engine", "chosen_engine", "describe_engine", "engine_for", "engines_on", "use_engine",
    "using_engine",
]  # fmt: skip

ENGINES = ("auto", "torch", "numba", "triton")
_VARIABLE = "CA_REG_ENGINE"
_TORCH = TorchEngine()


def use_engine(name: str) -> None:
    """Choose the engine of this process and, by ``CA_REG_ENGINE``, of those that it starts.

    Args:
        name: ``torch``, ``numba``, ``triton``, or ``auto``, the default: for float32, numba on a CPU
            and triton on a card, where they are installed; Triton comes with torch there.

    Raises:
        ValueError: if there is no such engine.
        ImportError: if numba or triton is asked for and missing, or too old, or without its C compiler.

    Example:
        >>> use_engine("torch")
        >>> describe_engine("cpu")
        'torch'
        >>> use_engine("auto")
    """
    if name not in ENGINES:
        raise ValueError(f"there is no engine {name!r}; choose one of {', '.join(ENGINES)}.")
    if name == "numba" and _compiled_engine("numba") is None:
        raise ImportError("the engine numba needs numba: pip install 'ca_reg[trainer]', or use the engine torch.")
    if name == "triton" and _compiled_engine("triton") is None:
        raise ImportError(
            "the engine triton needs Triton 3.4 or newer, which comes with torch 2.8 for cards (or pip install "
            "'triton>=3.4', Linux), and a C compiler; or use the engine torch."
        )
    os.environ[_VARIABLE] = name


def chosen_engine() -> str:
    """Return the name that was chosen, to tell workers on other machines.

    Raises:
        ValueError: if the environment names an engine that does not exist.
    """
    chosen = os.environ.get(_VARIABLE, "auto")
    if chosen not in ENGINES:
        raise ValueError(f"{_VARIABLE} names the engine {chosen!r}; choose one of {', '.join(ENGINES)}.")
    return chosen


def engine_for(device: torch.device, dtype: torch.dtype = torch.float32) -> Engine:
    """Return the engine for a device and dtype; errors are those of `chosen_engine`.

    On a CPU, Triton renders only if chosen and interpreted (``TRITON_INTERPRET=1``).
    """
    # Loops are compiled for float32 on a CPU, kernels for float32 on a card; whoever asks for
    # anything else gets it, by the other engine.
    chosen = chosen_engine()
    if chosen == "torch" or dtype != torch.float32:
        return _TORCH
    if _runs_triton(device, chosen):
        return _compiled_engine("triton") or _TORCH
    return (_compiled_engine("numba") if device.type == "cpu" else None) or _TORCH


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that render float32 on a device; "numba" only on a CPU, "triton" on a card or interpreted."""
    found = ["triton"] if _runs_triton(device, "triton") and _compiled_engine("triton") is not None else []
    if device.type == "cpu" and _compiled_engine("numba") is not None:
        found.append("numba")
    return (*found, "torch")


@contextmanager
def using_engine(engine: str) -> Iterator[None]:
    """Render with an engine within a block; errors are those of `use_engine`.

    Example:
        >>> with using_engine("torch"):
        ...     describe_engine("cpu")
        'torch'
    """
    # The choice lives in the environment, so that processes started within the block make it too.
    with patch.dict(os.environ):
        use_engine(engine)
        yield


def describe_engine(device: torch.device | str) -> str:
    """Describe for people which engine renders on a device, which need not be present."""
    name = engine_for(torch.device(device)).name
    if name == "torch":
        return name
    version = importlib.import_module(name).__version__  # Triton is distributed by other names too: pytorch-triton-rocm
    if name == "triton":
        return f"triton ({version}{', interpreted' if torch.device(device).type == 'cpu' else ''})"
    count = torch.get_num_threads()
    return f"numba ({version}, {count} thread{'s' if count > 1 else ''})"


class _CompiledEngine:
    """The functions of one package, compiled for float32; see `Engine`.

    Numba's loops give the same bits for any number of threads. The gradients of Triton's kernels are sums by atomics,
    or in one order where PyTorch is asked for deterministic ones.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        projection, binning, compositing, moments = (
            importlib.import_module(f"reference_trainer.render.{name}.{module}")
            for module in ("projection", "binning", "compositing", "moments")
        )
        self._project, self.bin = projection.project, binning.bin_gaussians
        self._composite, self._moments = compositing.composite, moments.moments
        self.composite_masks, self.absolute_gradients = compositing.composite_masks, compositing.absolute_gradients
        self.shares = moments.shares

    def project(
        self, inputs: dict[str, Tensor], camera: Camera, degree: int | None, background: Tensor | None = None
    ) -> Projected:
        """Project the Gaussians; refuse a pose that waits for a gradient, which none of the kernels computes."""
        if torch.is_grad_enabled() and camera.world_to_camera.requires_grad:
            raise NotImplementedError(
                f"the engine {self.name} has no gradient of the camera's pose: use_engine('torch') has, or detach "
                "world_to_camera."
            )
        projected: Projected = self._project(inputs, camera, degree, background)
        return projected

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Keep the lists: what is too faint is skipped."""
        return splats._replace(opacities=opacities)

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Composite splats front to back."""
        p = splats.projection
        image, alpha = self._composite(
            splats, background, depth, p.means, p.factors, splats.opacities, splats.colors, p.depths
        )
        return (image[:3], alpha, image[3]) if depth else (image, alpha, None)

    def moments(self, splats: Splats, multiplier: Tensor, background: Tensor) -> MomentImages:
        """Composite mean and variance back to front."""
        p = splats.projection
        images = self._moments(splats, multiplier, background, p.means, p.factors, splats.opacities, splats.colors)
        return MomentImages(*images)


@functools.cache
def _compiled_engine(name: str) -> Engine | None:
    """Return the engine numba or triton, or None if that package is missing or does not work."""
    if importlib.util.find_spec(name) is None:
        return None
    try:
        if name == "triton":
            _check_compiler()
        return _CompiledEngine(name)
    except ImportError as error:  # such as a NumPy that is too new for numba
        warnings.warn(f"{name} is installed but cannot be used ({error}): the engine torch renders.", stacklevel=2)
        return None


def _check_compiler() -> None:
    """Raise an ImportError where Triton finds no C compiler to build what starts its kernels."""
    # Windows' builds bring one, and the interpreter starts nothing.
    if sys.platform == "win32" or os.environ.get("TRITON_INTERPRET") == "1":
        return
    if "CC" not in os.environ and shutil.which("gcc") is None and shutil.which("clang") is None:
        raise ImportError("it needs a C compiler: install gcc or clang, or name one by CC")


def _runs_triton(device: torch.device, chosen: str) -> bool:
    """Return whether Triton is to render on a device; of NVIDIA's cards those since Turing, which it supports."""
    if device.type == "cpu":
        return chosen == "triton" and os.environ.get("TRITON_INTERPRET") == "1"
    if device.type != "cuda" or chosen == "numba":
        return False
    absent = not torch.cuda.is_available() or (device.index is not None and device.index >= torch.cuda.device_count())
    return absent or torch.version.hip is not None or torch.cuda.get_device_capability(device) >= (7, 5)
