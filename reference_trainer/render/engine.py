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
from reference_trainer.render.splats import MomentImages, Projection, Splats, TileLists
from reference_trainer.render.torch.engine import TorchEngine

__all__ = [
    "ENGINES",
    "Engine",
    "chosen_engine",
    "describe_engine",
    "engine_for",
    "engines_on",
    "use_engine",
    "using_engine"
]  # fmt: skip

ENGINES = ("auto", "torch", "numba")
_RENAMED = {"loops": "numba"}
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

    def moments(self, splats: Splats, multiplier: Tensor, background: Tensor) -> MomentImages:
        """Return mean and variance of every pixel under random factors on the alphas of the full model.

        ``multiplier`` (M, 2) holds mean and variance of every splat's factor, the background is (3, H, W).
        """

    def shares(self, splats: Splats, multiplier: Tensor, background: Tensor, weights: Tensor) -> Tensor:
        """Return every splat's share of the variance, (M,), float64, for weights of the pixels (H, W)."""


def use_engine(name: str) -> None:
    """Choose the engine of this process and of those that it starts (through the environment, ``CA_REG_ENGINE``).

    Args:
        name: ``torch``, ``numba``, or ``auto``, the default: numba for float32 on a CPU where it is installed.

    Raises:
        ValueError: if there is no such engine.
        ImportError: if numba is asked for and missing.

    Example:
        >>> use_engine("torch")
        >>> describe_engine("cpu")
        'torch'
        >>> use_engine("auto")
    """
    _check_name(name, "there is no engine {name!r}")
    if name == "numba" and _numba_engine() is None:
        raise ImportError("the engine numba needs numba: pip install 'ca_reg[trainer]', or use the engine torch.")
    os.environ[_VARIABLE] = name


def chosen_engine() -> str:
    """Return the engine that `use_engine` or the environment has chosen, to tell workers on other machines.

    Raises:
        ValueError: if the environment names an engine that does not exist.
    """
    chosen = os.environ.get(_VARIABLE, "auto")
    _check_name(chosen, f"{_VARIABLE} names the engine {{name!r}}")
    return chosen


def _check_name(name: str, complaint: str) -> None:
    """Raise a ValueError that begins with the complaint unless there is such an engine."""
    if name not in ENGINES:
        hint = f"it is called {_RENAMED[name]} now" if name in _RENAMED else f"choose one of {', '.join(ENGINES)}"
        raise ValueError(f"{complaint.format(name=name)}; {hint}.")


def engine_for(device: torch.device, dtype: torch.dtype = torch.float32) -> Engine:
    """Return numba for float32 on a CPU, if chosen and available, else torch; errors are `chosen_engine`'s."""
    if chosen_engine() == "torch" or device.type != "cpu" or dtype != torch.float32:
        return _TORCH
    return _numba_engine() or _TORCH


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that draw float32 on a device: "numba" only on a CPU, and where numba works."""
    return ("numba", "torch") if device.type == "cpu" and _numba_engine() is not None else ("torch",)


@contextmanager
def using_engine(engine: str) -> Iterator[None]:
    """Render with an engine within a block; errors are those of `use_engine`.

    Example:
        >>> with using_engine("torch"):
        ...     describe_engine("cpu")
        'torch'
    """
    with patch.dict(os.environ):
        use_engine(engine)
        yield


def describe_engine(device: torch.device | str) -> str:
    """Describe for people which engine draws a model (float32) on a device, which need not be present."""
    if engine_for(torch.device(device)).name == "torch":
        return "torch"
    count = torch.get_num_threads()
    return f"numba ({version('numba')}, {count} thread{'s' if count > 1 else ''})"


@functools.cache
def _numba_engine() -> Engine | None:
    """Return the engine of compiled loops, or None if numba is missing or does not work."""
    if importlib.util.find_spec("numba") is None:
        return None
    try:
        from reference_trainer.render.numba.engine import NumbaEngine
    except ImportError as error:  # such as a NumPy that is too new for it
        warnings.warn(f"numba is installed but cannot be imported ({error}): the engine torch draws.", stacklevel=2)
        return None
    return NumbaEngine()
