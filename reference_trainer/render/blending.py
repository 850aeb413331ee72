"""Front-to-back alpha compositing of tile lists, with a hand-derived backward pass.

Nothing of the size of the pixel-Gaussian pairs outlives a block: the backward pass evaluates the alphas again.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from reference_trainer.render.footprints import (
    PIXELS,
    Footprints,
    block_size,
    footprints,
    gather,
    monomials,
    pack,
    table_gradient,
    tile,
    untile,
)
from reference_trainer.render.tiles import Block, TileLists

__all__ = ["BlockAlphas", "block_alphas", "composite"]


class BlockAlphas(NamedTuple):
    """The compositing of one block, each of shape (T, 64, L), nearest splat first.

    Args:
        raw: alphas before the clamp at `MAX_ALPHA`; 0 below `MIN_ALPHA`.
        weights: alpha times the transmittance in front of the splat; 0 from the splat on that ends the pixel.
        transmittance: the light left in front of the splat; 0 from the splat on that ends the pixel.
        passed: 1 - alpha.
    """

    raw: Tensor
    weights: Tensor
    transmittance: Tensor
    passed: Tensor


def block_alphas(table: Tensor, block: Block, lists: TileLists) -> tuple[BlockAlphas, Footprints]:
    """Evaluate the alphas and blend weights of a block; not differentiable, work buffers are overwritten."""
    splats = footprints(table, block, lists)
    pixels = monomials(table.dtype, table.device).expand(block.tiles.shape[0], PIXELS, 6)
    raw = torch.bmm(pixels, splats.polynomial).exp2_()
    torch.threshold_(raw, MIN_ALPHA, 0.0)
    alpha = raw.clamp(max=MAX_ALPHA)
    passed = 1.0 - alpha
    transmittance = passed.cumprod(-1)
    # A pixel ends at the first splat that would leave too little light: from there on the transmittance counts as 0, so
    # all weights are 0, and in the backward pass so is everything behind.
    torch.threshold_(transmittance, MIN_TRANSMITTANCE, 0.0)
    transmittance.div_(passed)
    return BlockAlphas(raw, alpha.mul_(transmittance), transmittance, passed), splats


class _Composite(torch.autograd.Function):
    """Weighted sums of per-splat values over the splats of every pixel.

    The small factor comes first in every batched product: that is several times faster on a CPU.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, values: Tensor, lists: TileLists) -> Tensor:
        sums = table.new_zeros(lists.lengths.shape[0], values.shape[1], PIXELS)
        for block in lists.blocks(block_size(table.device)):
            alphas, _ = block_alphas(table, block, lists)
            sums[block.tiles] = torch.bmm(gather(values, block), alphas.weights.transpose(1, 2))
        ctx.save_for_backward(table, values)
        ctx.lists = lists
        return untile(sums, lists)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        table, values = ctx.saved_tensors
        lists: TileLists = ctx.lists
        upstream = tile(gradients[0], lists)
        sums = table.new_zeros(table.shape[1], table.shape[0] + values.shape[1])
        for block in lists.blocks(block_size(table.device)):
            alphas, splats = block_alphas(table, block, lists)
            g, v = upstream[block.tiles], gather(values, block)
            # Alphas: a splat adds T_i v_i itself and dims by 1 / (1 - alpha_i) the sum of all behind it.
            along = torch.bmm(g.transpose(1, 2), v)
            behind = torch.mul(alphas.weights, along).cumsum_(-1)
            behind = torch.sub(behind[..., -1:], behind)
            along.mul_(alphas.transmittance).sub_(behind.div_(alphas.passed)).mul_(alphas.raw)
            pixels = monomials(table.dtype, table.device).T.expand(block.tiles.shape[0], 6, PIXELS)
            geometry = table_gradient(splats, torch.bmm(pixels, along))
            # Values: each splat receives its weight times the pixel's gradient.
            rows = torch.cat([geometry, torch.bmm(g, alphas.weights)], dim=1)
            sums.index_add_(0, block.gaussians.flatten(), rows.transpose(1, 2).flatten(0, 1))
        return sums[:, : table.shape[0]].T, sums[:, table.shape[0] :], None


def composite(means: Tensor, factors: Tensor, opacities: Tensor, values: Tensor, lists: TileLists) -> Tensor:
    """Sum per-splat values over every pixel, weighted by alpha times transmittance.

    The gradient passes through the clamp at `MAX_ALPHA`, as in the INRIA rasterizer.

    Args:
        means: pixel coordinates, shape (M, 2).
        factors: of the inverse covariances, see `Projection`, shape (M, 3).
        opacities: activated, shape (M,).
        values: what to sum, shape (M, C).
        lists: the splats of every tile.

    Returns:
        The sums, shape (C, H, W).
    """
    absent = values.new_zeros(1, values.shape[1])
    result: Tensor = _Composite.apply(  # type: ignore[no-untyped-call]
        pack(means, factors, opacities), torch.cat([values, absent]), lists
    )
    return result
