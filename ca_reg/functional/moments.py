"""Exact mean and variance of pixels whose splats are multiplied by independent random factors.

A pixel is composited back to front by ``C_i = a_i c_i + (1 - a_i) C_{i+1}`` with ``C_{n+1} = b``, the background. A
regularizer replaces ``a_i = alpha_i`` by ``a_i = xi_i alpha_i``, where ``xi_i`` has mean m and variance v and is
independent of everything behind it. Hence, by the law of total variance and per channel,

    mu_i = m alpha_i c_i + (1 - m alpha_i) mu_{i+1}
    V_i  = [(1 - m alpha_i)^2 + v alpha_i^2] V_{i+1} + v alpha_i^2 (c_i - mu_{i+1})^2

with ``mu_{n+1} = b`` and ``V_{n+1} = 0``. ``V_1`` is the limit of the paper's co-adaptation at the pixel for infinitely
many samples. From the front it reads ``sum_i v alpha_i^2 (c_i - mu_{i+1})^2 S_i``, where ``S_i`` is the product of the
brackets of all splats in front: a sum of non-negative terms, one per splat, without the cancellation of a difference of
mean squares.

Limits: the factors must be independent, one per Gaussian (not one per anchor or cluster). The variance is over all
draws, whereas the paper's score takes only pixels that stay covered in every sample. What renderers skip, clamp and
stop at is not modeled; :class:`~ca_reg.functional.Multiplier` says what this changes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ca_reg._check import check_tensor
from ca_reg.functional.multipliers import Multiplier

__all__ = [
    "PixelMoments", "alpha_moments", "contributions", "first_order_variance", "neutral_background", "pixel_moments"
]  # fmt: skip


class PixelMoments(NamedTuple):
    """Mean and variance over the random factors, (..., C) for colors, (...) for the accumulated alpha."""

    mean: Tensor
    variance: Tensor


def pixel_moments(
    alphas: Tensor, colors: Tensor, multiplier: Multiplier, *, background: Tensor | None = None
) -> PixelMoments:
    """Return the exact mean and variance of pixels under a random factor per splat.

    Exact up to rounding, in float32 and float64, and differentiable in every tensor. The variance is the sum of
    :func:`contributions`. In float32, squares of colors above 1e19 overflow.

    Convention: splats are ordered by depth, the nearest first.

    Args:
        alphas: alpha of each splat at the pixel, in [0, 1], shape (..., n). A zero stands for no splat, so lists of
            different lengths are padded with zeros.
        colors: their colors, finite also in the padding, shape (..., n, C), same dtype.
        multiplier: moments of the factor. Tensors in it must broadcast to the shape of ``alphas``.
        background: color behind the last splat, shape (C,) or (..., C); None for zero.

    Example:
        >>> alphas = torch.tensor([0.5, 0.5])
        >>> colors = torch.tensor([[1.0], [0.0]])
        >>> pixel_moments(alphas, colors, Multiplier.dropout(0.5))
        PixelMoments(mean=tensor([0.2500]), variance=tensor([0.0625]))
    """
    mean, shares = _moments(alphas, colors, multiplier, background)
    return PixelMoments(mean, shares.sum(-2))


def contributions(
    alphas: Tensor, colors: Tensor, multiplier: Multiplier, *, background: Tensor | None = None
) -> Tensor:
    """Return what each splat contributes to the variance of the pixel: ``v alpha_i^2 (c_i - mu_{i+1})^2 S_i``.

    They are at least 0 and sum to the variance. The i-th is the variance due to the factor of splat i, given those in
    front, averaged over those behind. Summed over pixels by the index of the Gaussian, they attribute the whole score.

    Arguments are those of :func:`pixel_moments`. Returns shape (..., n, C), 0 in the padding.

    Example:
        >>> alphas, colors = torch.tensor([0.5, 0.5]), torch.tensor([[1.0], [1.0]])
        >>> contributions(alphas, colors, Multiplier.dropout(0.5))[:, 0]
        tensor([0.0352, 0.0391])
    """
    return _moments(alphas, colors, multiplier, background)[1]


def alpha_moments(alphas: Tensor, multiplier: Multiplier) -> PixelMoments:
    """Return the exact mean and variance of the accumulated alpha, as of a pixel of white splats over black.

    Arguments are those of :func:`pixel_moments`. Mean and variance have shape (...).

    Example:
        >>> alpha_moments(torch.tensor([0.5, 0.5]), Multiplier.dropout(0.5)).mean
        tensor(0.4375)
    """
    mean, variance = pixel_moments(alphas, torch.ones_like(alphas)[..., None], multiplier)
    return PixelMoments(mean[..., 0], variance[..., 0])


def neutral_background(alphas: Tensor, colors: Tensor, multiplier: Multiplier) -> Tensor:
    """Return the background ``b`` over which the expected pixel is ``b`` itself.

    Over a fixed background a pixel also varies because dropped splats open holes. Over the expected color a hole shows
    what was expected there, and only disagreement between the colors of the splats counts. From
    ``mu_1 = sum_i w_i c_i + (1 - sum_i w_i) b``, with ``w_i = m alpha_i prod_{j<i} (1 - m alpha_j)``, ``mu_1 = b``
    gives

        b = sum_i w_i c_i / sum_i w_i

    Pass it as ``background``. It is differentiable; detach it to hold it fixed in a penalty.

    Arguments are those of :func:`pixel_moments`; of the multiplier only the mean matters. Returns shape (..., C), 0
    where nothing covers the pixel, whose variance is 0 over any background.

    Example:
        >>> alphas, colors = torch.tensor([0.5, 0.5]), torch.tensor([[1.0], [0.0]])
        >>> b = neutral_background(alphas, colors, Multiplier.dropout(0.5))
        >>> b
        tensor([0.5714])
        >>> pixel_moments(alphas, colors, Multiplier.dropout(0.5), background=b).mean
        tensor([0.5714])
    """
    _check_lists(alphas, colors)
    expected = _per_splat(multiplier.mean, alphas, "mean") * alphas
    weights = expected * _product_in_front(1.0 - expected)
    total = weights.sum(-1, keepdim=True)
    share = weights / torch.where(total > 0, total, 1.0)
    return (share[..., None] * colors).sum(-2)


def first_order_variance(alphas: Tensor, colors: Tensor, multiplier: Multiplier) -> Tensor:
    """Return the paper's closed form ``v sum_i (c_i alpha_i)^2`` (appendix, Eq. ca_final, where v is ``p (1 - p)``).

    An approximation, for comparison with :func:`pixel_moments`. It ignores transmittance, so hidden splats count like
    visible ones, and what lies behind a splat, so its color counts instead of its contrast. It is right over black for
    a single splat and for small accumulated alpha; otherwise mostly too large, the more so the longer the list.

    Arguments are those of :func:`pixel_moments`; of the multiplier only the variance matters. Returns shape (..., C).

    Example:
        >>> alphas, colors = torch.tensor([0.5, 0.5]), torch.tensor([[1.0], [1.0]])
        >>> first_order_variance(alphas, colors, Multiplier.dropout(0.5))
        tensor([0.1250])
    """
    _check_lists(alphas, colors)
    spread = _per_splat(multiplier.variance, alphas, "variance")
    return (spread[..., None] * (colors * alphas[..., None]).square()).sum(-2)


def _moments(
    alphas: Tensor, colors: Tensor, multiplier: Multiplier, background: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Mean (..., C) and contributions to the variance (..., n, C)."""
    _check_lists(alphas, colors)
    expected = _per_splat(multiplier.mean, alphas, "mean") * alphas
    spread = _per_splat(multiplier.variance, alphas, "variance") * alphas.square()
    means = [_background(background, alphas, colors)]
    for weight, color in zip(reversed(expected.unbind(-1)), reversed(colors.unbind(-2)), strict=True):
        # lerp, not a sum of products: equal colors then have exactly zero contrast, without rounding errors.
        means.append(torch.lerp(means[-1], color, weight[..., None]))
    mean = torch.stack(means[::-1], dim=-2)
    weight = spread * _product_in_front((1.0 - expected).square() + spread)
    return mean[..., 0, :], weight[..., None] * (colors - mean[..., 1:, :]).square()


