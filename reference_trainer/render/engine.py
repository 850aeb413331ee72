"""What an engine is, which ones there are, and which one draws."""

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

ENGINES = ("auto", "torch", "loops")
_VARIABLE = "CA_REG_ENGINE"
_TORCH = TorchEngine()


class Engine(Protocol):
    """Turns Gaussians into pictures, and into the exact moments of pictures.

    All tensors of a call share one dtype and one device, and are checked already (`reference_trainer.render.renderer`,
    `reference_trainer.render.moments`); what comes out is differentiable. Whoever adds an engine lists it in
    `engine_for`.
    """

    name: str

    def project(
        self, inputs: dict[str, Tensor], indices: Tensor, camera: Camera, degree: int | None
    ) -> tuple[Projection, Tensor]:
        """Project M of N Gaussians, the ``indices`` (M,), and evaluate their colors, (M, 3).

        The inputs are means (N, 3), quaternions (N, 4), scales (N, 3), opacities (N,), and either sh (N, K, 3), of
        which the bands up to ``degree`` are used, or colors (N, 3) of no degree, by name.
        """

    def bin(self, projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
        """List the Gaussians of every tile, given their activated opacities (M,).

        A Gaussian belongs to a tile if the ellipse on which its alpha is `MIN_ALPHA` meets the rectangle spanned by the
        tile's pixel centers. The test is exact: within a row of tiles, an ellipse covers an interval of columns.
        """

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Return splats with opacities (M,) that are nowhere higher; those below `MIN_ALPHA` cost nothing."""

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Draw splats front to back over a background (3,): image (3, H, W), alpha (H, W), depth (H, W) if asked."""

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Draw splats with K other opacities, (K, M), as in `masked`: images (K, 3, H, W), alphas; no gradients."""

    def absolute_gradients(self, splats: Splats, drawn: Tensor, gradient: Tensor) -> Tensor:
        """Sum the absolute gradients that pixels give to the positions (AbsGS), (M, 2), without a graph.

        ``drawn`` are colors and depth over black and the accumulated alpha, (5, H, W), and ``gradient`` is that of a
        loss with respect to them.
        """

    def moments(self, splats: Splats, multiplier: Tensor, behind: Tensor) -> MomentImages:
        """Return mean and variance of every pixel under random factors on the alphas of the full model.

        The multiplier is mean and variance of every splat's factor, (M, 2), and ``behind`` the colors behind
        everything, (3, H, W).
        """

    def shares(self, splats: Splats, multiplier: Tensor, behind: Tensor, weights: Tensor) -> Tensor:
        """Return every splat's share of the variance, (M,), float64, for weights of the pixels (H, W)."""


def use_engine(name: str) -> None:
    """Choose the engine of this process and of those that it starts (through the environment, ``CA_REG_ENGINE``).

    Args:
        name: ``torch``, ``loops``, or ``auto``, the default: the loops for float32 on a CPU where numba is installed.

    Raises:
        ValueError: if there is no such engine.
        ImportError: if loops are asked for and numba is missing.

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
    os.environ[_VARIABLE] = name


def chosen_engine() -> str:
    """Return what `use_engine`, or the environment, has chosen; for workers on other machines.

    Raises:
        ValueError: if the environment names an engine that does not exist.
    """
    chosen = os.environ.get(_VARIABLE, "auto")
    if chosen not in ENGINES:
        raise ValueError(f"{_VARIABLE} names the engine {chosen!r}; choose one of {', '.join(ENGINES)}.")
    return chosen


def engine_for(device: torch.device, dtype: torch.dtype = torch.float32) -> Engine:
    """Return the loops for float32 on a CPU unless torch was chosen, which draws the rest; as `chosen_engine`."""
    if chosen_engine() == "torch" or device.type != "cpu" or dtype != torch.float32:
        return _TORCH
    return _loop_engine() or _TORCH


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that draw float32 on a device: "loops" only on a CPU, and where numba works."""
    return ("loops", "torch") if device.type == "cpu" and _loop_engine() is not None else ("torch",)


@contextmanager
def drawn_by(engine: str) -> Iterator[None]:
    """Let an engine draw, and afterwards the one that was chosen before; errors are those of `use_engine`.

    Example:
        >>> with drawn_by("torch"):
        ...     describe_engine("cpu")
        'torch'
    """
    with patch.dict(os.environ):
        use_engine(engine)
        yield


def describe_engine(device: torch.device | str) -> str:
    """Return which engine draws a model (float32) on a device, which need not be there, in words for people."""
    if engine_for(torch.device(device)).name == "torch":
        return "torch"
    count = torch.get_num_threads()
    return f"loops (numba {version('numba')}, {count} thread{'s' if count > 1 else ''})"


@functools.cache
def _loop_engine() -> Engine | None:
    """Return the loops, or None without a numba that works."""
    if importlib.util.find_spec("numba") is None:
        return None
    try:
        from reference_trainer.render.loops.engine import LoopEngine
    except ImportError as error:  # such as of a NumPy that is too new for it
        warnings.warn(f"numba is installed but cannot be imported ({error}): the engine torch draws.", stacklevel=2)
        return None
    return LoopEngine()
