"""What the tile kernels share: pixels, the alphas of splats at them, and their gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from reference_trainer.compiled.compiling import inlined, kernel, prefetch
from reference_trainer.compiled.threads import in_threads
from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA, TILE
from reference_trainer.render.splats import Splats, TileLists

__all__ = [
    "CHUNK", "LEAST_ALPHA", "PIXELS", "X", "Y", "absolute_slopes", "alpha_at", "clamped", "footprint",
    "footprint_gradient", "footprint_of", "is_faint", "load", "make_table", "over_tiles", "read_entries", "store",
    "sum_rows", "whole_tiles",
]  # fmt: skip

Array = Any
f4 = np.float32

PIXELS = TILE * TILE
CHUNK = 16
"""Entries of a list that are read at once."""

LEAST_ALPHA = f4(MIN_ALPHA)
"""`MIN_ALPHA` in single precision."""

X = np.tile(np.arange(TILE, dtype=f4) - f4((TILE - 1) / 2), TILE)
"""x of every pixel relative to its tile's center, row by row."""
Y = np.repeat(np.arange(TILE, dtype=f4) - f4((TILE - 1) / 2), TILE)
"""y likewise."""

_ZERO, _ONE, _TWO, _MAX = f4(0), f4(1), f4(2), f4(MAX_ALPHA)
_HALF = f4(0.5 * np.log2(np.e))  # exp(-x / 2) = 2^(-_HALF x)
_FAINT = f4(np.log2(MIN_ALPHA))
_ABSENT = f4(-1e4)  # binary logarithm of an opacity that is 0 everywhere

# The polynomial of degree 5 that approximates 2^x on [-1/2, 1/2] with the least relative error
# (7.5e-8).
_P0, _P1, _P2 = f4(1.00000007165467), f4(0.69314696706436), f4(0.24022119723882)
_P3, _P4, _P5 = f4(0.05550713274154), f4(0.00967554133273), f4(0.00132764717803)


def make_table(splats: Splats, more: Tensor | None = None) -> Tensor:
    """Return what the kernels read of M splats, side by side, shape (M, 9 or more).

    The columns are x, y, l11, l21, l22, log2 of the opacity, red, green, blue, and ``more``.
    """
    opacities = splats.opacities.detach()
    more = opacities.new_empty(len(opacities), 0) if more is None else more
    table = opacities.new_empty(len(opacities), 9 + more.shape[1])
    columns = (splats.projection.means, splats.projection.factors, opacities, splats.colors, more)
    arrays = (x.detach().contiguous().numpy() for x in (*columns, table))
    in_threads(_fill_table, len(table), *arrays, least=4096)
    return table


@kernel
def _fill_table(
    first: int, last: int, means: Array, factors: Array, opacities: Array, colors: Array, more: Array, table: Array
) -> None:
    for i in range(first, last):
        row = table[i]
        row[0], row[1] = means[i, 0], means[i, 1]
        row[2], row[3], row[4] = factors[i, 0], factors[i, 1], factors[i, 2]
        row[5] = np.log2(opacities[i])
        row[6], row[7], row[8] = colors[i, 0], colors[i, 1], colors[i, 2]
        for column in range(more.shape[1]):
            row[9 + column] = more[i, column]


def whole_tiles(lists: TileLists, *channels: int) -> Tensor:
    """Return an uninitialized image of whole tiles, so that kernels need no border checks."""
    return torch.empty(*channels, TILE * lists.rows, TILE * lists.columns, dtype=torch.float32, device="cpu")


def over_tiles(kernel: Any, lists: TileLists, *arguments: Tensor) -> None:
    """Call a kernel for all tiles; the tensors that it fills must be contiguous."""
    arrays = (x.detach().contiguous().numpy() for x in (lists.starts, lists.gaussians, *arguments))
    in_threads(kernel, lists.columns * lists.rows, lists.columns, *arrays, least=16)


def sum_rows(rows: Tensor, table: Tensor, lists: TileLists) -> list[Tensor]:
    """Add up the rows of every splat's entries, (P, 9 or more), always in the same order.

    Returns the gradients of means, factors, opacities and colors, and the sums of the remaining
    columns.
    """
    assert lists.offsets is not None
    sums = [table.new_empty(len(table), *shape) for shape in ((2,), (3,), (), (3,), (rows.shape[1] - 9,))]
    arrays = (x.numpy() for x in (lists.offsets, rows, table, *sums))
    in_threads(_sum_rows, len(table), *arrays, least=4096)
    return sums


