"""Which Gaussian touches which tile of the image, in depth order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from reference_trainer.render.constants import CHUNK_ENTRIES, MIN_ALPHA, SLICE_ENTRIES, TILE
from reference_trainer.render.projection import Projection

__all__ = ["Block", "Chunk", "TileLists", "bin_gaussians"]


@dataclass(frozen=True)
class Block:
    """Entries that are composited together, as a part of a chunk: equally many of each of some tiles.

    Args:
        tiles: which of the chunk's tiles.
        entries: which of the chunk's entries.
        shape: number of tiles T and of entries of each, L.
    """

    tiles: slice
    entries: slice
    shape: tuple[int, int]

    def of(self, rows: Tensor) -> Tensor:
        """Return the block's part of a chunk's rows (C, E) as a view (C, T, L)."""
        return rows[:, self.entries].view(-1, *self.shape)


@dataclass(frozen=True)
class Chunk:
    """The padded lists of some tiles, one after the other, longest first.

    What depends on an entry alone is computed for a whole chunk at once, what depends on its pixels block by block.

    Args:
        tiles: tile numbers, row by row over the image, shape (n,).
        gaussians: the Gaussian of every entry, nearest first within a tile; the number of Gaussians M is padding,
            shape (E,).
        tile_of: the tile number of every entry, shape (E,).
        blocks: the parts, one after the other: whole lists of tiles of similar length (`TileLists.chunks`), or a few
            entries of all tiles whose lists are so long (`TileLists.slices`).
    """

    tiles: Tensor
    gaussians: Tensor
    tile_of: Tensor
    blocks: list[Block]


@dataclass(frozen=True)
class TileLists:
    """For every tile the Gaussians that can reach `MIN_ALPHA` at one of its pixels, nearest first.

    Args:
        width: image width, pixels.
        height: image height, pixels.
        count: the number of Gaussians M.
        gaussians: their numbers, tile after tile, shape (P,).
        lengths: list length of each tile, shape (tiles,).
        touched: whether a Gaussian is in any list, shape (M,) bool.
    """

    width: int
    height: int
    count: int
    gaussians: Tensor
    lengths: Tensor
    touched: Tensor

    @property
    def columns(self) -> int:
        """Tiles in a row of the image."""
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        """Tiles in a column of the image."""
        return -(-self.height // TILE)

    @cached_property
    def _by_length(self) -> tuple[list[int], Tensor, Tensor]:
        """Return lengths in descending order, the tiles in that order, and where their lists start."""
        lengths, tiles = torch.sort(self.lengths, descending=True, stable=True)
        starts = (self.lengths.cumsum(0) - self.lengths)[tiles]
        return lengths.tolist(), tiles, starts

    def only(self, kept: Tensor) -> TileLists:
        """Return the lists without some Gaussians.

        Args:
            kept: whether a Gaussian stays, shape (M,) bool.
        """
        stays = kept[self.gaussians]
        ends = torch.nn.functional.pad(stays.cumsum(0), (1, 0))[self.lengths.cumsum(0)]
        return replace(
            self,
            gaussians=self.gaussians[stays],
            lengths=ends.diff(prepend=ends.new_zeros(1)),
            touched=self.touched & kept,
        )

    def chunks(self, pairs: int) -> Iterator[Chunk]:
        """Iterate over all tiles with a non-empty list, in blocks of at most ``pairs`` pixel-Gaussian pairs.

        A single tile whose list alone is longer makes a block of its own.
        """
        lengths, tiles, starts = self._by_length
        end = next((i for i, n in enumerate(lengths) if n == 0), len(lengths))
        blocks: list[tuple[int, int]] = []  # first tile and length
        begin = first = entries = 0
        while first < end:
            longest = lengths[first]
            last = min(end, first + max(1, pairs // (TILE * TILE * longest)))
            if entries and entries + (last - first) * longest > CHUNK_ENTRIES:
                yield self._chunk(begin, first, blocks, tiles, starts)
                begin, entries, blocks = first, 0, []
            blocks.append((first, longest))
            entries += (last - first) * longest
            first = last
        if blocks:
            yield self._chunk(begin, end, blocks, tiles, starts)

    def _chunk(self, begin: int, end: int, parts: list[tuple[int, int]], tiles: Tensor, starts: Tensor) -> Chunk:
        """Pad the lists of the tiles from begin to end, in order of length, to the longest of each block."""
        blocks: list[Block] = []
        entry = 0
        for (first, longest), (last, _) in zip(parts, [*parts[1:], (end, 0)], strict=True):
            size = (last - first) * longest
            blocks.append(
                Block(slice(first - begin, last - begin), slice(entry, entry + size), (last - first, longest))
            )
            entry += size
        numbers, starts, lengths = tiles[begin:end], starts[begin:end, None], self.lengths[tiles[begin:end], None]
        position = torch.arange(parts[0][1], device=tiles.device)
        where, tile_of = starts.new_empty(entry), starts.new_empty(entry)
        absent = torch.empty(entry, dtype=torch.bool, device=tiles.device)
        for block in blocks:  # broadcasting, because gathering by entry takes several times longer
            along = position[: block.shape[1]]
            torch.add(starts[block.tiles], along, out=where[block.entries].view(block.shape))
            torch.ge(along, lengths[block.tiles], out=absent[block.entries].view(block.shape))
            tile_of[block.entries].view(block.shape).copy_(numbers[block.tiles, None])
        gaussians = self.gaussians.index_select(0, where.clamp_(max=self.gaussians.shape[0] - 1))
        return Chunk(numbers, gaussians.masked_fill_(absent, self.count), tile_of, blocks)

    def slices(self, entries: int) -> Iterator[Chunk]:
        """Iterate over all tiles with a non-empty list, in blocks of the same `SLICE_ENTRIES` places of their lists.

        The blocks of a chunk go from the nearest entries to the farthest. Every one has at least two tiles (the picture
        must have as many), the second of which may hold nothing but padding.

        Args:
            entries: after so many, padding included, a chunk ends.
        """
        lengths, _, _ = self._by_length
        end = next((i for i, n in enumerate(lengths) if n == 0), len(lengths))
        begin = last = padded = 0
        while last < end:
            padded += -(-lengths[last] // SLICE_ENTRIES) * SLICE_ENTRIES
            last += 1
            if last == end or (padded >= entries and last - begin >= 2 and end - last != 1):
                yield self._slices(begin, max(last, begin + 2))
                begin, padded = last, 0

    def _slices(self, begin: int, end: int) -> Chunk:
        """Pad the lists of the tiles from begin to end, in order of length, and arrange them by place in the list."""
        lengths, tiles, all_starts = self._by_length
        numbers, starts, sizes = (x[begin:end, None] for x in (tiles, all_starts, self.lengths[tiles]))
        blocks: list[Block] = []
        entry, active = 0, end - begin
        for first in range(0, lengths[begin], SLICE_ENTRIES):
            while active > 2 and lengths[begin + active - 1] <= first:
                active -= 1
            count = active * SLICE_ENTRIES
            blocks.append(Block(slice(0, active), slice(entry, entry + count), (active, SLICE_ENTRIES)))
            entry += count
        along = torch.arange(SLICE_ENTRIES, device=tiles.device)
        where, tile_of = starts.new_empty(entry), starts.new_empty(entry)
        absent = torch.empty(entry, dtype=torch.bool, device=tiles.device)
        for place, block in enumerate(blocks):
            position = along + place * SLICE_ENTRIES
            torch.add(starts[block.tiles], position, out=where[block.entries].view(block.shape))
            torch.le(sizes[block.tiles], position, out=absent[block.entries].view(block.shape))
            tile_of[block.entries].view(block.shape).copy_(numbers[block.tiles])
        gaussians = self.gaussians.index_select(0, where.clamp_(max=self.gaussians.shape[0] - 1))
        return Chunk(numbers[:, 0], gaussians.masked_fill_(absent, self.count), tile_of, blocks)


def bin_gaussians(projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile.

    A Gaussian belongs to a tile if the ellipse on which its alpha is `MIN_ALPHA` meets the rectangle spanned by the
    tile's pixel centres. The test is exact: within a strip of tiles, an ellipse covers an interval of columns.

    Args:
        projection: M projected Gaussians.
        opacities: activated, shape (M,).
        width: image width, pixels.
        height: image height, pixels.
    """
    device = opacities.device
    order = torch.argsort(projection.depths, stable=True)
    mean_x, mean_y = projection.means[order].unbind(-1)
    l11, l21, l22 = projection.factors[order].unbind(-1)
    xx, xy, yy = projection.covariances[order].unbind(-1)
    squared_radius = 2.0 * torch.log(opacities[order] / MIN_ALPHA).clamp_(min=0.0)

    reach = torch.sqrt(squared_radius * yy)
    top = torch.ceil(mean_y - reach - 0.5).clamp_(0, height)
    bottom = torch.floor(mean_y + reach - 0.5).clamp_(-1, height - 1)
    first_row = (top / TILE).long()
    rows = torch.where(bottom >= top, (bottom / TILE).floor().long() - first_row + 1, 0)
    entry, row = _expand(first_row, rows)

    y = mean_y[entry]
    upper = row * TILE + 0.5 - y
    lower = torch.clamp(row * TILE + (TILE - 0.5), max=height - 0.5) - y
    tip = (xy * torch.sqrt(squared_radius / xx))[entry]  # the dy at which the ellipse reaches furthest right
    limit, a, b, c, x = squared_radius[entry], l11[entry], l21[entry], l22[entry], mean_x[entry]

    def boundary(dy: Tensor, side: float) -> Tensor:
        half = torch.sqrt((limit - (c * dy) ** 2).clamp_(min=0.0))
        return x + (side * half - b * dy) / a

    left = boundary(torch.minimum(torch.maximum(-tip, upper), lower), -1.0)
    right = boundary(torch.minimum(torch.maximum(tip, upper), lower), 1.0)
    left = torch.ceil(left - 0.5).clamp_(0, width)
    right = torch.floor(right - 0.5).clamp_(-1, width - 1)
    first_column = (left / TILE).long()
    columns = torch.where(right >= left, (right / TILE).floor().long() - first_column + 1, 0)
    strip, column = _expand(first_column, columns)

    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tile = row[strip] * tiles_x + column
    gaussians = order[entry[strip]]
    tile, permutation = torch.sort(tile.int(), stable=True)
    touched = torch.zeros(order.shape[0], dtype=torch.bool, device=device)
    touched[gaussians] = True
    return TileLists(
        width=width,
        height=height,
        count=order.shape[0],
        gaussians=gaussians[permutation],
        lengths=torch.bincount(tile, minlength=tiles_x * tiles_y),
        touched=touched,
    )


def _expand(first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """List the integers first[i] .. first[i] + counts[i] - 1 of every i; return the i and the integer of each."""
    source = torch.repeat_interleave(counts)
    offset = first - (counts.cumsum(0) - counts)
    return source, offset[source] + torch.arange(source.shape[0], device=first.device)