def _product_in_front(factors: Tensor) -> Tensor:
    """Product of the factors of all splats in front of each, shape (..., n)."""
    products = [torch.ones_like(factors.sum(-1))]
    for factor in factors.unbind(-1):  # not cumprod, whose gradient is nondeterministic on CUDA
        products.append(products[-1] * factor)
    return torch.stack(products, dim=-1)[..., : factors.shape[-1]]


def _per_splat(value: float | Tensor, alphas: Tensor, name: str) -> Tensor:
    """Return a moment of the multiplier as a tensor that broadcasts against the alphas."""
    x = value.to(alphas) if isinstance(value, Tensor) else alphas.new_full((), value)
    if x.ndim > alphas.ndim or any(a not in (1, b) for a, b in zip(x.shape[::-1], alphas.shape[::-1], strict=False)):
        raise ValueError(
            f"the {name} of the multiplier must broadcast to the shape of alphas, {tuple(alphas.shape)}, got "
            f"{tuple(x.shape)}; gather moments per Gaussian by the indices of the splats."
        )
    return x


def _background(background: Tensor | None, alphas: Tensor, colors: Tensor) -> Tensor:
    """Return the background per pixel, shape (..., C)."""
    shape = (*alphas.shape[:-1], colors.shape[-1])
    if background is None:
        return colors.new_zeros(shape)
    if not isinstance(background, Tensor) or background.dtype != colors.dtype:
        raise TypeError(f"background must be a tensor of the dtype of colors, {colors.dtype}, or None.")
    if background.shape not in (shape, shape[-1:]):
        raise ValueError(f"background must have shape {shape[-1:]} or {shape}, got {tuple(background.shape)}.")
    check_all_finite(background, "background")
    return background.expand(shape)


