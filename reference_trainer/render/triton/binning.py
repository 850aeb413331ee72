"""Which Gaussian touches which tile of the image, in depth order: one sort by depth, one by tile."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.render.splats import Projected, TileCounts, TileLists
from reference_trainer.render.triton.launching import kernel, launch
from reference_trainer.render.triton.tiles import ENTRIES, SEEN

__all__ = ["bin_gaussians", "count_tiles"]

_MIN_ALPHA = tl.constexpr(MIN_ALPHA)
_BLOCK = 1024  # entries of a program that gathers
_GROUP = 32  # Gaussians of a program that lists, one per lane of a warp,
_LANES = 8  # and columns of tiles that it lists at once: one that covers 10,000 tiles takes 1,250 steps


@triton.jit
def _boundary(dy, side, limit, x, l11, l21, l22):
    """Return the x of the left (side -1) or right (1) boundary of an ellipse, dy below its center."""
    half = tl.sqrt(tl.maximum(limit - (l22 * dy) * (l22 * dy), 0.0))
    return x + (side * half - l21 * dy) / l11


@kernel
def list_tiles(
    order, means, factors, covariances, opacities, counts, ends, touched,
    keys, gaussians, numbers, width, height, columns, listing, TILE: tl.constexpr,
    GROUP: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Count the tiles of Gaussians and add them up, or list them, nearest first, each from ``ends - counts`` on.

    Both by the same machine code: two compilations could contract products and sums differently, and a tile on the
    boundary of an ellipse be counted and not listed. How many Gaussians are in view stands in the numbers, because the
    processor does not know it when they are counted.

    Within a row of tiles, the pixel centers from dy = upper to lower, an ellipse |(l11 dx + l21 dy, l22 dy)|^2 < limit
    reaches furthest to the right at its tip, dy = xy sqrt(limit / xx), or at the end of the row that is nearest to it;
    furthest to the left likewise, at -tip. So a row's tiles are an interval, exactly.
    """
    k = tl.program_id(0) * GROUP + tl.arange(0, GROUP)
    count = tl.load(numbers + SEEN).to(tl.int32)
    if tl.program_id(0) * GROUP >= count:
        return
    real = k < count
    listed = k < count * listing
    i = tl.where(listed, tl.load(order + k, mask=listed, other=0).to(tl.int32), k)  # counted in their own order
    x, y = tl.load(means + 2 * i, mask=real), tl.load(means + 2 * i + 1, mask=real)
    l11, l21 = tl.load(factors + 3 * i, mask=real, other=1.0), tl.load(factors + 3 * i + 1, mask=real, other=0.0)
    l22 = tl.load(factors + 3 * i + 2, mask=real, other=1.0)
    xx, xy = tl.load(covariances + 3 * i, mask=real, other=1.0), tl.load(covariances + 3 * i + 1, mask=real, other=0.0)
    yy = tl.load(covariances + 3 * i + 2, mask=real, other=1.0)
    # alpha = o exp(-d^2 / 2) falls to MIN_ALPHA where d^2 = 2 ln(o / MIN_ALPHA). The center of pixel p is at p + 0.5.
    limit = 2 * tl.maximum(tl.log(tl.load(opacities + i, mask=real, other=1.0) / _MIN_ALPHA), 0.0)
    reach, tip = tl.sqrt(limit * yy), xy * tl.sqrt(limit / xx)
    top = tl.minimum(tl.maximum(tl.ceil(y - reach - 0.5), 0.0), height.to(tl.float32)).to(tl.int32)
    bottom = tl.maximum(tl.minimum(tl.floor(y + reach - 0.5), height.to(tl.float32) - 1), -1.0).to(tl.int32)
    first_row = top // TILE
    # What is not finite, and refused once the numbers are read back, is in no list.
    finite = (tl.abs(x) + tl.abs(y) + reach) < float("inf")
    rows = tl.where(real & finite & (bottom >= top), bottom // TILE - first_row + 1, 0)
    found = tl.zeros([GROUP], tl.int32)
    place = tl.load(ends + k, mask=listed, other=0) - tl.load(counts + i, mask=listed, other=0)
    for r in range(0, tl.max(rows)):
        row = first_row + r
        upper = (row * TILE).to(tl.float32) + 0.5 - y
        lower = tl.minimum(row * TILE + TILE, height).to(tl.float32) - 0.5 - y
        left = _boundary(tl.minimum(tl.maximum(-tip, upper), lower), -1.0, limit, x, l11, l21, l22)
        right = _boundary(tl.minimum(tl.maximum(tip, upper), lower), 1.0, limit, x, l11, l21, l22)
        left = tl.minimum(tl.maximum(tl.ceil(left - 0.5), 0.0), width.to(tl.float32)).to(tl.int32)
        right = tl.maximum(tl.minimum(tl.floor(right - 0.5), width.to(tl.float32) - 1), -1.0).to(tl.int32)
        first = left // TILE
        spanned = tl.where((r < rows) & (right >= left), right // TILE - first + 1, 0)
        if listing != 0:
            for j in range(0, tl.max(spanned), LANES):
                lane = j + tl.arange(0, LANES)
                mask = lane[None, :] < spanned[:, None]
                at = (place + found)[:, None] + lane[None, :]
                tl.store(keys + at, (row * columns + first)[:, None] + lane[None, :], mask=mask)
                tl.store(gaussians + at, i[:, None] + tl.zeros([1, LANES], tl.int32), mask=mask)
        found += spanned
    if listing == 0:
        tl.store(counts + i, found, mask=real)
        tl.store(touched + i, found > 0, mask=real)
        tl.atomic_add(numbers + ENTRIES, tl.sum(found).to(tl.float64), sem="relaxed")


@kernel
def gather_lists(keys, order, gaussians, found, starts, count, tiles, BLOCK: tl.constexpr):
    """Put the Gaussians in the order of the sorted keys, and tell where each tile's begin and the last ends."""
    e = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    i = tl.load(order + e, mask=e < count, other=0)
    tl.store(found + e, tl.load(gaussians + i, mask=e < count, other=0), mask=e < count)
    # Every tile looks for the first key that is not below its own number, among the ``left`` from ``first`` on.
    first, left = 0 * e, tl.where(e <= tiles, count, 0)
    while tl.max(left) > 0:
        half = left // 2
        below = (left > 0) & (tl.load(keys + first + half, mask=left > 0, other=0).to(tl.int32) < e)
        first, left = tl.where(below, first + half + 1, first), tl.where(below, left - half - 1, half)
    tl.store(starts + e, first, mask=e <= tiles)


def _launch(
    listing: bool, order: Tensor, shapes: Sequence[Tensor], counts: TileCounts, ends: Tensor, entries: Sequence[Tensor],
    width: int, height: int,
) -> None:  # fmt: skip
    outputs = counts.each, ends, counts.touched.view(torch.uint8), *entries, counts.numbers
    launch(
        list_tiles, (-(-len(counts.each) // _GROUP),), order, *shapes, *outputs, width, height, -(-width // TILE),
        int(listing), TILE=TILE, GROUP=_GROUP, LANES=_LANES,
    )  # fmt: skip


def _tiles(width: int, height: int) -> int:
    return -(-width // TILE) * -(-height // TILE)


def _key_type(width: int, height: int) -> torch.dtype:
    """Return the type of the number of a tile; signed, as it also holds how many there are."""
    return torch.int16 if _tiles(width, height) < 2**15 else torch.int32


def count_tiles(shapes: Sequence[Tensor], numbers: Tensor, width: int, height: int) -> TileCounts:
    """Count the tiles that each Gaussian touches; their sum goes to the numbers.

    The shapes are means, factors, covariances and opacities, with room for all Gaussians.
    """
    each = numbers.new_empty(len(shapes[0]), dtype=torch.int32)
    counts = TileCounts(each, torch.empty_like(each, dtype=torch.bool), numbers)
    unread = numbers.view(torch.int64)
    _launch(False, unread, shapes, counts, unread, (each.view(_key_type(width, height)), each), width, height)
    return counts


def bin_gaussians(projected: Projected, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile, see `Engine.bin`.

    Listed nearest first, they only need a stable sort by tile: of 16-bit numbers in two passes, where keys of tile and
    depth would take eight. It holds at most 24 bytes per entry, the lists among them.
    """
    _, p, opacities, _, _, counts = projected
    assert counts is not None  # this engine's `project` counts
    order = torch.argsort(p.depths, stable=True)
    ends = torch.cumsum(counts.each[order], 0)
    keys, gaussians = (counts.each.new_empty(counts.total, dtype=x) for x in (_key_type(width, height), torch.int32))
    shapes = [x.detach().contiguous() for x in (p.means, p.factors, p.covariances, opacities)]
    if counts.total:
        _launch(True, order, shapes, counts, ends, (keys, gaussians), width, height)
    keys, by_tile = torch.sort(keys, stable=True)
    tiles, found = _tiles(width, height), torch.empty_like(gaussians)
    starts = found.new_empty(tiles + 1)
    grid = (triton.cdiv(max(counts.total, tiles + 1), _BLOCK),)
    launch(
        gather_lists, grid, keys, by_tile, gaussians, found, starts, counts.total, tiles, warps=4, BLOCK=_BLOCK
    )  # fmt: skip
    return TileLists(width, height, starts, found, counts.touched)