@kernel
def _sum_rows(
    first: int, last: int, offsets: Array, rows: Array, table: Array, to_means: Array, to_factors: Array,
    to_opacities: Array, to_colors: Array, more: Array,
) -> None:  # fmt: skip
    # Rows are in the order of the lists, whatever thread wrote them: the same sums for any number.
    total = np.empty(rows.shape[1], f4)
    for i in range(first, last):
        total[:] = _ZERO
        for row in range(offsets[i], offsets[i + 1]):
            for column in range(rows.shape[1]):
                total[column] += rows[row, column]
        to_means[i, 0], to_means[i, 1] = total[0], total[1]
        to_factors[i, 0], to_factors[i, 1], to_factors[i, 2] = total[2], total[3], total[4]
        # Column 5 is the gradient of ln o; do / dln o = o. A splat dropped by a mask has opacity 0,
        # without a logarithm; its gradient is 0.
        to_opacities[i] = total[5] / max(np.exp2(table[i, 5]), LEAST_ALPHA)
        to_colors[i, 0], to_colors[i, 1], to_colors[i, 2] = total[6], total[7], total[8]
        for column in range(more.shape[1]):
            more[i, column] = total[9 + column]


@inlined
def load(images: Any, tile: Any, columns: Any, state: Any, place: Any) -> None:
    """Copy a tile of images (C, H, W) into its state, from offset ``place`` on."""
    top, left = tile // columns * TILE, tile % columns * TILE
    for c in range(images.shape[0]):
        for p in range(PIXELS):
            state[place + c * PIXELS + p] = images[c, top + p // TILE, left + p % TILE]


@inlined
def store(state: Any, place: Any, images: Any, tile: Any, columns: Any) -> None:
    """Copy a tile's state, from offset ``place`` on, into images (C, H, W)."""
    top, left = tile // columns * TILE, tile % columns * TILE
    for c in range(images.shape[0]):
        for p in range(PIXELS):
            images[c, top + p // TILE, left + p % TILE] = state[place + c * PIXELS + p]


@inlined
def is_faint(table: Any, i: Any) -> Any:
    """Whether a Gaussian is invisible everywhere, such as one dropped by a mask."""
    return table[i, 5] < _FAINT


@inlined
def read_entries(
    gaussians: Any, first: Any, last: Any, step: Any, table: Any, tile: Any, columns: Any, entries: Any
) -> Any:
    """Gather the visible Gaussians at ``range(first, last, step)`` of a tile's list.

    Rows of ``entries`` receive footprint, color, and the table's further columns. Returns how many
    there are; an invisible one follows, so that they can be taken in pairs.
    """
    # The rows of the table are scattered over memory: they are asked for a chunk ahead.
    count = 0
    for e in range(first, last, step):
        prefetch(table[gaussians[max(0, min(e + CHUNK * step, len(gaussians) - 1))]])
        i = gaussians[e]
        if is_faint(table, i):
            continue
        entry = entries[count]
        entry[0], entry[1], entry[2], entry[3], entry[4], entry[5] = footprint(table, i, tile, columns)
        for column in range(6, table.shape[1]):
            entry[column] = table[i, column]
        count += 1
    entries[count] = _ZERO
    entries[count, 0] = _ABSENT
    return count


@inlined
def footprint_of(entry: Any) -> Any:
    """Return the footprint of an entry from `read_entries`."""
    return entry[0], entry[1], entry[2], entry[3], entry[4], entry[5]


@inlined
def _from_center(table: Any, i: Any, tile: Any, columns: Any) -> Any:
    """Return a splat's factor, its mean relative to a tile's center, and their product."""
    l11, l21, l22 = table[i, 2], table[i, 3], table[i, 4]
    dx = table[i, 0] - f4(tile % columns * TILE + TILE // 2)
    dy = table[i, 1] - f4(tile // columns * TILE + TILE // 2)
    return l11, l21, l22, dx, dy, l11 * dx + l21 * dy, l22 * dy


@inlined
def footprint(table: Any, i: Any, tile: Any, columns: Any) -> Any:
    """Expand log2 alpha in 1, x, y, x^2, x y, y^2 around a tile's center.

    It is log2 o - _HALF |factor (pixel - mean)|^2.
    """
    # With (x, y) from the tile's center to a pixel and (dx, dy) to the mean, the two components of
    # factor (pixel - mean) are  e1 = l11 x + l21 y - w1  and  e2 = l22 y - w2,  where w1 = l11 dx +
    # l21 dy  and  w2 = l22 dy.  Expanding -_HALF (e1^2 + e2^2) gives six coefficients. Squaring w1
    # and w2, which are small wherever alpha is not, avoids the cancellation of a dx^2 + 2 b dx dy +
    # c dy^2.
    l11, l21, l22, _, _, w1, w2 = _from_center(table, i, tile, columns)
    return (
        table[i, 5] - _HALF * (w1 * w1 + w2 * w2),
        _TWO * _HALF * l11 * w1,
        _TWO * _HALF * (l21 * w1 + l22 * w2),
        -_HALF * l11 * l11,
        -_TWO * _HALF * l11 * l21,
        -_HALF * (l21 * l21 + l22 * l22),
    )


@inlined
def alpha_at(polynomial: Any, p: Any) -> Any:
    """Return a splat's alpha at a pixel of the tile before the clamp; 0 below `MIN_ALPHA`."""
    c, cx, cy, cxx, cxy, cyy = polynomial
    x, y = X[p], Y[p]
    # 2^exponent = 2^n 2^part: the integer part goes into the bits, the rest into the polynomial.
    exponent = c + x * (cx + cxx * x + cxy * y) + y * (cy + cyy * y)
    part, power = _split(exponent)
    raw = power * (_P0 + part * (_P1 + part * (_P2 + part * (_P3 + part * (_P4 + part * _P5)))))
    return raw if exponent > _FAINT else _ZERO


@inlined
def clamped(raw: Any) -> Any:
    """Return an alpha that is at most `MAX_ALPHA`."""
    return raw if raw < _MAX else _MAX


@intrinsic
def _split(_context: Any, _exponent: Any) -> Any:
    """Return x - n and 2^n for the integer n nearest to x.

    Meaningless below -126, where every alpha is cut off.

    `math.exp2` is a call for every number; this is a few instructions for eight or sixteen at once.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        single, whole = ir.FloatType(), ir.IntType(32)
        nearest = builder.call(builder.module.declare_intrinsic("llvm.rint", [single]), arguments)
        biased = builder.add(builder.fptosi(nearest, whole), ir.Constant(whole, 127))
        power = builder.bitcast(builder.shl(biased, ir.Constant(whole, 23)), single)
        return context.make_tuple(builder, signature.return_type, [builder.fsub(arguments[0], nearest), power])

    return types.UniTuple(types.float32, 2)(types.float32), generate


@inlined
def footprint_gradient(table: Any, i: Any, tile: Any, columns: Any, slopes: Any, row: Any) -> None:
    """Apply the chain rule from the pixels of a tile to a splat's row of gradients.

    The slopes are the gradients of the splat's ln alpha at the pixels. The row receives those of x,
    y, l11, l21, l22 and ln o.
    """
    # ln alpha is a polynomial of the pixel: the sums of the slopes times 1, x, y, x^2, x y and y^2
    # hold all that its gradient needs.
    s, sx, sy, sxx, sxy, syy = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for q in range(TILE):  # column by column: x is factored out
        d, dy, dyy = _ZERO, _ZERO, _ZERO
        for p in range(0, PIXELS, TILE):
            d += slopes[p + q]
            dy += slopes[p + q] * Y[p]
            dyy += slopes[p + q] * (Y[p] * Y[p])
        s += d
        sx += d * X[q]
        sxx += d * (X[q] * X[q])
        sy += dy
        sxy += dy * X[q]
        syy += dyy
    l11, l21, l22, dx, dy, w1, w2 = _from_center(table, i, tile, columns)
    # ln alpha = ln o - (e1^2 + e2^2) / 2 with e1 = l11 x + l21 y - w1 and e2 = l22 y - w2:
    # d/dw1 = e1,   d/dw2 = e2,   d/dl11 = -e1 x,   d/dl21 = -e1 y,   d/dl22 = -e2 y,   d/dln o = 1;
    # then through w1 = l11 dx + l21 dy and w2 = l22 dy to the mean, and once more to the factor.
    to_w1, to_w2 = l11 * sx + l21 * sy - w1 * s, l22 * sy - w2 * s
    row[0] = l11 * to_w1
    row[1] = l21 * to_w1 + l22 * to_w2
    row[2] = w1 * sx - l11 * sxx - l21 * sxy + dx * to_w1
    row[3] = w1 * sy - l11 * sxy - l21 * syy + dy * to_w1
    row[4] = w2 * sy - l22 * syy + dy * to_w2
    row[5] = s


@inlined
def absolute_slopes(table: Any, i: Any, tile: Any, columns: Any, slopes: Any) -> Any:
    """Sum a splat's absolute center gradients, given those of its ln alpha at the pixels."""
    l11, l21, l22, _, _, w1, w2 = _from_center(table, i, tile, columns)
    # d ln alpha / dx = l11 e1 and d ln alpha / dy = l21 e1 + l22 e2, here pixel by pixel, as the
    # absolute values do not add up to anything that moments could give.
    to_x, to_y = _ZERO, _ZERO
    for p in range(PIXELS):
        along, across = l11 * X[p] + l21 * Y[p] - w1, l22 * Y[p] - w2
        to_x += abs(slopes[p] * (l11 * along))
        to_y += abs(slopes[p] * (l21 * along + l22 * across))
    return to_x, to_y
