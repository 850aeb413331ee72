"""The public interface of ``fused_ssim``, the loss that trainers in the style of gsplat's import."""

from __future__ import annotations

import importlib.machinery
from types import ModuleType

from torch import Tensor

from reference_trainer.losses.photometric import ssim_map

__all__ = ["similarity_module"]

BORDER = 5  # pixels that the 11 x 11 window reaches beyond its centre


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM of pictures, as `ssim_map` has it; differentiable in the first.

    Args:
        img1: renderings, shape (B, C, H, W).
        img2: photographs, same shape.
        padding: "same" for all pixels, zeros beyond the border; "valid" for those whose window lies in the picture.
        train: not read; gradients are there if they are needed.

    Raises:
        ValueError: if ``padding`` is something else.

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


def similarity_module() -> ModuleType:
    """Make the module ``fused_ssim``."""
    module = ModuleType("fused_ssim", "A stand-in on top of reference_trainer.losses.photometric.")
    module.__spec__ = importlib.machinery.ModuleSpec("fused_ssim", loader=None)
    module.fused_ssim = fused_ssim  # type: ignore[attr-defined]
    return module
