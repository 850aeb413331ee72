"""What the kernels of a tile share: its pixels, the alphas of its splats at them, and where gradients go.

A program renders one tile, two of its 64 pixels per lane of one warp (one on AMD's wide wavefronts). A warp needs no
shared memory and no barriers, its values fit into registers, and 32 of them share a multiprocessor, which hides the
latency of the loads: all lanes read the same row of the table, one transaction for the whole tile.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA, TILE
from reference_trainer.render.splats import Splats, TileLists
from reference_trainer.render.triton.launching import kernel, launch

__all__ = [
    "ENTRIES", "ROW", "SEEN", "Lists", "add_row", "alpha_at", "fill_table", "geometry_sums", "gradient_rows", "load3",
    "make_row", "make_table", "nvidia_options", "over_tiles", "pixels", "store3", "sum_rows",
]  # fmt: skip

ROW = tl.constexpr(16)
"""Columns of a row of gradients: 64 bytes, so that the sums of an entry leave in one atomic instruction."""

SEEN, ENTRIES = tl.constexpr(18), tl.constexpr(19)
"""Where the numbers of a projection, of which the first 18 are checked, hold how many Gaussians are in view and the sum
of their tiles: all that the processor waits for."""

_FAINT = tl.constexpr(math.log2(MIN_ALPHA))
_HALF = tl.constexpr(0.5 * math.log2(math.e))  # exp(-x / 2) = 2^(-_HALF x)


class Lists(NamedTuple):
    """The splats of every tile, nearest first: the package's own lists, or another rasterizer's.

    Args:
        starts: where each tile's list starts, row by row, and where the last ends, int32, shape (tiles + 1,).
        gaussians: rows of the table, tile after tile, int32, shape (P,).
        width: image width, pixels.
        height: image height, pixels.
        tile: side of a tile, pixels, a power of two.
        max_alpha: where alphas are clamped.
    """

    starts: Tensor
    gaussians: Tensor
    width: int
    height: int
    tile: int = TILE
    max_alpha: float = MAX_ALPHA

    @classmethod
    def of(cls, lists: TileLists) -> Lists:
        """Return the package's own lists; those of another engine have other integers."""
        return cls(lists.starts.int(), lists.gaussians.int(), lists.width, lists.height)

    @property
    def tiles(self) -> int:
        """The number of tiles."""
        return -(-self.width // self.tile) * -(-self.height // self.tile)


def nvidia_options(warps: int) -> dict[str, int]:
    """Return what the kernels of a tile are compiled with on NVIDIA's cards.

    Many warps may take 64 registers: left to itself, the assembler gives eight 48 on Ampere's and Ada's smaller cards,
    and spills.
    """
    return {"maxnreg": 64} if warps > 4 else {}


def over_tiles(
    function: Any, lists: Lists, table: Tensor, *arguments: Any, programs: int = 0, per_warp: int = 64, **constants: Any
) -> None:
    """Start a program for every tile, or as many as told; a warp has 64 pixels, or as many as told."""
    warps = max(1, lists.tile**2 // per_warp)
    if torch.version.hip is None:
        constants |= nvidia_options(warps)
    size = lists.width, lists.height, -(-lists.width // lists.tile)
    launch(
        function, (programs or lists.tiles,), table, lists.starts, lists.gaussians, *arguments, *size,
        warps=warps, STRIDE=table.shape[1], TILE=lists.tile, **constants,
    )  # fmt: skip


@kernel
def fill_table(
    means, factors, opacities, colors, more, table, count, MORE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Put what the kernels of a tile read of a splat into one row: see `make_table`."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = i < count
    row = table + i * (9 + MORE)
    for j in tl.static_range(2):
        tl.store(row + j, tl.load(means + 2 * i + j, mask=real), mask=real)
    for j in tl.static_range(3):
        tl.store(row + 2 + j, tl.load(factors + 3 * i + j, mask=real), mask=real)
        tl.store(row + 6 + j, tl.load(colors + 3 * i + j, mask=real), mask=real)
    # Far below `MIN_ALPHA`, but not 0, which has no logarithm.
    opacity = tl.maximum(tl.load(opacities + i, mask=real, other=1.0), 1e-30)
    tl.store(row + 5, tl.log2(opacity), mask=real)
    for j in tl.static_range(MORE):
        tl.store(row + 9 + j, tl.load(more + MORE * i + j, mask=real), mask=real)


def make_table(splats: Splats, more: Tensor | None = None) -> Tensor:
    """Return x, y, l11, l21, l22, log2 of the opacity, red, green, blue, and more of M splats, shape (M, 9 or more)."""
    p, count, columns = splats.projection, len(splats.opacities), 0 if more is None else more[:1].numel()
    given = p.means, p.factors, splats.opacities, splats.colors, p.means if more is None else more
    table = p.means.new_empty(count, 9 + columns)
    grid, constants = (triton.cdiv(count, 256),), {"warps": 4, "MORE": columns, "BLOCK": 256}
    launch(fill_table, grid, *(x.detach().contiguous() for x in given), table, count, **constants)
    return table


def gradient_rows(lists: Lists, table: Tensor) -> tuple[Tensor, bool]:
    """Return zeros for the rows of gradients, and whether there is one per entry instead of one per splat.

    Atomic additions come in any order. Where PyTorch is asked for deterministic algorithms, every entry of the lists
    has a row of its own, 64 bytes, which `sum_rows` adds up in one order: 140 bytes per entry at its peak, with the
    sorted rows and their order.
    """
    each = torch.are_deterministic_algorithms_enabled()
    return table.new_zeros(len(lists.gaussians) if each else len(table), ROW.value), each


def sum_rows(rows: Tensor, each: bool, lists: Lists, count: int) -> Tensor:
    """Return the gradients of ``count`` splats, (count, 16)."""
    if not each:
        return rows
    # Stable, or entries of one splat would be added up in any order again.
    gaussians, order = torch.sort(lists.gaussians, stable=True)
    ends = torch.arange(count + 1, dtype=gaussians.dtype, device=rows.device)
    return torch.segment_reduce(rows[order], "sum", offsets=torch.searchsorted(gaussians, ends), axis=0)


@triton.jit
def pixels(tile, width, height, columns, TILE: tl.constexpr):
    """Return x and y of a tile's pixel centers, their places in an image, and which are inside of it."""
    p = tl.arange(0, TILE * TILE)
    x = tile % columns * TILE + p % TILE
    y = tile // columns * TILE + p // TILE
    return x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5, y * width + x, (x < width) & (y < height)


@triton.jit
def load3(image, place, size, inside):
    """Return the three channels of an image at the pixels."""
    r = tl.load(image + place, mask=inside, other=0.0)
    g = tl.load(image + size + place, mask=inside, other=0.0)
    return r, g, tl.load(image + 2 * size + place, mask=inside, other=0.0)


@triton.jit
def store3(image, place, size, inside, r, g, b):
    """Store the three channels of an image at the pixels."""
    tl.store(image + place, r, mask=inside)
    tl.store(image + size + place, g, mask=inside)
    tl.store(image + 2 * size + place, b, mask=inside)


@triton.jit
def alpha_at(row, x, y):
    """Return a splat's alpha at the pixels before the clamp, 0 below `MIN_ALPHA`, and its geometry there.

    ln alpha = ln o - (w1^2 + w2^2) / 2 with w1 = l11 dx + l21 dy, w2 = l22 dy: squares of what is small wherever alpha
    is not, so nothing cancels. What a mask leaves out has an alpha of 0: to skip it would be to wait for its opacity
    before anything else of the row is loaded.
    """
    l11, l21, l22, log_opacity = tl.load(row + 2), tl.load(row + 3), tl.load(row + 4), tl.load(row + 5)
    dx, dy = x - tl.load(row), y - tl.load(row + 1)
    w1, w2 = l11 * dx + l21 * dy, l22 * dy
    exponent = log_opacity - (w1 * w1 + w2 * w2) * _HALF
    return tl.where(exponent > _FAINT, tl.exp2(exponent), 0.0), (dx, dy, w1, w2, l11, l21, l22, log_opacity)


@triton.jit
def geometry_sums(slope, geometry):
    """Carry the gradients of ln alpha at the pixels, ``slope``, to x, y, l11, l21, l22 and the opacity.

    As the pixel's offset is dx = pixel - x, the derivatives of ln alpha are l11 w1 in x, l21 w1 + l22 w2 in y, -w1 dx,
    -w1 dy, -w2 dy in the factor, and 1 / o in the opacity.
    """
    dx, dy, w1, w2, l11, l21, l22, log_opacity = geometry
    s1, s2 = slope * w1, slope * w2
    along, across = tl.sum(s1), tl.sum(s2)
    to_factor = -tl.sum(s1 * dx), -tl.sum(s1 * dy), -tl.sum(s2 * dy)
    to_y = l21 * along + l22 * across
    return l11 * along, to_y, to_factor[0], to_factor[1], to_factor[2], tl.sum(slope) * tl.exp2(-log_opacity)


@triton.jit
def make_row(a, b, c):
    """Put three times four sums into the first columns of a row, in a tree of choices by the bits of the column.

    A mask for every column would take two of AMD's scalar registers each.
    """
    column = tl.arange(0, ROW)
    odd, second = (column & 1) != 0, (column & 2) != 0
    first = tl.where(second, tl.where(odd, a[3], a[2]), tl.where(odd, a[1], a[0]))
    middle = tl.where(second, tl.where(odd, b[3], b[2]), tl.where(odd, b[1], b[0]))
    last = tl.where(second, tl.where(odd, c[3], c[2]), tl.where(odd, c[1], c[0]))
    return tl.where(column >= 8, last, tl.where((column & 4) != 0, middle, first))


@triton.jit
def add_row(rows, row, e, i, COLUMNS: tl.constexpr, EACH: tl.constexpr):
    """Add the gradients of entry e to those of splat i, or store them as the entry's own.

    Relaxed: additions need no order among other memory accesses, and the fences of the default would wait for each.
    """
    # In 64 bits, as 2^27 entries have 2^31 numbers.
    column = tl.arange(0, ROW).to(tl.int64)
    if EACH:
        tl.store(rows + (0 * column + e) * ROW + column, row, mask=column < COLUMNS)
    else:
        tl.atomic_add(rows + (0 * column + i) * ROW + column, row, mask=column < COLUMNS, sem="relaxed")
