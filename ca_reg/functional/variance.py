"""Color variance: how much the colors that make up a pixel differ."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ca_reg._check import check_floating
from ca_reg.result import Reason

__all__ = ["ColorVariance", "color_variance"]


class ColorVariance(NamedTuple):
    """Color variance of an image and of its pixels.

    ``value``, a scalar, is the mean over the covered pixels; without any it is nan, and ``reason`` is ``EMPTY``.
    ``variance``, (...), is the mean over RGB at each pixel, 0 where nothing covers it. ``covered``, (...) bool, is True
    where the weights do not sum to zero.
    """

    value: Tensor
    variance: Tensor
    covered: Tensor
    reason: Reason


def color_variance(weights: Tensor, colors: Tensor) -> ColorVariance:
    """Measure the color variance CV of pixels from the splats that are blended into them (paper, appendix, CV metric).

    Per pixel and channel ``sum_i w_i (c_i - m)^2 / sum_i w_i`` with the weighted mean ``m``: the paper's
    ``E[c^2] - E[c]^2`` without cancellation, since the deviations are squared and not the colors. Differentiable in
    both arguments.

    Convention: the splats may be in any order that both arguments share. The background is not a splat.

    Args:
        weights: blend weights ``w_i = alpha_i T_i``, at least 0, shape (..., n). A zero stands for no splat, so lists
            of different lengths are padded with zeros.
        colors: their colors, shape (..., n, 3).

    Example:
        >>> weights = torch.tensor([[0.5, 0.5], [0.3, 0.0], [0.0, 0.0]])
        >>> colors = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]).expand(3, 2, 3)
        >>> cv = color_variance(weights, colors)
        >>> cv.variance, cv.covered, cv.value
        (tensor([0.2500, 0.0000, 0.0000]), tensor([ True,  True, False]), tensor(0.1250))
    """
    check_floating(weights, "weights", "of shape (..., n)")
    check_floating(colors, "colors", "of shape (..., n, 3)", cast="scale colors to [0, 1]")
    if colors.ndim < 2 or colors.shape[-1] != 3:
        raise ValueError(f"colors must have shape (..., n, 3), RGB last, got {tuple(colors.shape)}.")
    if colors.shape[:-1] != weights.shape:
        raise ValueError(
            f"colors must have the shape of weights and a last axis of 3, {(*weights.shape, 3)}, "
            f"got {tuple(colors.shape)}; expand the colors if the pixels share them."
        )
    if not bool(((weights >= 0) & weights.isfinite()).all()):
        raise ValueError(
            "weights must be finite and at least 0, got one that is negative, NaN or infinite; pass alpha_i T_i of "
            "every splat."
        )

    total = weights.sum(-1)
    covered = total > 0
    share = (weights / torch.where(covered, total, 1.0)[..., None])[..., None]
    mean = (share * colors).sum(-2, keepdim=True)
    variance = (share * (colors - mean).square()).sum(-2).mean(-1)
    # Non-finite colors reach the variance even with a weight of 0, so checking that smaller map first is enough.
    if not bool(variance.isfinite().all()) and not bool(colors.isfinite().all()):
        raise ValueError("colors must be finite, got NaN or infinity.")
    reason = Reason.OK if bool(covered.any()) else Reason.EMPTY
    return ColorVariance(variance[covered].mean(), variance, covered, reason)
