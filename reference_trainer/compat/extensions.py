"""Stand-ins for the small extensions that trainers import: ``simple_knn`` and ``fused_ssim``."""

from __future__ import annotations

from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from torch import Tensor

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.compat.unpacking import names_of_results
from reference_trainer.training.losses.photometric import ssim_map

__all__ = ["distCUDA2", "fused_ssim", "make_module"]

BORDER = 5  # pixels that the 11 x 11 window reaches beyond its center


def make_module(name: str, **members: Any) -> ModuleType:
    """Make a module of these members; one that has ``_C`` is a package."""
    module = ModuleType(name, "A stand-in on top of reference_trainer.")
    module.__spec__ = ModuleSpec(name, loader=None, is_package="_C" in members)
    vars(module).update(members, **{"__path__": []} if "_C" in members else {})
    return module


def distCUDA2(points: Tensor) -> Tensor | tuple[Tensor, Tensor]:
    """Return mean squared distances to the three nearest neighbors, shape (N,).

    Callers that unpack the result, as FSGS and CoR-GS do, also get the indices of the neighbors, (N, 3) int32.
    """
    squares, numbers = nearest_neighbors(points, 3)
    return squares.mean(1) if names_of_results() is None else (squares.mean(1), numbers.int())


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM of pictures (B, C, H, W), as `ssim_map` has it; differentiable in the first.

    ``padding`` is "same" for all pixels, zeros beyond the border, or "valid" for those whose window lies inside;
    ``train`` is ignored. Raises ValueError for another padding.

    Example:
        >>> import torch
        >>> picture = torch.rand(1, 3, 16, 16, dtype=torch.float64)
        >>> round(fused_ssim(picture, picture, padding="valid").item(), 6)
        1.0
    """
    if padding not in ("same", "valid"):
        raise ValueError(f"padding must be 'same' or 'valid', got {padding!r}.")
    similarity = ssim_map(img1.flatten(0, 1), img2.detach().flatten(0, 1))
    return (similarity if padding == "same" else similarity[:, BORDER:-BORDER, BORDER:-BORDER]).mean()
