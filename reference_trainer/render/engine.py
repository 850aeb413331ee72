"""The interface of rendering engines, and the choice of the one that draws."""

from __future__ import annotations

import functools
import importlib.util
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Protocol
from unittest.mock import patch

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.eager.engine import TorchEngine
from reference_trainer.render.splats import MomentImages, Projection, Splats, TileLists

__all__ = [
    "ENGINES", "Engine", "chosen_engine", "describe_engine", "drawn_by", "engine_for", "engines_on", "use_engine"
]  # fmt: skip

ENGINES = ("auto", "torch", "loops", "triton")
_VARIABLE = "CA_REG_ENGINE"
_TORCH = TorchEngine()


class Engine(Protocol):
    """Turns Gaussians into pictures, and into the exact moments of pictures.

    All tensors of a call share one dtype and one device, and have been checked (`reference_trainer.render.renderer`,
    `reference_trainer.render.moments`); results are differentiable unless said otherwise. A new engine is to be added
    to `engine_for`.
    """

    name: str

    def project(
        self, inputs: dict[str, Tensor], indices: Tensor, camera: Camera, degree: int | None
    ) -> tuple[Projection, Tensor]:
        """Project M of N Gaussians, those at ``indices`` (M,), and evaluate their colors, (M, 3).

        The inputs, by name, are means (N, 3), quaternions (N, 4), scales (N, 3), opacities (N,), and either sh
        (N, K, 3), used up to band ``degree``, or colors (N, 3), whose ``degree`` is None.
        """

    def bin(self, projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
        """List the Gaussians of every tile, given their activated opacities (M,).

        A Gaussian belongs to a tile if the ellipse on which its alpha is `MIN_ALPHA` meets the rectangle spanned by the
        tile's pixel centers. The test is exact: within a row of tiles, an ellipse covers an interval of columns.
        """

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Return the splats with other opacities (M,), nowhere higher; those below `MIN_ALPHA` cost nothing."""

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Draw splats front to back over a background (3,): image (3, H, W), alpha (H, W), depth (H, W) if asked."""

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Draw K pictures with opacities (K, M), as in `masked`: images (K, 3, H, W), alphas (K, H, W); no graph."""

    def absolute_gradients(self, splats: Splats, drawn: Tensor, gradient: Tensor) -> Tensor:
        """Sum the absolute values of each pixel's gradient of the projected centers (AbsGS), (M, 2), without a graph.

        ``drawn`` (5, H, W) holds colors and depth over black and the accumulated alpha, and ``gradient`` that of a loss
        with respect to it.
        """

    def moments(self, splats: Splats, multiplier: Tensor, behind: Tensor) -> MomentImages:
        """Return mean and variance of every pixel under random factors on the alphas of the full model.

        ``multiplier`` (M, 2) holds mean and variance of every splat's factor, ``behind`` (3, H, W) the background.
        """

    def shares(self, splats: Splats, multiplier: Tensor, behind: Tensor, weights: Tensor) -> Tensor:
        """Return every splat's share of the variance, (M,), float64, for weights of the pixels (H, W)."""


def use_engine(name: str) -> None:
    """Choose the engine of this process and of those that it starts (through the environment, ``CA_REG_ENGINE``).

    Args:
        name: ``torch``, ``loops``, ``triton``, or ``auto``, the default: for float32 the loops on a CPU where numba is
            installed, and triton on a card where Triton is, which comes with torch there.

    Raises:
        ValueError: if there is no such engine.
        ImportError: if loops are asked for and numba is missing, or triton and Triton.

    Example:
        >>> use_engine("torch")
        >>> describe_engine("cpu")
        'torch'
        >>> use_engine("auto")
    """
    if name not in ENGINES:
        raise ValueError(f"there is no engine {name!r}; choose one of {', '.join(ENGINES)}.")
    if name == "loops" and _loop_engine() is None:
        raise ImportError("the compiled loops need numba: pip install 'ca_reg[trainer]', or use the engine torch.")
    if name == "triton" and _triton_engine() is None:
        raise ImportError("the kernels need Triton: pip install triton (Linux), or use the engine torch.")
    os.environ[_VARIABLE] = name


def chosen_engine() -> str:
    """Return the engine that `use_engine` or the environment has chosen, to tell workers on other machines.

    Raises:
        ValueError: if the environment names an engine that does not exist.
    """
    chosen = os.environ.get(_VARIABLE, "auto")
    if chosen not in ENGINES:
        raise ValueError(f"{_VARIABLE} names the engine {chosen!r}; choose one of {', '.join(ENGINES)}.")
    return chosen


def engine_for(device: torch.device, dtype: torch.dtype = torch.float32) -> Engine:
    """Return the engine that draws: for float32 that of the device, if chosen and available, else torch.

    On a CPU, Triton draws only if chosen and interpreted (``TRITON_INTERPRET=1``). Errors are `chosen_engine`'s.
    """
    chosen = chosen_engine()
    if chosen == "torch" or dtype != torch.float32:
        return _TORCH
    if _runs_triton(device, chosen):
        return _triton_engine() or _TORCH
    return (_loop_engine() if device.type == "cpu" else None) or _TORCH


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that draw float32 on a device: "loops" only on a CPU, "triton" only on a card."""
    if _runs_triton(device, "auto") and _triton_engine() is not None:
        return ("triton", "torch")
    return ("loops", "torch") if device.type == "cpu" and _loop_engine() is not None else ("torch",)


@contextmanager
def drawn_by(engine: str) -> Iterator[None]:
    """Draw with an engine within a block; errors are those of `use_engine`.

    Example:
        >>> with drawn_by("torch"):
        ...     describe_engine("cpu")
        'torch'
    """
    with patch.dict(os.environ):
        use_engine(engine)
        yield


def describe_engine(device: torch.device | str) -> str:
    """Describe for people which engine draws a model (float32) on a device, which need not be present."""
    name = engine_for(torch.device(device)).name
    if name == "torch":
        return name
    if name == "triton":
        return f"triton ({version('triton')}{', interpreted' if torch.device(device).type == 'cpu' else ''})"
    count = torch.get_num_threads()
    return f"loops (numba {version('numba')}, {count} thread{'s' if count > 1 else ''})"


@functools.cache
def _loop_engine() -> Engine | None:
    """Return the loops, or None if numba is missing or does not work."""
    if importlib.util.find_spec("numba") is None:
        return None
    try:
        from reference_trainer.render.loops.engine import LoopEngine
    except ImportError as error:  # such as a NumPy that is too new for it
        warnings.warn(f"numba is installed but cannot be imported ({error}): the engine torch draws.", stacklevel=2)
        return None
    return LoopEngine()


def _runs_triton(device: torch.device, chosen: str) -> bool:
    """Return whether Triton is to draw on a device; of NVIDIA's cards those since Turing, which Triton supports."""
    if device.type == "cpu":
        return chosen == "triton" and os.environ.get("TRITON_INTERPRET") == "1"
    if device.type != "cuda" or chosen == "loops":
        return False
    known = torch.cuda.is_available() and torch.version.hip is None
    return not known or torch.cuda.get_device_capability(device) >= (7, 5)


@functools.cache
def _triton_engine() -> Engine | None:
    """Return the kernels, or None if Triton is missing or does not work."""
    if importlib.util.find_spec("triton") is None:
        return None
    try:
        from reference_trainer.render.triton.engine import TritonEngine
    except ImportError as error:
        warnings.warn(f"triton is installed but cannot be imported ({error}): the engine torch draws.", stacklevel=2)
        return None
    return TritonEngine()
