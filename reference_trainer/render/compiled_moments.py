"""Exact mean and variance in slices of tile lists, each slice by one compiled loop (`moment_rows`).

A slice is the same few places in the lists of all tiles that are so long. Nothing of the size of the pixel-Gaussian
pairs of more than one slice is ever held; of every slice, the backward pass keeps what lies behind it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.compiled import kernel
from reference_trainer.render.constants import SLICE_ENTRIES
from reference_trainer.render.footprints import (
    PIXELS,
    Footprints,
    footprints,
    monomials,
    table_gradient,
    tile,
    untile,
)
from reference_trainer.render.moment_rows import behind_rows, gradient_rows, moment_rows
from reference_trainer.render.precision import without_autocast
from reference_trainer.render.tiles import Block, Chunk, TileLists

__all__ = ["compiled_moments"]

_CHUNK = 1 << 17  # list entries of a chunk of slices: fewer make more calls, more leave the cache


def compiled_moments(
    table: Tensor, values: Tensor, factors: Tensor, behind: Tensor, lists: TileLists
) -> tuple[Tensor, Tensor]:
    """Return mean and variance images (C, H, W) of values composited with random factors; differentiable.

    Args:
        table: geometry of M splats and an absent one (`footprints.pack`), shape (6, M + 1).
        values: what is composited, shape (C, M + 1).
        factors: mean and variance of the factors, shape (2, M + 1), or (2, 1) if all share them.
        behind: what is behind all splats, by tile, shape (tiles, C, 64).
        lists: the splats of every tile, at least two tiles.
    """
    result: tuple[Tensor, Tensor] = _CompiledMoments.apply(  # type: ignore[no-untyped-call]
        table, values, factors, behind, lists
    )
    return result


class _CompiledMoments(torch.autograd.Function):
    """The same as the moments block by block, in the same arguments (`reference_trainer.render.moments`)."""

    @staticmethod
    def forward(
        ctx: Any, table: Tensor, values: Tensor, factors: Tensor, behind: Tensor, lists: TileLists
    ) -> tuple[Tensor, Tensor]:
        means = behind.clone()
        variances = torch.zeros_like(means)
        pixels = monomials(table.dtype, table.device).T.contiguous()
        for chunk in lists.slices(_CHUNK):
            entries = _entries(footprints(table, chunk, lists), values, factors, chunk)
            mean = behind[chunk.tiles].transpose(0, 1).contiguous()
            variance = torch.zeros_like(mean)
            for block in reversed(chunk.blocks):
                kernel(moment_rows, pixels, *entries.of(block), *(_first_tiles(x, block) for x in (mean, variance)))
            means[chunk.tiles], variances[chunk.tiles] = mean.transpose(0, 1), variance.transpose(0, 1)
        ctx.save_for_backward(table, values, factors, behind)
        ctx.lists = lists
        return untile(means, lists), untile(variances, lists)

    @staticmethod
    @without_autocast
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor | None, Tensor, None]:
        table, values, factors, behind = ctx.saved_tensors
        lists: TileLists = ctx.lists
        to_behind, to_variances = (tile(gradient, lists) for gradient in gradients)
        sums = table.new_zeros(6 + values.shape[0] + 2, table.shape[1])
        for chunk in lists.slices(_CHUNK):
            splats = footprints(table, chunk, lists)
            entries = _entries(splats, values, factors, chunk)
            images = (x[chunk.tiles].transpose(0, 1).contiguous() for x in (behind, to_behind, to_variances))
            mean, to_mean, to_variance = images
            result = _chunk_gradients(entries, chunk, mean, to_mean, to_variance)
            to_behind[chunk.tiles] = to_mean.transpose(0, 1)
            to_entries = torch.cat([table_gradient(splats, result[:, :6].T), result[:, 6:].T])
            sums.index_add_(1, chunk.gaussians, to_entries)
        return sums[:6], sums[6:-2], sums[-2:] if ctx.needs_input_grad[2] else None, to_behind, None


class _Entries(NamedTuple):
    """Coefficients (E, 6), values (E, C) and moments of the factor (E, 2) of a chunk's entries."""

    polynomial: Tensor
    values: Tensor
    factors: Tensor

    def of(self, block: Block) -> list[Tensor]:
        """Return a block's part of each, (n, R, K)."""
        return [_part_of(rows, block) for rows in self]


