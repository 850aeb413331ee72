"""The test-time counterpart of dropout."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import check_opacity, check_rate

__all__ = ["scale_opacity"]


def scale_opacity(opacity: Tensor, p: float) -> Tensor:
    """Scale opacities by ``1 - p``, the mean of dropout at rate ``p`` (paper, strategy C).

    A pixel is linear in the factor of each of its splats, so the image of the scaled opacities *is* the mean image over
    all masks, but for the rasterizer's clamp and cut-off of alpha. Use it once: on a model trained with uncompensated
    dropout, when it is rendered for a test or exported.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
        p: the drop rate of the training, in [0, 1).

    Returns:
        The scaled opacities, same shape and dtype; with ``p = 0`` the very same ``opacity``.

    Raises:
        TypeError: if ``opacity`` is not a floating-point tensor.
        ValueError: if its shape is neither (N,) nor (N, 1), or ``p`` is outside [0, 1).

    Example:
        >>> import torch
        >>> scale_opacity(torch.tensor([0.5, 1.0]), 0.2)
        tensor([0.4000, 0.8000])
    """
    check_opacity(opacity)
    check_rate(p)
    return opacity if p == 0 else opacity * (1.0 - p)
