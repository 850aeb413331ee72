"""Exact mean and variance of a rendering under a random factor on every splat's alpha, and their gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.footprints import PIXELS, monomials, pack, table_gradient, tile, untile
from reference_trainer.render.recursion import (
    behind_tiles,
    contrasts,
    evaluate_terms,
    in_front,
    moment_block_size,
    moments_per_splat,
)
from reference_trainer.render.renderer import Splats
from reference_trainer.render.tiles import TileLists

__all__ = ["MomentImages", "render_moments"]


class MomentImages(NamedTuple):
    """Moments of every pixel over the random factors.

    Args:
        mean: expected colours over the background, shape (3, H, W).
        variance: variances of the colours, shape (3, H, W), at least 0.
        alpha_mean: expected accumulated alpha, shape (H, W); None if it was not asked for.
        alpha_variance: its variance, shape (H, W); likewise.
    """

    mean: Tensor
    variance: Tensor
    alpha_mean: Tensor | None
    alpha_variance: Tensor | None


def render_moments(
    splats: Splats, multiplier: Multiplier, *, background: Tensor | None = None, alpha: bool = True
) -> MomentImages:
    """Render the exact mean and variance of a view under random factors on the alphas; differentiable.

    The factors are independent per splat. There is no early stop: splats behind an opaque surface shine through its
    dropped ones.

    Args:
        splats: of the full model, with its plain opacities.
        multiplier: moments of the factor, numbers for all Gaussians, or tensors of shape (N,), one value each.
        background: fixed colour behind everything, shape (3,), or one for each pixel, (3, H, W); black by default.
        alpha: whether to give the moments of the accumulated alpha too; without them it is a fifth faster.

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
    values, behind = splats.colors, behind_tiles(background, splats)
    if alpha:  # one more colour, white over black
        values = torch.nn.functional.pad(values, (0, 1), value=1.0)
        behind = torch.nn.functional.pad(behind, (0, 0, 0, 1))
    absent = torch.nn.functional.pad(values, (0, 0, 0, 1))
    mean, variance = _Moments.apply(  # type: ignore[no-untyped-call]
        table, absent, moments_per_splat(multiplier, splats), behind, splats.lists
    )
    if not alpha:
        return MomentImages(mean, variance, None, None)
    return MomentImages(mean[:3], variance[:3], mean[3], variance[3])


class _Moments(torch.autograd.Function):
    """Mean and variance images (C, H, W) of values composited with random factors."""

    @staticmethod
    def forward(
        ctx: Any, table: Tensor, values: Tensor, factors: Tensor, behind: Tensor, lists: TileLists
    ) -> tuple[Tensor, Tensor]:
        means = behind.clone()
        variances = torch.zeros_like(means)
        for block in lists.blocks(moment_block_size(table.device)):
            terms, _ = evaluate_terms(table, values, factors, block, lists)
            weights = in_front(terms).mul_(terms.spread).unbind(0)
            mean = behind[block.tiles].transpose(0, 1).contiguous()
            variance, contrast, weighted = torch.zeros_like(mean), torch.empty_like(mean), torch.empty_like(mean)
            for i in contrasts(terms, mean, [contrast] * len(weights)):
                torch.mul(contrast, weights[i], out=weighted)
                variance.addcmul_(weighted, contrast)
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
        for block in lists.blocks(moment_block_size(table.device)):
            terms, splats = evaluate_terms(table, values, factors, block, lists)
            longest = terms.alpha.shape[0]
            to_mean, to_variance = (x[block.tiles].transpose(0, 1).contiguous() for x in upstream)
            kept = to_mean.new_empty(longest, *to_mean.shape).unbind(0)
            weighted = torch.empty_like(to_mean)
            # With Q_i the gradient of the weight S_i spread_i of splat i, what is behind it sums up to
            # hidden_i = sum_{j > i} Q_j spread_j S_j / S_{i + 1}: walked back to front, as division would fail at 0.
            to_weight, hidden = torch.empty_like(terms.alpha), torch.zeros_like(terms.alpha)
            weight_rows, hidden_rows = to_weight.unbind(0), hidden.unbind(0)
            spread, shrink = terms.spread.unbind(0), terms.shrink.unbind(0)
            for i in contrasts(terms, behind[block.tiles].transpose(0, 1).contiguous(), kept):
                torch.mul(to_variance, kept[i], out=weighted).mul_(kept[i])
                torch.sum(weighted, 0, out=weight_rows[i])
                if i > 0:
                    torch.mul(hidden_rows[i], shrink[i], out=hidden_rows[i - 1]).addcmul_(weight_rows[i], spread[i])
            front = in_front(terms)
            doubled = torch.mul(front, terms.spread).mul_(2.0).unbind(0)
            to_expected = torch.empty_like(terms.alpha)
            to_values = to_mean.new_empty(longest, *to_mean.shape[:2])
            through = torch.empty_like(to_mean)
            rows = zip(kept, terms.expected.unbind(0), doubled, to_expected.unbind(0), to_values.unbind(0), strict=True)
            for contrast, expected, twice, to_row, to_value in rows:
                torch.mul(to_mean, contrast, out=weighted)
                torch.sum(weighted, 0, out=to_row)
                torch.mul(to_variance, contrast, out=weighted)
                torch.mul(to_mean, expected, out=through).addcmul_(weighted, twice)
                torch.sum(through, -1, out=to_value)
                to_mean.sub_(through)
            to_behind[block.tiles] = to_mean.transpose(0, 1)
            # expected = m alpha, spread = v alpha^2, shrink = (1 - expected)^2 + spread
            to_shrink = hidden.mul_(front)
            to_spread = to_weight.mul_(front).add_(to_shrink)
            to_expected.addcmul_(to_shrink, 1.0 - terms.expected, value=-2.0)
            to_factors = [torch.zeros_like(terms.m[..., 0])] * 2
            if ctx.needs_input_grad[2]:
                to_factors = [(to_expected * terms.alpha).sum(-1), (to_spread * terms.alpha.square()).sum(-1)]
            along = to_spread.mul_(terms.alpha).mul_(2.0 * terms.v).addcmul_(to_expected, terms.m)
            along = along.mul_(terms.raw).view(-1, PIXELS)
            moments = torch.mm(along, monomials(table.dtype, table.device)).view(longest, -1, 6).permute(1, 2, 0)
            geometry = table_gradient(splats, moments).permute(2, 0, 1)
            entries = torch.cat([geometry, to_values.transpose(1, 2), torch.stack(to_factors, dim=-1)], dim=2)
            sums.index_add_(0, block.gaussians.T.flatten(), entries.flatten(0, 1))
        return sums[:, :6].T, sums[:, 6:-2], sums[:, -2:].T, to_behind, None
