"""The loop over a tile: front-to-back compositing of its list, and its gradient.

A pixel's transmittance is negative from the splat on that ends it (`MIN_TRANSMITTANCE`). The way back goes front to
back as well: what lies behind a splat is what was drawn less what has been passed, so alphas are evaluated once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE
from reference_trainer.render.loops.arithmetic import PIXELS, X, Y, exp2
from reference_trainer.render.loops.compiling import inlined, kernel
from reference_trainer.render.loops.threads import in_threads
from reference_trainer.render.precision import without_autocast
from reference_trainer.render.splats import Splats, TileLists

__all__ = [
    "alpha_at",
    "composite",
    "footprint",
    "footprint_gradient",
    "geometry_gradients",
    "is_faint",
    "make_table",
    "over_tiles",
    "sum_rows",
]

Array = Any
f4 = np.float32
_ZERO, _ONE, _TWO = f4(0), f4(1), f4(2)
_HALF = f4(0.5 * np.log2(np.e))  # exp(-x / 2) = 2^(-_HALF x)
_MIN, _MAX, _LEAST_LIGHT = f4(MIN_ALPHA), f4(MAX_ALPHA), f4(MIN_TRANSMITTANCE)
_FAINT = f4(np.log2(MIN_ALPHA))
_CHECK = 16  # entries between two looks at whether all pixels have ended


def make_table(splats: Splats) -> Tensor:
    """Return x, y, l11, l21, l22, log2 of the opacity, red, green and blue of M splats, shape (M, 9)."""
    projection, logarithms = splats.projection, torch.log2(splats.opacities)[:, None]
    return torch.cat([projection.means, projection.factors, logarithms, splats.colors], dim=1).detach()


def over_tiles(kernel: Any, lists: TileLists, *arguments: Any) -> None:
    """Call a kernel with the lists of all tiles, and with more tensors, of which it fills some that are contiguous."""
    arrays = (x.detach().contiguous().numpy() if isinstance(x, Tensor) else x for x in (lists.gaussians, *arguments))
    in_threads(kernel, lists.columns * lists.rows, lists.starts.numpy(), *arrays, least=4)


def sum_rows(rows: Tensor, lists: TileLists) -> Tensor:
    """Add up the rows of every Gaussian's entries, (P, C), always in the same order; shape (M, C)."""
    assert lists.offsets is not None
    sums = rows.new_empty(lists.offsets.shape[0] - 1, rows.shape[1])
    in_threads(_sum_rows, sums.shape[0], lists.offsets.numpy(), rows.numpy(), sums.numpy())
    return sums


@inlined
def is_faint(table: Any, i: Any) -> Any:
    """Whether a Gaussian cannot be seen anywhere, as one that a mask has dropped."""
    return table[i, 5] < _FAINT


@inlined
def footprint(table: Any, i: Any, tile_x: Any, tile_y: Any) -> Any:
    """Expand log2 alpha = log2 o - _HALF |factor (pixel - mean)|^2 around the centre of a tile."""
    l11, l21, l22 = table[i, 2], table[i, 3], table[i, 4]
    dx, dy = table[i, 0] - tile_x, table[i, 1] - tile_y
    # Squaring w1 and w2, which are small wherever alpha is not, avoids the cancellation of a dx^2 + 2 b dx dy + c dy^2.
    w1, w2 = l11 * dx + l21 * dy, l22 * dy
    return (
        table[i, 5] - _HALF * (w1 * w1 + w2 * w2),
        _TWO * _HALF * l11 * w1,
        _TWO * _HALF * (l21 * w1 + l22 * w2),
        -_HALF * l11 * l11,
        -_TWO * _HALF * l11 * l21,
        -_HALF * (l21 * l21 + l22 * l22),
    )


@inlined
def alpha_at(polynomial: Any, x: Any, y: Any) -> Any:
    """Return a splat's alpha at a pixel of the tile before the clamp; 0 below `MIN_ALPHA`."""
    c, cx, cy, cxx, cxy, cyy = polynomial
    raw = exp2(c + x * (cx + cxx * x + cxy * y) + y * (cy + cyy * y))
    return raw if raw > _MIN else _ZERO


