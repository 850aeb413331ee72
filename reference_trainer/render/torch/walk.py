"""The walk over the tile lists, the one place where this engine evaluates alphas at pixels.

Tiles with lists of similar length are padded to a block and handed to a formula. Nothing of the size of the
pixel-Gaussian pairs outlives its block: the backward pass evaluates the formula again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.render.constants import BLOCK_PAIRS_CPU, BLOCK_PAIRS_CUDA, MIN_ALPHA, TILE
from reference_trainer.render.splats import Splats, TileLists

__all__ = ["PIXELS", "Block", "blocks", "geometry_rows", "pad_entries", "pixel_offsets", "tile", "untile", "walk"]

PIXELS = TILE * TILE
_ABSENT = -1e4  # binary logarithm of the opacity of padding: its alpha is exactly 0
_HALF = 0.5 * math.log2(math.e)  # exp(-x / 2) = 2^(-_HALF x)

Formula = Callable[["Block", Tensor, Tensor], Tensor]


class Block(NamedTuple):
    """Tiles whose lists are padded to one length.

    Args:
        tiles: tile indices, row by row over the image, shape (T,).
        centers: of the tiles, pixels, shape (2, T, 1).
        gaussians: the Gaussian of every entry, nearest first, shape (T, L); M, the number of Gaussians, marks padding.
    """

    tiles: Tensor
    centers: Tensor
    gaussians: Tensor

    def alphas(self, geometry: Tensor) -> Tensor:
        """Evaluate the alphas at every pixel, (T, 64, L), before the clamp at `MAX_ALPHA`; 0 below `MIN_ALPHA`.

        The geometry is `geometry_rows` of the entries, (6, T, L); differentiable in it.
        """
        x, y, l11, l21, l22, log_opacity = geometry.unbind(0)
        dx, dy = x - self.centers[0], y - self.centers[1]
        # log2 alpha = log2 o - _HALF |factor (pixel - mean)|^2, expanded around the tile's center. Squaring w1 and w2,
        # which are small wherever alpha is not, avoids the cancellation of a dx^2 + 2 b dx dy + c dy^2.
        w1, w2 = l11 * dx + l21 * dy, l22 * dy
        polynomial = [
            log_opacity - _HALF * (w1 * w1 + w2 * w2), 2 * _HALF * (l11 * w1), 2 * _HALF * (l21 * w1 + l22 * w2),
            -_HALF * (l11 * l11), -2 * _HALF * (l11 * l21), -_HALF * (l21 * l21 + l22 * l22),
        ]  # fmt: skip
        x, y = pixel_offsets(geometry)
        exponents = torch.cat([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1) @ torch.stack(polynomial, dim=1)
        return torch.nn.functional.threshold(exponents, math.log2(MIN_ALPHA), -math.inf).exp2()


def pixel_offsets(like: Tensor) -> Tensor:
    """Return x and y of a tile's pixels relative to its center, with the dtype and device of a tensor, (2, 64, 1)."""
    axis = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y]).view(2, PIXELS, 1)


def geometry_rows(splats: Splats) -> Tensor:
    """Return x, y, l11, l21, l22 and the binary logarithm of the opacity of M splats, shape (6, M)."""
    means, factors = splats.projection.means, splats.projection.factors
    opacities = splats.opacities.clamp_min(MIN_ALPHA)  # masked-out splats are in no list: their gradient is 0
    return torch.cat([means.T, factors.T, torch.log2(opacities)[None]])


