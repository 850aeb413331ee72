"""Exact mean and variance of a rendering under a random factor on every splat's alpha, and their gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.compiled import is_compiled
from reference_trainer.render.compiled_moments import compiled_moments
from reference_trainer.render.footprints import (
    PIXELS,
    block_size,
    footprints,
    pack,
    pad,
    table_gradient,
    tile,
    untile,
)
from reference_trainer.render.moment_gradients import block_gradients
from reference_trainer.render.precision import without_autocast
from reference_trainer.render.recursion import (
    Entries,
    behind_tiles,
    block_entries,
    chunk_rows,
    contrasts,
    evaluate_terms,
    moment_block_size,
    multiplier_rows,
    parts,
)
from reference_trainer.render.renderer import Splats
from reference_trainer.render.tiles import TileLists
from reference_trainer.render.workspace import Workspace

__all__ = ["MomentImages", "render_moments"]

# Without gradients blocks may be larger than with: they are worked through in slices that fit the cache.
_FORWARD_BLOCKS = 2  # times the pairs of a block with gradients
_SLICE_BLOCKS = 2  # times the pairs of a block of compositing


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
    use_compiled = is_compiled(table.device) and splats.lists.lengths.shape[0] >= 2
    moments = compiled_moments if use_compiled else _Moments.apply
    mean, variance = moments(table, pad(values), multiplier_rows(multiplier, splats), behind, splats.lists)
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
        for chunk in lists.chunks(_FORWARD_BLOCKS * moment_block_size(table.device)):
            polynomial = footprints(table, chunk, lists).polynomial
            v, f = chunk_rows(values, chunk), chunk_rows(factors, chunk)
            for block in chunk.blocks:
                numbers = chunk.tiles[block.tiles]
                mean = behind[numbers].permute(1, 2, 0).contiguous()
                variance = _forward(block_entries(polynomial, v, f, block), mean)
                means[numbers], variances[numbers] = mean.permute(2, 0, 1), variance.permute(2, 0, 1)
        ctx.save_for_backward(table, values, factors, behind)
        ctx.lists = lists
        return untile(means, lists), untile(variances, lists)

    @staticmethod
    @without_autocast
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor | None, Tensor, None]:
        table, values, factors, behind = ctx.saved_tensors
        lists: TileLists = ctx.lists
        upstream = [tile(gradient, lists) for gradient in gradients]
        sums = table.new_zeros(6 + values.shape[0] + 2, table.shape[1])
        to_behind = upstream[0].clone()  # of the tiles without splats; the others are overwritten
        pairs = moment_block_size(table.device)
        for chunk in lists.chunks(pairs):
            splats = footprints(table, chunk, lists)
            v, f = chunk_rows(values, chunk), chunk_rows(factors, chunk)
            to_entries = table.new_zeros(sums.shape[0], chunk.gaussians.shape[0])
            workspace = Workspace(10, chunk, table, pairs=pairs)
            of_channels = Workspace(1, chunk, table, channels=values.shape[0], pairs=pairs)
            for block in chunk.blocks:
                numbers = chunk.tiles[block.tiles]
                mean, to_mean, to_variance = (x[numbers].permute(1, 2, 0).contiguous() for x in (behind, *upstream))
                entries, to_block = block_entries(splats.polynomial, v, f, block), block.of(to_entries).transpose(1, 2)
                block_gradients(
                    entries,
                    (mean, to_mean, to_variance),
                    to_block,
                    (workspace, of_channels),
                    pairs=pairs,
                    factors=ctx.needs_input_grad[2],
                )
                to_behind[numbers] = to_mean.permute(2, 0, 1)
            to_entries[:6] = table_gradient(splats, to_entries[:6])
            sums.index_add_(1, chunk.gaussians, to_entries)
        return sums[:6], sums[6:-2], sums[-2:] if ctx.needs_input_grad[2] else None, to_behind, None


def _forward(entries: Entries, mean: Tensor) -> Tensor:
    """Composite a block back to front, a few splats of all its tiles at a time.

    Args:
        entries: of the block.
        mean: what is behind all splats, (C, 64, T); becomes the mean of the pixels.

    Returns:
        Their variance, shape (C, 64, T).
    """
    longest, tiles = entries.coefficients.shape[0], mean.shape[2]
    rows = min(longest, max(1, _SLICE_BLOCKS * block_size(mean.device) // (PIXELS * tiles)))
    buffers = mean.new_empty(4, rows, PIXELS, tiles)
    variance, contrast, weighted = torch.zeros_like(mean), torch.empty_like(mean), torch.empty_like(mean)
    for first, last in reversed(parts(longest, rows)):
        alpha, *others = buffers[:, : last - first].unbind(0)
        terms = evaluate_terms(entries.part(first, last), (alpha, alpha, *others))
        spread, shrink = terms.spread.unbind(0), terms.shrink.unbind(0)
        for i in contrasts(terms, mean, [contrast] * (last - first)):
            torch.mul(contrast, spread[i], out=weighted)
            variance.mul_(shrink[i]).addcmul_(weighted, contrast)
    return variance
