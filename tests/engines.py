"""The engines that the renderer is tested with, and the one table of how exact each is."""

import os
from typing import NamedTuple

import torch
from stand_ins.card import CARD
from torch import Tensor

from reference_trainer.render.constants import MIN_ALPHA


class Case(NamedTuple):
    """An engine at a precision on a device.

    Args:
        engine: its name.
        dtype: of the tensors.
        device: where they are.
        pixel: largest error of a color, an alpha or a variance of numbers in [0, 1].
        gradient: largest error of a gradient relative to its norm.
        crossing: the share of pixels at which a splat within rounding of the 1/255 cut may fall on its other side;
            there a pixel is off by up to 1/255.
    """

    engine: str
    dtype: torch.dtype
    device: str
    pixel: float
    gradient: float
    crossing: float

    def agrees(self, mine: Tensor, exact: Tensor) -> None:
        """Assert that images (C, H, W) or (H, W) are those of a float64 computation."""
        assert mine.dtype == self.dtype
        error = (mine.detach().double().cpu() - exact).abs().reshape(-1, *exact.shape[-2:]).amax(0)
        assert (error > self.pixel).double().mean() <= self.crossing
        assert error.max() <= max(self.pixel, MIN_ALPHA)

    def same_gradient(self, mine: Tensor, exact: Tensor) -> None:
        """Assert that a gradient is that of a float64 computation."""
        assert mine.dtype == self.dtype
        assert (mine.double().cpu() - exact).norm() <= self.gradient * exact.norm() + 1e-12


CASES = {
    "torch-float64": Case("torch", torch.float64, "cpu", 1e-12, 1e-9, 0.0),
    "torch-float32": Case("torch", torch.float32, "cpu", 2e-4, 1e-3, 0.005),
    "numba-float32": Case("numba", torch.float32, "cpu", 2e-4, 1e-3, 0.005),
}
if os.environ.get("TRITON_INTERPRET") == "1":  # slow, to be asked for: pytest -k triton
    CASES["triton-float32"] = CASES["numba-float32"]._replace(engine="triton")
ON_CARDS = {
    f"torch-{device}-{name}": CASES[f"torch-{name}"]._replace(device=device)
    for device in (CARD, "cuda")
    for name in ("float64", "float32")
}
ON_CARDS["triton-cuda-float32"] = Case("triton", torch.float32, "cuda", 2e-4, 1e-3, 0.005)