def blocks(lists: TileLists, device: torch.device) -> Iterator[Block]:
    """Iterate over blocks of all tiles with a non-empty list; a list that is too long gets a block of its own."""
    pairs = BLOCK_PAIRS_CPU if device.type == "cpu" else BLOCK_PAIRS_CUDA
    lengths, tiles = torch.sort(lists.lengths, descending=True, stable=True)
    sizes = lengths.cpu().tolist()
    end = next((i for i, n in enumerate(sizes) if n == 0), len(sizes))
    first = 0
    while first < end:
        last = min(end, first + max(1, pairs // (PIXELS * sizes[first])))
        indices = tiles[first:last]
        place = torch.arange(sizes[first], device=device)
        where = (lists.starts[indices, None] + place).clamp_(max=lists.gaussians.shape[0] - 1)
        gaussians = lists.gaussians[where].long()
        gaussians.masked_fill_(place >= lengths[first:last, None], lists.touched.shape[0])
        corners = torch.stack([indices % lists.columns, indices.div(lists.columns, rounding_mode="floor")])
        yield Block(indices, (corners * TILE + TILE // 2)[..., None], gaussians)
        first = last


def walk(formula: Formula, rows: Tensor, background: Tensor, lists: TileLists, *, extra: int) -> Tensor:
    """Evaluate a formula on every tile's list over a background; differentiable in both.

    Args:
        formula: takes a block, the rows of its entries (R, T, L) and the background of its tiles (T, C, 64); returns
            (T, C + extra, 64), which without any splats is the background, followed by zeros.
        rows: values of every splat, the first six those of `geometry_rows`, shape (R, M).
        background: images, shape (C, H, W).
        lists: the splats of every tile.
        extra: channels of the result, images (C + extra, H, W), beyond those of ``background``.
    """
    result: Tensor = _Walk.apply(formula, rows, background, lists, extra)  # type: ignore[no-untyped-call]
    return result


class _Walk(torch.autograd.Function):
    """Evaluates and differentiates a formula block by block."""

    @staticmethod
    def forward(ctx: Any, formula: Formula, rows: Tensor, background: Tensor, lists: TileLists, extra: int) -> Tensor:
        entries, tiles = pad_entries(rows), tile(background, lists)
        result = torch.nn.functional.pad(tiles, (0, 0, 0, extra))
        ctx.blocks = list(blocks(lists, rows.device))
        for block in ctx.blocks:
            result[block.tiles] = formula(block, entries[:, block.gaussians], tiles[block.tiles])
        ctx.formula, ctx.lists = formula, lists
        ctx.save_for_backward(rows, background)
        return untile(result, lists)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, Tensor, None, None]:
        rows, background = ctx.saved_tensors
        lists: TileLists = ctx.lists
        entries, tiles, upstream = pad_entries(rows), tile(background, lists), tile(gradients[0], lists)
        to_entries, to_tiles = torch.zeros_like(entries), upstream[:, : background.shape[0]].clone()
        for block in ctx.blocks:
            inputs = [x.detach().requires_grad_() for x in (entries[:, block.gaussians], tiles[block.tiles])]
            # A backward() within torch.autocast would otherwise compute these products in 16 bits.
            with torch.enable_grad(), torch.autocast(rows.device.type, enabled=False):
                result = ctx.formula(block, *inputs)
                of_block, of_tiles = torch.autograd.grad(result, inputs, upstream[block.tiles], materialize_grads=True)
            to_entries.index_add_(1, block.gaussians.flatten(), of_block.flatten(1))
            to_tiles[block.tiles] = of_tiles
        return None, to_entries[:, :-1], untile(to_tiles, lists), None, None


def pad_entries(rows: Tensor) -> Tensor:
    """Return rows (R, M) with an invisible splat appended, (R, M + 1)."""
    absent = rows.new_zeros(rows.shape[0], 1)
    absent[5] = _ABSENT
    return torch.cat([rows, absent], dim=1)


def untile(tiles: Tensor, lists: TileLists) -> Tensor:
    """Reorder per-tile pixels of shape (tiles, C, 64) into an image of shape (C, H, W)."""
    grid = tiles.view(lists.rows, lists.columns, -1, TILE, TILE)
    return lists.cut(grid.permute(2, 0, 3, 1, 4).reshape(-1, lists.rows * TILE, lists.columns * TILE))


def tile(image: Tensor, lists: TileLists) -> Tensor:
    """Reorder an image of shape (C, H, W) into per-tile pixels of shape (tiles, C, 64), zero outside the image."""
    grid = lists.padded(image).view(-1, lists.rows, TILE, lists.columns, TILE)
    return grid.permute(1, 3, 0, 2, 4).reshape(lists.rows * lists.columns, -1, PIXELS)