@inlined
def footprint_gradient(table: Any, i: Any, tile_x: Any, tile_y: Any, sums: Any, row: Any) -> None:
    """Carry the gradient from a splat's ln alpha to its geometry.

    Args:
        table: of the Gaussians.
        i: the Gaussian.
        tile_x: centre of the tile.
        tile_y: likewise.
        sums: gradient of ln alpha times each monomial 1, x, y, x^2, x y, y^2, summed over the tile's pixels.
        row: receives the gradients of x, y, l11, l21, l22 and ln o.
    """
    l11, l21, l22 = table[i, 2], table[i, 3], table[i, 4]
    dx, dy = table[i, 0] - tile_x, table[i, 1] - tile_y
    w1, w2 = l11 * dx + l21 * dy, l22 * dy
    s, sx, sy, sxx, sxy, syy = sums
    to_w1, to_w2 = l11 * sx + l21 * sy - w1 * s, l22 * sy - w2 * s
    row[0] = l11 * to_w1
    row[1] = l21 * to_w1 + l22 * to_w2
    row[2] = w1 * sx - l11 * sxx - l21 * sxy + dx * to_w1
    row[3] = w1 * sy - l11 * sxy - l21 * syy + dy * to_w1
    row[4] = w2 * sy - l22 * syy + dy * to_w2
    row[5] = s


