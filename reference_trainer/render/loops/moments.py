"""The recursion of the exact moments (`ca_reg.functional.pixel_moments`), tile by tile, its gradient, and the shares.

Back to front, with ``d_i = c_i - mu_{i+1}`` the contrast of a splat with the mean of what is behind it:

    mu_i = mu_{i+1} + m alpha_i d_i        V = sum_i spread_i S_i d_i^2        S_i = prod_{j<i} shrink_j

where ``spread = v alpha^2`` and ``shrink = (1 - m alpha)^2 + spread``. Every term of V is a square times a non-negative
weight: nothing cancels. The accumulated alpha is a fourth colour, 1 over 0; what it lacks of 1 is ``light``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.render.constants import MAX_ALPHA, TILE
from reference_trainer.render.loops.arithmetic import PIXELS, X, Y
from reference_trainer.render.loops.compiling import kernel
from reference_trainer.render.loops.drawing import (
    alpha_at,
    footprint,
    footprint_gradient,
    geometry_gradients,
    is_faint,
    make_table,
    over_tiles,
    sum_rows,
)
from reference_trainer.render.precision import without_autocast
from reference_trainer.render.splats import Splats

__all__ = ["moments", "shares"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _TWO, _MAX, _THIRD = f4(0), f4(1), f4(2), f4(MAX_ALPHA), f4(1 / 3)

# Places in a tile's state: what is kept of every pixel stands in one array, so that the compiler sees that nothing
# overlaps. With an array for each it would give up and not use vector instructions: four times slower.
_MEAN, _MEAN_1, _MEAN_2, _LIGHT, _HIDDEN, _FRONT = (i * PIXELS for i in range(6))
_TO_MEAN, _TO_MEAN_1, _TO_MEAN_2, _TO_MEAN_3 = (i * PIXELS for i in range(6, 10))
_VARIANCE, _VARIANCE_1, _VARIANCE_2, _VARIANCE_3 = (i * PIXELS for i in range(4, 8))
_TO_VARIANCE, _TO_VARIANCE_1, _TO_VARIANCE_2, _TO_VARIANCE_3 = (i * PIXELS for i in range(10, 14))


@kernel
def _forward(
    first: int, last: int, starts: Array, gaussians: Array, table: Array, factors: Array, behind: Array, mean: Array,
    variance: Array,
) -> None:  # fmt: skip
    _, height, width = behind.shape
    columns = (width + TILE - 1) // TILE
    s = np.empty(8 * PIXELS, f4)
    for tile in range(first, last):
        top, left = tile // columns * TILE, tile % columns * TILE
        tile_x, tile_y = f4(left + TILE // 2), f4(top + TILE // 2)
        for p in range(PIXELS):
            y, x = top + p // TILE, left + p % TILE
            inside = y < height and x < width
            for c in range(3):
                s[_MEAN + c * PIXELS + p] = behind[c, y, x] if inside else _ZERO
            s[_LIGHT + p] = _ONE
            for c in range(4):
                s[_VARIANCE + c * PIXELS + p] = _ZERO
        for e in range(starts[tile + 1] - 1, starts[tile] - 1, -1):
            i = gaussians[e]
            if is_faint(table, i):
                continue
            polynomial = footprint(table, i, tile_x, tile_y)
            r, g, b = table[i, 6], table[i, 7], table[i, 8]
            factor, varies = factors[i, 0], factors[i, 1]
            for p in range(PIXELS):
                alpha = alpha_at(polynomial, X[p], Y[p])
                alpha = alpha if alpha < _MAX else _MAX
                expected, spread = factor * alpha, varies * alpha * alpha
                passed = _ONE - expected
                shrink = passed * passed + spread
                m0, m1, m2, light = s[_MEAN + p], s[_MEAN_1 + p], s[_MEAN_2 + p], s[_LIGHT + p]
                d0, d1, d2 = r - m0, g - m1, b - m2
                s[_VARIANCE + p] = s[_VARIANCE + p] * shrink + spread * d0 * d0
                s[_VARIANCE_1 + p] = s[_VARIANCE_1 + p] * shrink + spread * d1 * d1
                s[_VARIANCE_2 + p] = s[_VARIANCE_2 + p] * shrink + spread * d2 * d2
                s[_VARIANCE_3 + p] = s[_VARIANCE_3 + p] * shrink + spread * light * light
                s[_MEAN + p] = m0 + expected * d0
                s[_MEAN_1 + p] = m1 + expected * d1
                s[_MEAN_2 + p] = m2 + expected * d2
                s[_LIGHT + p] = passed * light
        for p in range(PIXELS):
            y, x = top + p // TILE, left + p % TILE
            if y < height and x < width:
                for c in range(3):
                    mean[c, y, x] = s[_MEAN + c * PIXELS + p]
                mean[3, y, x] = _ONE - s[_LIGHT + p]
                for c in range(4):
                    variance[c, y, x] = s[_VARIANCE + c * PIXELS + p]


@kernel
def _longest(first: int, last: int, starts: Array) -> int:
    longest = 0
    for tile in range(first, last):
        longest = max(longest, starts[tile + 1] - starts[tile])
    return longest


def _make_backward(complete: bool) -> Any:
    """Return the kernel of the gradients.

    Args:
        complete: with those of the accumulated alpha, and of the moments of the factors: a quarter slower.
    """

    @kernel
    def _backward(
        first: int, last: int, starts: Array, gaussians: Array, slots: Array, table: Array, factors: Array,
        behind: Array, to_mean: Array, to_variance: Array, rows: Array, to_behind: Array,
    ) -> None:  # fmt: skip
        """Carry gradients back: to what is in front of a splat by what is behind it, then to the splat itself.

        With Q_i the gradient of the weight S_i spread_i of splat i, what is behind it sums up to
        hidden_i = sum_{j > i} Q_j spread_j S_j / S_{i + 1}: walked back to front, as division would fail at 0.
        """
        _, height, width = behind.shape
        columns = (width + TILE - 1) // TILE
        longest = _longest(first, last, starts)
        kept = np.empty(longest * 6 * PIXELS, f4)  # of every entry raw alpha, four contrasts, hidden
        s = np.empty(14 * PIXELS, f4)
        for tile in range(first, last):
            top, left = tile // columns * TILE, tile % columns * TILE
            tile_x, tile_y = f4(left + TILE // 2), f4(top + TILE // 2)
            for p in range(PIXELS):
                y, x = top + p // TILE, left + p % TILE
                inside = y < height and x < width
                for c in range(3):
                    s[_MEAN + c * PIXELS + p] = behind[c, y, x] if inside else _ZERO
                for c in range(4):
                    s[_TO_MEAN + c * PIXELS + p] = to_mean[c, y, x] if inside else _ZERO
                    s[_TO_VARIANCE + c * PIXELS + p] = to_variance[c, y, x] if inside else _ZERO
                s[_LIGHT + p], s[_HIDDEN + p], s[_FRONT + p] = _ONE, _ZERO, _ONE
            begin = starts[tile]
            for k in range(starts[tile + 1] - begin - 1, -1, -1):
                i = gaussians[begin + k]
                if is_faint(table, i):
                    continue
                polynomial = footprint(table, i, tile_x, tile_y)
                r, g, b = table[i, 6], table[i, 7], table[i, 8]
                factor, varies = factors[i, 0], factors[i, 1]
                of_entry = kept[k * 6 * PIXELS : (k + 1) * 6 * PIXELS]
                for p in range(PIXELS):
                    raw = alpha_at(polynomial, X[p], Y[p])
                    alpha = raw if raw < _MAX else _MAX
                    expected, spread = factor * alpha, varies * alpha * alpha
                    passed = _ONE - expected
                    d0, d1, d2, d3 = r - s[_MEAN + p], g - s[_MEAN_1 + p], b - s[_MEAN_2 + p], s[_LIGHT + p]
                    hidden = s[_HIDDEN + p]
                    of_entry[p], of_entry[PIXELS + p], of_entry[2 * PIXELS + p] = raw, d0, d1
                    of_entry[3 * PIXELS + p], of_entry[4 * PIXELS + p], of_entry[5 * PIXELS + p] = d2, d3, hidden
                    weight = s[_TO_VARIANCE + p] * d0 * d0 + s[_TO_VARIANCE_1 + p] * d1 * d1
                    weight += s[_TO_VARIANCE_2 + p] * d2 * d2
                    if complete:
                        weight += s[_TO_VARIANCE_3 + p] * d3 * d3
                    s[_HIDDEN + p] = hidden * (passed * passed + spread) + weight * spread
                    s[_MEAN + p] += expected * d0
                    s[_MEAN_1 + p] += expected * d1
                    s[_MEAN_2 + p] += expected * d2
                    s[_LIGHT + p] = passed * d3
            for k in range(starts[tile + 1] - begin):
                i = gaussians[begin + k]
                row = rows[slots[begin + k]]
                if is_faint(table, i):
                    row[:] = _ZERO
                    continue
                factor, varies = factors[i, 0], factors[i, 1]
                g0, gx, gy, gxx, gxy, gyy = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
                to_r, to_g, to_b, to_factor, to_varies = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
                of_entry = kept[k * 6 * PIXELS : (k + 1) * 6 * PIXELS]
                for p in range(PIXELS):
                    x, y = X[p], Y[p]
                    raw, d0, d1 = of_entry[p], of_entry[PIXELS + p], of_entry[2 * PIXELS + p]
                    d2, d3, hidden = of_entry[3 * PIXELS + p], of_entry[4 * PIXELS + p], of_entry[5 * PIXELS + p]
                    u0, u1, u2 = s[_TO_MEAN + p], s[_TO_MEAN_1 + p], s[_TO_MEAN_2 + p]
                    u3 = s[_TO_MEAN_3 + p] if complete else _ZERO
                    w0, w1 = s[_TO_VARIANCE + p] * d0, s[_TO_VARIANCE_1 + p] * d1
                    w2, w3 = s[_TO_VARIANCE_2 + p] * d2, s[_TO_VARIANCE_3 + p] * d3 if complete else _ZERO
                    alpha = raw if raw < _MAX else _MAX
                    expected, spread = factor * alpha, varies * alpha * alpha
                    passed, front = _ONE - expected, s[_FRONT + p]
                    to_shrink = hidden * front
                    to_spread = (w0 * d0 + w1 * d1 + w2 * d2 + w3 * d3) * front + to_shrink
                    to_expected = u0 * d0 + u1 * d1 + u2 * d2 + u3 * d3 - _TWO * passed * to_shrink
                    twice = _TWO * front * spread
                    t0, t1, t2 = u0 * expected + w0 * twice, u1 * expected + w1 * twice, u2 * expected + w2 * twice
                    s[_TO_MEAN + p] = u0 - t0
                    s[_TO_MEAN_1 + p] = u1 - t1
                    s[_TO_MEAN_2 + p] = u2 - t2
                    s[_FRONT + p] = front * (passed * passed + spread)
                    to_r += t0
                    to_g += t1
                    to_b += t2
                    if complete:
                        s[_TO_MEAN_3 + p] = u3 - u3 * expected - w3 * twice
                        to_factor += to_expected * alpha
                        to_varies += to_spread * alpha * alpha
                    d = raw * (_TWO * varies * to_spread * alpha + to_expected * factor)
                    g0 += d
                    gx += d * x
                    gy += d * y
                    gxx += d * x * x
                    gxy += d * x * y
                    gyy += d * y * y
                footprint_gradient(table, i, tile_x, tile_y, (g0, gx, gy, gxx, gxy, gyy), row)
                row[6], row[7], row[8], row[9], row[10] = to_r, to_g, to_b, to_factor, to_varies
            for p in range(PIXELS):
                y, x = top + p // TILE, left + p % TILE
                if y < height and x < width:
                    for c in range(3):
                        to_behind[c, y, x] = s[_TO_MEAN + c * PIXELS + p]

    return _backward


_backward, _complete_backward = _make_backward(False), _make_backward(True)


@kernel
def _shares(
    first: int, last: int, starts: Array, gaussians: Array, slots: Array, table: Array, factors: Array, behind: Array,
    weights: Array, rows: Array,
) -> None:  # fmt: skip
    """Sum the summands of the variance, mean over the colours, over the pixels of every tile."""
    _, height, width = behind.shape
    columns = (width + TILE - 1) // TILE
    kept = np.empty(_longest(first, last, starts) * 2 * PIXELS, f4)  # of every entry alpha, squared contrast
    s = np.empty(6 * PIXELS, f4)
    for tile in range(first, last):
        top, left = tile // columns * TILE, tile % columns * TILE
        tile_x, tile_y = f4(left + TILE // 2), f4(top + TILE // 2)
        for p in range(PIXELS):
            y, x = top + p // TILE, left + p % TILE
            inside = y < height and x < width
            for c in range(3):
                s[_MEAN + c * PIXELS + p] = behind[c, y, x] if inside else _ZERO
            s[_FRONT + p] = weights[y, x] * _THIRD if inside else _ZERO
        begin = starts[tile]
        for k in range(starts[tile + 1] - begin - 1, -1, -1):
            i = gaussians[begin + k]
            if is_faint(table, i):
                continue
            polynomial = footprint(table, i, tile_x, tile_y)
            r, g, b, factor = table[i, 6], table[i, 7], table[i, 8], factors[i, 0]
            of_entry = kept[k * 2 * PIXELS : (k + 1) * 2 * PIXELS]
            for p in range(PIXELS):
                alpha = alpha_at(polynomial, X[p], Y[p])
                alpha = alpha if alpha < _MAX else _MAX
                d0, d1, d2 = r - s[_MEAN + p], g - s[_MEAN_1 + p], b - s[_MEAN_2 + p]
                of_entry[p], of_entry[PIXELS + p] = alpha, d0 * d0 + d1 * d1 + d2 * d2
                s[_MEAN + p] += factor * alpha * d0
                s[_MEAN_1 + p] += factor * alpha * d1
                s[_MEAN_2 + p] += factor * alpha * d2
        for k in range(starts[tile + 1] - begin):
            i = gaussians[begin + k]
            total = 0.0
            if not is_faint(table, i):
                factor, varies = factors[i, 0], factors[i, 1]
                of_entry = kept[k * 2 * PIXELS : (k + 1) * 2 * PIXELS]
                for p in range(PIXELS):
                    alpha, front = of_entry[p], s[_FRONT + p]
                    passed, spread = _ONE - factor * alpha, varies * alpha * alpha
                    total += np.float64(front * spread * of_entry[PIXELS + p])
                    s[_FRONT + p] = front * (passed * passed + spread)
            rows[slots[begin + k], 0] = total


class _Moments(torch.autograd.Function):
    """Mean and variance of red, green, blue and accumulated alpha, (4, H, W) each."""

    @staticmethod
    def forward(
        ctx: Any, splats: Splats, alpha: bool, multiplier: Tensor, behind: Tensor, *_differentiable: Tensor
    ) -> tuple[Tensor, Tensor]:
        table = make_table(splats)
        mean, variance = (table.new_empty(4, *behind.shape[1:]) for _ in range(2))
        over_tiles(_forward, splats.lists, table, multiplier, behind, mean, variance)
        ctx.lists, ctx.alpha = splats.lists, alpha
        ctx.save_for_backward(table, multiplier, behind)
        return mean, variance

    @staticmethod
    @without_autocast
    def backward(ctx: Any, to_mean: Tensor, to_variance: Tensor) -> tuple[Tensor | None, ...]:
        table, multiplier, behind = ctx.saved_tensors
        backward = _complete_backward if ctx.alpha or ctx.needs_input_grad[2] else _backward
        rows, to_behind = table.new_empty(ctx.lists.gaussians.shape[0], 11), torch.empty_like(to_mean[:3])
        fixed = (ctx.lists.slots, table, multiplier, behind, to_mean, to_variance)
        over_tiles(backward, ctx.lists, *fixed, rows, to_behind)
        sums = sum_rows(rows, ctx.lists)
        return None, None, sums[:, 9:], to_behind, *geometry_gradients(table, sums)


def moments(splats: Splats, multiplier: Tensor, behind: Tensor, *, alpha: bool) -> tuple[Tensor, Tensor]:
    """Return mean and variance of every pixel under random factors, (4, H, W) each, see `Engine.moments`."""
    p = splats.projection
    result: tuple[Tensor, Tensor] = _Moments.apply(  # type: ignore[no-untyped-call]
        splats, alpha, multiplier, behind, p.means, p.factors, splats.opacities, splats.colors
    )
    return result


def shares(splats: Splats, multiplier: Tensor, behind: Tensor, weights: Tensor) -> Tensor:
    """Return every splat's share of the weighted variance of the pixels, (M,), float64, see `Engine.shares`."""
    lists = splats.lists
    rows = torch.empty(lists.gaussians.shape[0], 1, dtype=torch.float64)
    over_tiles(_shares, lists, lists.slots, make_table(splats), multiplier, behind, weights, rows)
    return sum_rows(rows, lists)[:, 0]
