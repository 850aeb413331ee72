"""Exact mean and variance of a rendering under a random factor on every splat's alpha, and their gradients.

The recursion of `ca_reg.functional.pixel_moments` for all pixels of a tile list: back to front,

    V <- [(1 - m alpha)^2 + v alpha^2] V + v alpha^2 (c - mu)^2,        mu <- mu + m alpha (c - mu).

A step handles one splat of each of many tiles, so the splats are the outermost axis here. Every term of V is a square
times a non-negative weight: nothing cancels.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA
from reference_trainer.render.footprints import (
    PIXELS,
    Footprints,
    block_size,
    footprints,
    monomials,
    pack,
    table_gradient,
    tile,
    untile,
)
from reference_trainer.render.renderer import Splats
from reference_trainer.render.tiles import Block, TileLists

__all__ = ["MomentImages", "render_moments"]

_FORWARD_BLOCKS = 4  # blocks this many times larger than in compositing: a step needs many pixels to be worth its call


class MomentImages(NamedTuple):
    """Moments of every pixel over the random factors.

    Args:
        mean: expected colours over the background, shape (3, H, W).
        variance: variances of the colours, shape (3, H, W), at least 0.
        alpha_mean: expected accumulated alpha, shape (H, W).
        alpha_variance: its variance, shape (H, W).
    """

    mean: Tensor
    variance: Tensor
    alpha_mean: Tensor
    alpha_variance: Tensor


def render_moments(splats: Splats, multiplier: Multiplier, *, background: Tensor | None = None) -> MomentImages:
    """Render the exact mean and variance of a view under random factors on the alphas; differentiable.

    The factors are independent per splat. There is no early stop: splats behind an opaque surface shine through its
    dropped ones.

    Args:
        splats: of the full model, with its plain opacities.
        multiplier: moments of the factor, numbers for all Gaussians, or tensors of shape (N,), one value each.
        background: fixed colour behind everything, shape (3,), or one for each pixel, (3, H, W); black by default.

    Returns:
        The moments of colours and accumulated alpha.

    Raises:
        ValueError: if the background has another shape.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> splats = splat(torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 1.0),
        ...                torch.tensor([0.8]), camera, colors=torch.ones(1, 3))
        >>> moments = render_moments(splats, Multiplier.dropout(0.5))
        >>> round(moments.mean[0, 8, 8].item(), 2), round(moments.variance[0, 8, 8].item(), 2)  # 0.5 x 0.8, 0.25 x 0.64
        (0.4, 0.16)
    """
    table = pack(splats.projection.means, splats.projection.factors, splats.opacities)
    factors = torch.stack([_per_splat(x, splats) for x in (multiplier.mean, multiplier.variance)])
    values = torch.cat([splats.colors, torch.ones_like(splats.opacities)[:, None]], dim=1)
    absent = torch.nn.functional.pad
    mean, variance = _Moments.apply(  # type: ignore[no-untyped-call]
        table, absent(values, (0, 0, 0, 1)), absent(factors, (0, 1)), _behind(background, splats), splats.lists
    )
    return MomentImages(mean[:3], variance[:3], mean[3], variance[3])


def _behind(background: Tensor | None, splats: Splats) -> Tensor:
    """Return what lies behind the last splat, colours and an alpha of 0, per tile (tiles, 4, 64)."""
    shape = (3, splats.lists.height, splats.lists.width)
    if background is None:
        background = splats.colors.new_zeros(3)
    if background.shape not in (shape, shape[:1]):
        raise ValueError(f"background must have shape (3,) or {shape}, got {tuple(background.shape)}.")
    image = (background if background.ndim == 3 else background[:, None, None]).to(splats.colors).expand(shape)
    return tile(torch.cat([image, torch.zeros_like(image[:1])]), splats.lists)


def _per_splat(moment: float | Tensor, splats: Splats) -> Tensor:
    """Return a moment of the multiplier for every projected Gaussian, shape (M,)."""
    if isinstance(moment, Tensor):
        return moment[splats.indices].to(splats.opacities)
    return torch.full_like(splats.opacities, moment)


class _Factors(NamedTuple):
    """What a block's recursion needs, (L, T, 64) each; ``values`` is (L, C, T, 1), ``m`` and ``v`` are (L, T, 1)."""

    raw: Tensor
    alpha: Tensor
    m: Tensor
    v: Tensor
    expected: Tensor
    spread: Tensor
    shrink: Tensor
    values: Tensor


