"""The compositing formulas: the picture, its exact moments, and their first order.

Each takes a `Block`, the rows of its entries and the background of its tiles, and is differentiable. A block has T
tiles of 64 pixels, with L entries each, nearest first.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.render.constants import MAX_ALPHA, MIN_TRANSMITTANCE
from reference_trainer.render.torch.walk import Block

__all__ = ["blend_weights", "composite", "first_order", "moments", "over"]


def _clamped(raw: Tensor) -> Tensor:
    """Clamp alphas at `MAX_ALPHA` and let gradients pass, as the INRIA rasterizer does."""
    return torch.where(raw > MAX_ALPHA, MAX_ALPHA + (raw - raw.detach()), raw)


def _running(x: Tensor, *, product: bool) -> Tensor:
    """Return running products or sums along the last dimension.

    On CUDA `torch.cumsum` has no deterministic algorithm, and raises where one is required. Only there are shifted
    copies combined, log2 L times.
    """
    if x.device.type == "cpu" or not torch.are_deterministic_algorithms_enabled():
        return x.cumprod(-1) if product else x.cumsum(-1)
    step = 1
    while step < x.shape[-1]:
        near, far = x[..., :-step], x[..., step:]
        x = torch.cat([x[..., :step], far * near if product else far + near], dim=-1)
        step *= 2
    return x


class _BlendWeights(torch.autograd.Function):
    """Alpha times transmittance; the hand-derived gradient is twice as fast as that of `torch.cumprod`."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        alpha = raw.clamp(max=MAX_ALPHA)
        passed = 1 - alpha
        behind = _running(passed, product=True)
        # Zero from the first splat on that would leave too little light.
        transmittance = torch.where(behind >= MIN_TRANSMITTANCE, behind / passed, 0.0)
        weights = alpha.mul_(transmittance)
        ctx.save_for_backward(passed, transmittance, weights)
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        passed, transmittance, weights = ctx.saved_tensors
        # A splat adds its own light, and scales all light from behind by 1 - alpha; gradients pass the clamp.
        along = _running(weights * gradients[0], product=False)
        result: Tensor = transmittance * gradients[0] - (along[..., -1:] - along) / passed
        return result


def blend_weights(raw: Tensor) -> Tensor:
    """Return alpha times the transmittance in front of every splat, given alphas before the clamp, (T, 64, L).

    The weights are 0 from the splat on that terminates its pixel.
    """
    weights: Tensor = _BlendWeights.apply(raw)  # type: ignore[no-untyped-call]
    return weights


def composite(block: Block, rows: Tensor, background: Tensor) -> Tensor:
    """Composite C values front to back over a background (T, C, 64); append the accumulated alpha, (T, C + 1, 64).

    The rows are geometry and values of the entries, (6 + C, T, L).
    """
    return over(blend_weights(block.alphas(rows[:6])), rows[6:], background)


def over(weights: Tensor, values: Tensor, background: Tensor) -> Tensor:
    """Blend values over a background; append the accumulated alpha, (T, C + 1, 64).

    Weights are (T, 64, L), values (C, T, L), and the background broadcasts to (T, C, 64).
    """
    alpha = weights.sum(-1)[:, None]
    shown = values.transpose(0, 1) @ weights.transpose(1, 2)
    return torch.cat([shown + (1 - alpha) * background, alpha], dim=1)


def moments(block: Block, rows: Tensor, background: Tensor) -> Tensor:
    """Return mean and variance of C values under random factors, and the expected alpha, (T, 2 C + 1, 64).

    The recursion of `ca_reg.functional.pixel_moments`, back to front: with d the contrast of a splat with the mean of
    what is behind it, the mean grows by m alpha d, and the variance V becomes ((1 - m alpha)^2 + v alpha^2) V
    + v alpha^2 d^2. Every term is a square times a non-negative weight: nothing cancels.

    The rows (9 + C, T, L) are the entries' geometry, mean m and variance v of the random factor, a factor on the
    summand v alpha^2 d^2, whose gradient is the summand's share, and values.
    """
    alpha = _clamped(block.alphas(rows[:6])).permute(2, 0, 1)[:, :, None]
    m, v, factor = rows[6:9].transpose(1, 2)[..., None, None]
    expected, spread = m * alpha, v * alpha.square()
    values = rows[9:].permute(2, 1, 0)[..., None]
    terms = expected, factor * spread, (1 - expected).square() + spread, values
    mean, variance = background, torch.zeros_like(background)
    entries = zip(*(reversed(x.unbind(0)) for x in terms), strict=True)  # indexing would copy all in the backward pass
    for e, s, kept, value in entries:
        contrast = value - mean
        variance = kept * variance + s * contrast.square()
        mean = mean + e * contrast
    return torch.cat([mean, variance, 1 - (1 - expected).prod(0)], dim=1)


def first_order(block: Block, rows: Tensor, background: Tensor) -> Tensor:
    """Return ``sum_i r_i alpha_i^2`` for C values r, (T, C, 64); the background is ignored."""
    return rows[6:].transpose(0, 1) @ _clamped(block.alphas(rows[:6])).square().transpose(1, 2)
