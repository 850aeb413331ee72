"""The loop over a tile: front-to-back compositing of its list, and its gradient.

A pixel's transmittance is negative from the splat on that ends it (`MIN_TRANSMITTANCE`). The way back goes front to
back as well: what lies behind a splat is what was drawn less what has been passed, so alphas are evaluated once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.render.constants import MIN_TRANSMITTANCE
from reference_trainer.compiled.compiling import inlined, kernel
from reference_trainer.render.loops.tiles import (
    CHUNK,
    PIXELS,
    alpha_at,
    clamped,
    footprint,
    footprint_gradient,
    geometry_gradients,
    get_pixels,
    is_faint,
    make_table,
    over_tiles,
    put_pixels,
    read_entries,
    sum_rows,
    whole_tiles,
)
from reference_trainer.render.splats import Splats

__all__ = ["composite"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _LEAST_LIGHT = f4(0), f4(1), f4(MIN_TRANSMITTANCE)

# Places in a tile's state: what is kept of every pixel stands in one array, so that the compiler sees that nothing
# overlaps. With an array for each it would give up and not use vector instructions: four times slower.
_LIGHT, _RED, _GREEN, _BLUE, _BEHIND, _SLOPE = (i * PIXELS for i in range(6))


@inlined
def _pass(alpha: Any, light: Any) -> Any:
    """Return the weight of a splat, and what light is left behind it."""
    rest = light * (_ONE - alpha)
    goes_on = rest >= _LEAST_LIGHT
    return alpha * light if goes_on else _ZERO, rest if goes_on else -abs(light)


@inlined
def _have_ended(state: Any) -> Any:
    most = state[_LIGHT]
    for p in range(PIXELS):
        most = state[_LIGHT + p] if state[_LIGHT + p] > most else most
    return most < _ZERO


@kernel
def _forward(
    first: int, last: int, columns: int, starts: Array, gaussians: Array, table: Array, background: Array,
    image: Array, light: Array,
) -> None:  # fmt: skip
    s, entries = np.empty(4 * PIXELS, f4), np.empty((CHUNK + 1, 9), f4)
    for tile in range(first, last):
        s[:] = _ZERO
        s[_LIGHT : _LIGHT + PIXELS] = _ONE
        for begin in range(starts[tile], starts[tile + 1], CHUNK):
            end = min(begin + CHUNK, starts[tile + 1])
            count = read_entries(gaussians, begin, end, 1, table, tile, columns, entries)
            for k in range(0, count, 2):
                a, b = entries[k], entries[k + 1]
                shape_a, shape_b = (a[0], a[1], a[2], a[3], a[4], a[5]), (b[0], b[1], b[2], b[3], b[4], b[5])
                red_a, green_a, blue_a, red_b, green_b, blue_b = a[6], a[7], a[8], b[6], b[7], b[8]
                for p in range(PIXELS):
                    weight_a, between = _pass(clamped(alpha_at(shape_a, p)), s[_LIGHT + p])
                    weight_b, rest = _pass(clamped(alpha_at(shape_b, p)), between)
                    s[_RED + p] += weight_a * red_a + weight_b * red_b
                    s[_GREEN + p] += weight_a * green_a + weight_b * green_b
                    s[_BLUE + p] += weight_a * blue_a + weight_b * blue_b
                    s[_LIGHT + p] = rest
            if _have_ended(s):
                break
        for p in range(PIXELS):
            through = abs(s[_LIGHT + p])
            s[_LIGHT + p] = through
            s[_RED + p] += through * background[0]
            s[_GREEN + p] += through * background[1]
            s[_BLUE + p] += through * background[2]
        put_pixels(s, _LIGHT, light[0], tile, columns)
        for c in range(3):
            put_pixels(s, _RED + c * PIXELS, image[c], tile, columns)


@kernel
def _backward(
    first: int, last: int, columns: int, starts: Array, gaussians: Array, slots: Array, table: Array, image: Array,
    light: Array, to_image: Array, to_light: Array, rows: Array,
) -> None:  # fmt: skip
    s, drawn = np.empty(6 * PIXELS, f4), np.empty(4 * PIXELS, f4)
    for tile in range(first, last):
        get_pixels(to_light[0], tile, columns, s, _LIGHT)
        get_pixels(light[0], tile, columns, drawn, _LIGHT)
        for c in range(3):
            get_pixels(to_image[c], tile, columns, s, _RED + c * PIXELS)
            get_pixels(image[c], tile, columns, drawn, _RED + c * PIXELS)
        for p in range(PIXELS):
            of_colors = s[_RED + p] * drawn[_RED + p] + s[_GREEN + p] * drawn[_GREEN + p]
            of_colors += s[_BLUE + p] * drawn[_BLUE + p]
            s[_BEHIND + p] = of_colors + s[_LIGHT + p] * drawn[_LIGHT + p]
            s[_LIGHT + p] = _ONE
        ended = False
        for e in range(starts[tile], starts[tile + 1]):
            i = gaussians[e]
            row = rows[slots[e]]
            if ended or is_faint(table, i):
                row[:] = _ZERO
                continue
            polynomial = footprint(table, i, tile, columns)
            r, g, b = table[i, 6], table[i, 7], table[i, 8]
            to_r, to_g, to_b = _ZERO, _ZERO, _ZERO
            for p in range(PIXELS):
                raw, now = alpha_at(polynomial, p), s[_LIGHT + p]
                alpha = clamped(raw)
                weight, rest = _pass(alpha, now)
                along = s[_RED + p] * r + s[_GREEN + p] * g + s[_BLUE + p] * b
                beyond = s[_BEHIND + p] - weight * along
                s[_BEHIND + p], s[_LIGHT + p] = beyond, rest
                # A splat adds T c itself, and dims by 1 / (1 - alpha) all behind it; the clamp lets gradients pass.
                s[_SLOPE + p] = raw * (now * along - beyond / (_ONE - alpha)) if rest > _ZERO else _ZERO
                to_r += weight * s[_RED + p]
                to_g += weight * s[_GREEN + p]
                to_b += weight * s[_BLUE + p]
            footprint_gradient(table, i, tile, columns, s[_SLOPE:], row)
            row[6], row[7], row[8] = to_r, to_g, to_b
            if e % CHUNK == 0:
                ended = _have_ended(s)


class _Composite(torch.autograd.Function):
    """Of a table of splats: their image over the background, and what light is left, (3 and 1, whole tiles)."""

    @staticmethod
    def forward(ctx: Any, splats: Splats, background: Tensor, *_differentiable: Tensor) -> tuple[Tensor, Tensor]:
        table, lists = make_table(splats), splats.lists
        image, light = whole_tiles(lists, 3), whole_tiles(lists, 1)
        over_tiles(_forward, lists, table, background, image, light)
        ctx.lists = lists
        ctx.save_for_backward(table, image, light)
        return image, light

    @staticmethod
    def backward(ctx: Any, to_image: Tensor, to_light: Tensor) -> tuple[Tensor | None, ...]:
        table, image, light = ctx.saved_tensors
        rows = table.new_empty(ctx.lists.gaussians.shape[0], 9)
        over_tiles(_backward, ctx.lists, ctx.lists.slots, table, image, light, to_image, to_light, rows)
        to_background = (to_image * light).sum((1, 2)) if ctx.needs_input_grad[1] else None
        return None, to_background, *geometry_gradients(table, sum_rows(rows, ctx.lists))


def composite(splats: Splats, background: Tensor) -> tuple[Tensor, Tensor]:
    """Draw splats over a background (3,): image (3, H, W), and the light left at every pixel, 1 - alpha, (H, W)."""
    p = splats.projection
    image, light = _Composite.apply(  # type: ignore[no-untyped-call]
        splats, background, p.means, p.factors, splats.opacities, splats.colors
    )
    return splats.lists.cut(image), splats.lists.cut(light)[0]