def _entries(splats: Footprints, values: Tensor, factors: Tensor, chunk: Chunk) -> _Entries:
    """Gather the entries of a chunk; the factor's moments (2, 1) may be shared by all."""
    count = chunk.gaussians.shape[0]
    shared = factors.shape[1] == 1
    of_entries = factors.expand(2, count) if shared else factors.index_select(1, chunk.gaussians)
    colors = values.index_select(1, chunk.gaussians)
    return _Entries(_entry_rows(splats), colors.T.contiguous(), of_entries.T.contiguous())


def _chunk_gradients(entries: _Entries, chunk: Chunk, mean: Tensor, to_mean: Tensor, to_variance: Tensor) -> Tensor:
    """Return the gradients of a chunk's entries.

    Args:
        entries: of the chunk.
        chunk: a chunk of slices.
        mean: the colours behind all entries, (C, n, 64); overwritten.
        to_mean: gradient of the means, (C, n, 64); becomes that of the colours behind all entries.
        to_variance: gradient of the variances, (C, n, 64).

    Returns:
        The gradient of the sums of ln alpha times each monomial, of the values, and of m and v, shape (E, 6 + C + 2).
    """
    monomial = monomials(mean.dtype, mean.device)
    pixels = monomial.T.contiguous()
    channels = mean.shape[0]
    hidden = torch.zeros_like(mean[0])
    behind = []
    for block in reversed(chunk.blocks):
        spread, state = _first_tiles(to_variance, block), _first_tiles(mean, block)
        behind.append(([x.clone() for x in state], hidden[block.tiles].clone()))
        kernel(behind_rows, pixels, *entries.of(block), spread, state, hidden[block.tiles])
    front = torch.ones_like(hidden)
    sizes = (1, channels, 2)
    buffer = mean.new_empty(sum(sizes) * SLICE_ENTRIES * hidden.numel())
    result = mean.new_empty(entries.values.shape[0], 6 + channels + 2)
    for block, (state, below) in zip(chunk.blocks, reversed(behind), strict=True):
        count = sum(sizes) * SLICE_ENTRIES
        per_pixel = buffer[: count * block.shape[0] * PIXELS].view(count, block.shape[0], PIXELS)
        to_exponent, to_values, to_factors = torch.split(per_pixel, [SLICE_ENTRIES * size for size in sizes])
        inner = _first_tiles(to_variance, block), state, below, front[block.tiles], _first_tiles(to_mean, block)
        outputs = (list(x.unbind(0)) for x in (to_exponent, to_values, to_factors))
        kernel(gradient_rows, pixels, *entries.of(block), *inner, *outputs)
        rows = _part_of(result, block)
        rows[..., :6] = (to_exponent @ monomial).transpose(0, 1)
        for part, sums in ((rows[..., 6:-2], to_values), (rows[..., -2:], to_factors)):
            part.copy_(sums.sum(-1).view(SLICE_ENTRIES, -1, block.shape[0]).permute(2, 0, 1))
    return result


def _entry_rows(splats: Footprints) -> Tensor:
    """Return the coefficients of a chunk's entries one entry after the other, (E, 6)."""
    return splats.polynomial.T.contiguous()


def _part_of(rows: Tensor, block: Block) -> Tensor:
    """Return a block's part of a chunk's rows (E, K) as a view (n, R, K)."""
    return rows[block.entries].view(*block.shape, rows.shape[1])


def _first_tiles(states: Tensor, block: Block) -> list[Tensor]:
    """Return what a block works on of the states (K, n, 64) of a chunk's pixels."""
    return list(states[:, block.tiles].unbind(0))
