"""Gaussian dropout: in each training step a random subset of the Gaussians is rendered."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg._check import Rate, check_count, check_opacity, check_per_gaussian, check_rates, is_zero, rate_like
from ca_reg._random import draw_numbers

__all__ = ["apply_dropout", "draw_keep_mask", "gaussian_dropout"]


def draw_keep_mask(
    n: int, p: Rate, *, generator: torch.Generator | None = None, device: torch.device | str | None = None
) -> Tensor:
    """Draw which Gaussians stay: each one independently with probability ``1 - p``.

    The uniform numbers behind the mask are float32 whatever the opacities are, so float32 and float64 runs with equal
    seeds drop the same Gaussians.

    Args:
        n: number of Gaussians.
        p: drop rate in [0, 1); a number, or one for each Gaussian, shape (n,).
        generator: source of the draw; the global random state is then untouched. The numbers are drawn on its device,
            so a CPU generator gives the same mask on every device. Not inside a function that
            ``torch.utils.checkpoint`` recomputes: draw outside it.
        device: device of the returned mask; by default where it was drawn.

    Returns:
        True where the Gaussian stays, shape (n,), bool.

    Raises:
        TypeError: if ``n`` is not an integer or ``p`` not a number.
        ValueError: if ``n`` is negative, ``p`` outside [0, 1), or not one number per Gaussian.
        RuntimeError: if the draw with a generator is repeated during ``backward()``.

    Example:
        >>> keep = draw_keep_mask(1000, 0.2, generator=torch.Generator().manual_seed(0))
        >>> keep.dtype, 750 < keep.sum() < 850
        (torch.bool, tensor(True))
    """
    check_count(n, "n", minimum=0)
    check_rates(p)
    uniform = draw_numbers(torch.rand, n, generator, device)
    if isinstance(p, Tensor) and p.ndim:
        check_per_gaussian(p, uniform, "p")
        p = p.to(uniform.device)
    return uniform >= p


def apply_dropout(opacity: Tensor, keep: Tensor, *, p: Rate = 0.0, compensate: bool = False) -> Tensor:
    """Set the opacities of dropped Gaussians to zero (paper, Eq. dropout_train).

    A dropped Gaussian gets an opacity and a gradient of exactly zero. The rasterizer may still report a radius for it:
    zero that as well (``radii * keep``) before density control sees it, or the mean gradients shrink by ``1 - p`` and
    fewer Gaussians are densified.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
        keep: True where the Gaussian stays, shape (N,), bool.
        p: the rate or rates that ``keep`` was drawn with; used only by ``compensate``.
        compensate: multiply the survivors by ``1 / (1 - p)``, so that the mean over masks is ``opacity`` and nothing
            needs to be scaled at test time. Survivors may then exceed 1; they are not clamped here, because every
            3DGS rasterizer clamps the alpha of a splat, at 0.99 or 0.999. Where ``opacity`` exceeds ``0.99 (1 - p)``
            that clamp lowers the mean alpha.

    Returns:
        The masked opacities, a new tensor of the same shape and dtype.

    Raises:
        TypeError: if an argument is not a tensor, ``opacity`` not floating point or ``keep`` not bool.
        ValueError: if the shapes are not as above or ``p`` is outside [0, 1).

    Example:
        >>> opacity, keep = torch.tensor([0.5, 0.8]), torch.tensor([True, False])
        >>> apply_dropout(opacity, keep)
        tensor([0.5000, 0.0000])
        >>> apply_dropout(opacity, keep, p=0.2, compensate=True)
        tensor([0.6250, 0.0000])
    """
    check_opacity(opacity)
    check_per_gaussian(keep, opacity, "keep")
    check_rates(p)
    if keep.dtype != torch.bool:
        raise TypeError(f"keep must be a bool tensor, got {keep.dtype}; compare with a threshold to get a mask.")
    # Not a product: 0 * inf and 0 * nan would put nan where Gaussians are dropped, forward and backward.
    masked = opacity.masked_fill(~keep.view_as(opacity), 0.0)
    return masked * (1.0 / (1.0 - rate_like(p, opacity))) if compensate else masked


def gaussian_dropout(
    opacity: Tensor, p: Rate, *, compensate: bool = False, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor | None]:
    """Draw a mask and apply it: :func:`draw_keep_mask`, then :func:`apply_dropout`.

    Arguments and errors are theirs. Returns the masked opacities and the mask of shape (N,). With ``p = 0`` nothing is
    drawn: returns the very same ``opacity`` and None.

    Example:
        >>> opacity, keep = gaussian_dropout(torch.full((4, 1), 0.5), 0.2)
        >>> opacity.shape, keep.shape
        (torch.Size([4, 1]), torch.Size([4]))
    """
    check_opacity(opacity)
    check_rates(p)
    if is_zero(p):
        return opacity, None
    keep = draw_keep_mask(opacity.shape[0], p, generator=generator, device=opacity.device)
    return apply_dropout(opacity, keep, p=p, compensate=compensate), keep