@kernel
def _forward(
    first: int, last: int, starts: Array, gaussians: Array, table: Array, background: Array, image: Array, light: Array
) -> None:
    height, width = light.shape
    columns = (width + TILE - 1) // TILE
    t, red, green, blue = np.empty(PIXELS, f4), np.empty(PIXELS, f4), np.empty(PIXELS, f4), np.empty(PIXELS, f4)
    for tile in range(first, last):
        top, left = tile // columns * TILE, tile % columns * TILE
        tile_x, tile_y = f4(left + TILE // 2), f4(top + TILE // 2)
        for p in range(PIXELS):
            inside = top + p // TILE < height and left + p % TILE < width
            t[p] = _ONE if inside else -_ONE
            red[p], green[p], blue[p] = _ZERO, _ZERO, _ZERO
        for e in range(starts[tile], starts[tile + 1]):
            i = gaussians[e]
            if is_faint(table, i):
                continue
            polynomial = footprint(table, i, tile_x, tile_y)
            r, g, b = table[i, 6], table[i, 7], table[i, 8]
            for p in range(PIXELS):
                alpha = alpha_at(polynomial, X[p], Y[p])
                alpha = alpha if alpha < _MAX else _MAX
                now = t[p]
                rest = now * (_ONE - alpha)
                goes_on = rest >= _LEAST_LIGHT
                weight = alpha * now if goes_on else _ZERO
                red[p] += weight * r
                green[p] += weight * g
                blue[p] += weight * b
                t[p] = rest if goes_on else -abs(now)
            if e % _CHECK == 0:
                most = t[0]
                for p in range(PIXELS):
                    most = t[p] if t[p] > most else most
                if most < _ZERO:
                    break
        for p in range(PIXELS):
            y, x = top + p // TILE, left + p % TILE
            if y < height and x < width:
                through = abs(t[p])
                light[y, x] = through
                image[0, y, x] = red[p] + through * background[0]
                image[1, y, x] = green[p] + through * background[1]
                image[2, y, x] = blue[p] + through * background[2]


@kernel
def _backward(
    first: int, last: int, starts: Array, gaussians: Array, slots: Array, table: Array, image: Array, light: Array,
    to_image: Array, to_light: Array, rows: Array,
) -> None:  # fmt: skip
    height, width = light.shape
    columns = (width + TILE - 1) // TILE
    t, behind = np.empty(PIXELS, f4), np.empty(PIXELS, f4)
    to_red, to_green, to_blue = np.empty(PIXELS, f4), np.empty(PIXELS, f4), np.empty(PIXELS, f4)
    for tile in range(first, last):
        top, left = tile // columns * TILE, tile % columns * TILE
        tile_x, tile_y = f4(left + TILE // 2), f4(top + TILE // 2)
        for p in range(PIXELS):
            y, x = top + p // TILE, left + p % TILE
            t[p] = -_ONE
            to_red[p], to_green[p], to_blue[p], behind[p] = _ZERO, _ZERO, _ZERO, _ZERO
            if y < height and x < width:
                t[p] = _ONE
                to_red[p], to_green[p], to_blue[p] = to_image[0, y, x], to_image[1, y, x], to_image[2, y, x]
                of_colors = to_red[p] * image[0, y, x] + to_green[p] * image[1, y, x] + to_blue[p] * image[2, y, x]
                behind[p] = of_colors + to_light[y, x] * light[y, x]
        ended = False
        for e in range(starts[tile], starts[tile + 1]):
            i = gaussians[e]
            row = rows[slots[e]]
            if ended or is_faint(table, i):
                row[:] = _ZERO
                continue
            polynomial = footprint(table, i, tile_x, tile_y)
            r, g, b = table[i, 6], table[i, 7], table[i, 8]
            s, sx, sy, sxx, sxy, syy = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
            to_r, to_g, to_b = _ZERO, _ZERO, _ZERO
            for p in range(PIXELS):
                x, y = X[p], Y[p]
                raw = alpha_at(polynomial, x, y)
                alpha = raw if raw < _MAX else _MAX
                now, passed = t[p], _ONE - alpha
                rest = now * passed
                goes_on = rest >= _LEAST_LIGHT
                weight = alpha * now if goes_on else _ZERO
                along = to_red[p] * r + to_green[p] * g + to_blue[p] * b
                beyond = behind[p] - weight * along
                behind[p] = beyond
                t[p] = rest if goes_on else -abs(now)
                # A splat adds T c itself, and dims by 1 / (1 - alpha) all behind it; the clamp lets gradients pass.
                d = raw * (now * along - beyond / passed) if goes_on else _ZERO
                s += d
                sx += d * x
                sy += d * y
                sxx += d * x * x
                sxy += d * x * y
                syy += d * y * y
                to_r += weight * to_red[p]
                to_g += weight * to_green[p]
                to_b += weight * to_blue[p]
            footprint_gradient(table, i, tile_x, tile_y, (s, sx, sy, sxx, sxy, syy), row)
            row[6], row[7], row[8] = to_r, to_g, to_b
            if e % _CHECK == 0:
                most = t[0]
                for p in range(PIXELS):
                    most = t[p] if t[p] > most else most
                ended = most < _ZERO


@kernel
def _sum_rows(first: int, last: int, offsets: Array, rows: Array, sums: Array) -> None:
    for i in range(first, last):
        for column in range(rows.shape[1]):
            sums[i, column] = 0
        for row in range(offsets[i], offsets[i + 1]):
            for column in range(rows.shape[1]):
                sums[i, column] += rows[row, column]


class _Composite(torch.autograd.Function):
    """Of a table of splats: their image over the background (3, H, W), and what light is left (H, W)."""

    @staticmethod
    def forward(ctx: Any, splats: Splats, background: Tensor, *_differentiable: Tensor) -> tuple[Tensor, Tensor]:
        table, lists = make_table(splats), splats.lists
        image, light = table.new_empty(3, lists.height, lists.width), table.new_empty(lists.height, lists.width)
        over_tiles(_forward, lists, table, background, image, light)
        ctx.lists = lists
        ctx.save_for_backward(table, image, light)
        return image, light

    @staticmethod
    @without_autocast
    def backward(ctx: Any, to_image: Tensor, to_light: Tensor) -> tuple[Tensor | None, ...]:
        table, image, light = ctx.saved_tensors
        rows = table.new_empty(ctx.lists.gaussians.shape[0], 9)
        over_tiles(_backward, ctx.lists, ctx.lists.slots, table, image, light, to_image, to_light, rows)
        to_background = (to_image * light).sum((1, 2)) if ctx.needs_input_grad[1] else None
        return None, to_background, *geometry_gradients(table, sum_rows(rows, ctx.lists))


def geometry_gradients(table: Tensor, sums: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the gradients of means, factors, opacities and colours, given those of a table's rows (M, 9 or more)."""
    # A splat that a mask has dropped has no logarithm, and a gradient of 0.
    return sums[:, :2], sums[:, 2:5], sums[:, 5] / table[:, 5].exp2().clamp_min(MIN_ALPHA), sums[:, 6:9]


def composite(splats: Splats, background: Tensor) -> tuple[Tensor, Tensor]:
    """Draw splats over a background (3,): image (3, H, W), and the light left at every pixel, 1 - alpha, (H, W)."""
    p = splats.projection
    result: tuple[Tensor, Tensor] = _Composite.apply(  # type: ignore[no-untyped-call]
        splats, background, p.means, p.factors, splats.opacities, splats.colors
    )
    return result