def _check_lists(alphas: Tensor, colors: Tensor) -> None:
    """Raise unless alphas and colors are what :func:`pixel_moments` asks for."""
    check_types(alphas, colors)
    check_alphas(alphas)
    if colors.shape[:-1] != alphas.shape:
        raise ValueError(
            f"colors must have the shape of alphas and a last axis of channels, {(*alphas.shape, 'C')}, "
            f"got {tuple(colors.shape)}; expand the colors if the pixels share them."
        )
    check_all_finite(colors, "colors")


def check_all_finite(x: Tensor, name: str) -> None:
    """Raise unless all values are finite, also in the padding: an alpha of 0 does not keep a nan out."""
    # The sum first: it is several times cheaper than checking every value, but may overflow though all are finite.
    if not bool(x.detach().sum().isfinite()) and not bool(x.isfinite().all()):
        raise ValueError(f"{name} must be finite, got nan or infinity.")


def check_types(alphas: Tensor, colors: Tensor) -> None:
    """Raise unless alphas (..., n) and colors are float32 or float64 tensors, both of one."""
    check_tensor(alphas, "alphas", "of shape (..., n)")
    # The 8 or 11 significant bits of the 16-bit dtypes do not survive the products over long lists.
    if alphas.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"alphas must be a floating-point tensor, float32 or float64, got {alphas.dtype}; convert it with .float()."
        )
    if alphas.ndim == 0:
        raise ValueError("alphas must have shape (..., n), got a scalar.")
    check_tensor(colors, "colors", "of shape (..., n, C)")
    if colors.dtype != alphas.dtype:
        raise TypeError(f"colors and alphas must have the same dtype, got {colors.dtype} and {alphas.dtype}.")


def check_alphas(alphas: Tensor) -> None:
    """Raise unless all alphas are in [0, 1]."""
    if not bool(((alphas >= 0) & (alphas <= 1)).all()):
        raise ValueError("alphas must be in [0, 1], got a value outside; pass min(0.99, opacity * falloff).")