def _factors(
    table: Tensor, values: Tensor, factors: Tensor, block: Block, lists: TileLists
) -> tuple[_Factors, Footprints]:
    """Evaluate the alphas of a block and the weights of the recursion."""
    splats = footprints(table, block, lists)
    tiles, longest = block.gaussians.shape
    polynomial = splats.polynomial.permute(2, 0, 1).reshape(-1, 6)
    raw = torch.mm(polynomial, monomials(table.dtype, table.device).T).exp2_().view(longest, tiles, PIXELS)
    torch.threshold_(raw, MIN_ALPHA, 0.0)
    alpha = raw.clamp(max=MAX_ALPHA)
    which = block.gaussians.T.flatten()
    m, v = factors.index_select(1, which).view(2, longest, tiles, 1)
    expected = m * alpha
    spread = v * alpha * alpha
    shrink = torch.addcmul(spread, 1.0 - expected, 1.0 - expected)
    colors = values.index_select(0, which).view(longest, tiles, -1, 1).transpose(1, 2)
    return _Factors(raw, alpha, m, v, expected, spread, shrink, colors), splats


def _walk(f: _Factors, behind: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Run the recursion back to front; before each splat yield mean and variance (C, T, 64) of what is behind it.

    It starts from what is behind all splats, (T, C, 64). The last to be yielded are those of the pixel itself. The
    tensors are overwritten by the next step.
    """
    mean = behind.transpose(0, 1).clone(memory_format=torch.contiguous_format)
    variance = torch.zeros_like(mean)
    for i in reversed(range(f.alpha.shape[0])):
        yield mean, variance
        contrast = f.values[i] - mean
        variance.mul_(f.shrink[i]).addcmul_(contrast * f.spread[i], contrast)
        mean.addcmul_(f.expected[i], contrast)
    yield mean, variance


class _Moments(torch.autograd.Function):
    """Mean and variance images (C, H, W) of values composited with random factors."""

    @staticmethod
    def forward(
        ctx: Any, table: Tensor, values: Tensor, factors: Tensor, behind: Tensor, lists: TileLists
    ) -> tuple[Tensor, Tensor]:
        means = behind.clone()
        variances = torch.zeros_like(means)
        for block in lists.blocks(_FORWARD_BLOCKS * block_size(table.device)):
            f, _ = _factors(table, values, factors, block, lists)
            *_, (mean, variance) = _walk(f, behind[block.tiles])
            means[block.tiles], variances[block.tiles] = mean.transpose(0, 1), variance.transpose(0, 1)
        ctx.save_for_backward(table, values, factors, behind)
        ctx.lists = lists
        return untile(means, lists), untile(variances, lists)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        table, values, factors, behind = ctx.saved_tensors
        lists: TileLists = ctx.lists
        upstream = [tile(gradient, lists) for gradient in gradients]
        sums = table.new_zeros(table.shape[1], 6 + values.shape[1] + 2)
        to_behind = upstream[0].clone()  # of the tiles without splats; the others are overwritten
        for block in lists.blocks(block_size(table.device)):
            f, splats = _factors(table, values, factors, block, lists)
            states = [(mean.clone(), variance.clone()) for mean, variance in _walk(f, behind[block.tiles])]
            to_mean, to_variance = (x[block.tiles].transpose(0, 1).contiguous() for x in upstream)
            longest = f.alpha.shape[0]
            to_alpha = torch.empty_like(f.alpha)
            to_values, to_m, to_v = [], [], []
            # states[k] lies behind splat longest - 1 - k; the last one is the pixel itself.
            for i in range(longest):
                mean, variance = states[longest - 1 - i]
                contrast = f.values[i] - mean
                weighted = to_variance * contrast
                to_contrast = torch.addcmul(to_mean * f.expected[i], weighted, f.spread[i], value=2.0)
                to_expected = (to_mean * contrast).sum(0)
                to_spread = (weighted * contrast).sum(0)
                to_shrink = (to_variance * variance).sum(0)
                # expected = m alpha, spread = v alpha^2, shrink = (1 - m alpha)^2 + v alpha^2
                to_expected = torch.addcmul(to_expected, to_shrink, 1.0 - f.expected[i], value=-2.0)
                to_spread = to_spread + to_shrink
                to_alpha[i] = f.m[i] * to_expected + 2.0 * f.v[i] * f.alpha[i] * to_spread
                to_values.append(to_contrast.sum(-1))
                to_m.append((to_expected * f.alpha[i]).sum(-1))
                to_v.append((to_spread * f.alpha[i].square()).sum(-1))
                to_mean = to_mean - to_contrast
                to_variance = to_variance * f.shrink[i]
            to_behind[block.tiles] = to_mean.transpose(0, 1)
            along = to_alpha.mul_(f.raw).view(-1, PIXELS)
            moments = torch.mm(along, monomials(table.dtype, table.device)).view(longest, -1, 6).permute(1, 2, 0)
            geometry = table_gradient(splats, moments).permute(2, 0, 1)
            to_factors = torch.stack([torch.stack(to_m), torch.stack(to_v)], dim=-1)
            rows = torch.cat([geometry, torch.stack(to_values).transpose(1, 2), to_factors], dim=2)
            sums.index_add_(0, block.gaussians.T.flatten(), rows.flatten(0, 1))
        return sums[:, :6].T, sums[:, 6:-2], sums[:, -2:].T, to_behind, None
