"""Front-to-back alpha compositing of tile lists, with a hand-derived backward pass.

Nothing of the size of the pixel-Gaussian pairs outlives a block: the backward pass evaluates the alphas again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from reference_trainer.render.footprints import (
    PIXELS,
    block_size,
    footprints,
    monomials,
    pack,
    pad,
    table_gradient,
    tile,
    untile,
)
from reference_trainer.render.precision import without_autocast
from reference_trainer.render.running_sums import running_sums_
from reference_trainer.render.tiles import Block, TileLists
from reference_trainer.render.workspace import Workspace

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


def block_alphas(polynomial: Tensor, block: Block, buffers: Sequence[Tensor]) -> BlockAlphas:
    """Evaluate the alphas and blend weights of a block; not differentiable.

    Args:
        polynomial: of the chunk's entries, shape (6, E).
        block: of the chunk.
        buffers: four of shape (T, 64, L), which receive the result.
    """
    raw, weights, transmittance, passed = buffers
    pixels = monomials(polynomial.dtype, polynomial.device).expand(block.shape[0], PIXELS, 6)
    torch.bmm(pixels, block.of(polynomial).transpose(0, 1), out=raw)
    torch.threshold_(raw.exp2_(), MIN_ALPHA, 0.0)
    torch.clamp(raw, max=MAX_ALPHA, out=weights)
    torch.sub(raw.new_ones(()), weights, out=passed)
    torch.cumprod(passed, -1, out=transmittance)
    # A pixel ends at the first splat that would leave too little light: from there on the transmittance counts as 0, so
    # all weights are 0, and in the backward pass so is everything behind.
    torch.threshold_(transmittance, MIN_TRANSMITTANCE, 0.0)
    transmittance.div_(passed)
    return BlockAlphas(raw, weights.mul_(transmittance), transmittance, passed)


class _Composite(torch.autograd.Function):
    """Weighted sums of per-splat values over the splats of every pixel.

    The small factor comes first in every batched product: that is several times faster on a CPU.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, values: Tensor, lists: TileLists) -> Tensor:
        sums = table.new_zeros(lists.lengths.shape[0], values.shape[0], PIXELS)
        for chunk in lists.chunks(block_size(table.device)):
            polynomial = footprints(table, chunk, lists).polynomial
            of_entries = values.index_select(1, chunk.gaussians)
            workspace = Workspace(4, chunk, table)
            parts = sums.new_empty(chunk.tiles.shape[0], *sums.shape[1:])
            for block in chunk.blocks:
                alphas = block_alphas(polynomial, block, workspace.of(block.shape[0], PIXELS, block.shape[1]))
                v = block.of(of_entries).transpose(0, 1)
                torch.bmm(v, alphas.weights.transpose(1, 2), out=parts[block.tiles])
            sums[chunk.tiles] = parts
        ctx.save_for_backward(table, values)
        ctx.lists = lists
        return untile(sums, lists)

    @staticmethod
    @without_autocast
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        table, values = ctx.saved_tensors
        lists: TileLists = ctx.lists
        upstream = tile(gradients[0], lists)
        rows = table.shape[0]
        sums = table.new_zeros(rows + values.shape[0], table.shape[1])
        pixels = monomials(table.dtype, table.device).T
        for chunk in lists.chunks(block_size(table.device)):
            splats = footprints(table, chunk, lists)
            of_entries = values.index_select(1, chunk.gaussians)
            of_tiles = upstream[chunk.tiles]
            to_entries = table.new_empty(rows + values.shape[0], chunk.gaussians.shape[0])
            workspace = Workspace(6, chunk, table)
            for block in chunk.blocks:
                *buffers, along, behind = workspace.of(block.shape[0], PIXELS, block.shape[1])
                alphas = block_alphas(splats.polynomial, block, buffers)
                g, v = of_tiles[block.tiles], block.of(of_entries).transpose(0, 1)
                # Alphas: a splat adds T_i v_i itself and dims by 1 / (1 - alpha_i) the sum of all behind it.
                torch.bmm(g.transpose(1, 2), v, out=along)
                running_sums_(torch.mul(alphas.weights, along, out=behind))
                behind.sub_(behind[..., -1:].clone()).div_(alphas.passed)  # its negative
                along.mul_(alphas.transmittance).add_(behind).mul_(alphas.raw)
                to_block = block.of(to_entries).transpose(0, 1)
                to_block[:, :rows] = torch.bmm(pixels.expand(along.shape[0], rows, PIXELS), along)
                # Values: each splat receives its weight times the pixel's gradient.
                to_block[:, rows:] = torch.bmm(g, alphas.weights)
            to_entries[:rows] = table_gradient(splats, to_entries[:rows])
            sums.index_add_(1, chunk.gaussians, to_entries)
        return sums[:rows], sums[rows:], None


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
    result: Tensor = _Composite.apply(  # type: ignore[no-untyped-call]
        pack(means, factors, opacities), pad(values), lists
    )
    return result
