"""The recursion of the exact moments (`ca_reg.functional.pixel_moments`), tile by tile, its gradient, and the shares.

Back to front, with ``d_i = c_i - mu_{i+1}`` the contrast of a splat with the mean of what is behind it:

    mu_i = mu_{i+1} + m alpha_i d_i      V = sum_i spread_i S_i d_i^2      S_i = prod_{j<i} shrink_j

where ``spread = v alpha^2`` and ``shrink = (1 - m alpha)^2 + spread``. Every term of V is a square times a non-negative
weight: nothing cancels. The terms are the shares of the splats. The expected transmittance is 1 minus the expected
accumulated alpha.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.compiled.compiling import inlined, kernel
from reference_trainer.render.numba import tiles
from reference_trainer.render.numba.tiles import CHUNK, PIXELS
from reference_trainer.render.splats import Splats, TileLists

__all__ = ["moments", "shares"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _TWO = f4(0), f4(1), f4(2)

# Offsets into a tile's state, see compositing.py.
_MEAN, _MEAN_1, _MEAN_2, _TRANSMITTANCE = (i * PIXELS for i in range(4))
_VARIANCE, _VARIANCE_1, _VARIANCE_2 = (i * PIXELS for i in range(4, 7))
_TO_MEAN, _TO_MEAN_1, _TO_MEAN_2, _TO_TRANSMITTANCE = (i * PIXELS for i in range(7, 11))
_HIDDEN, _FRONT, _SLOPE, _SIZE = (i * PIXELS for i in range(11, 15))
# Offsets into what is kept of an entry.
_RAW, _D0, _D1, _D2, _BEYOND, _D3 = (i * PIXELS for i in range(6))


@inlined
def _random(alpha: Any, factor: Any, varies: Any) -> Any:
    """Return m alpha, spread, 1 - m alpha and shrink."""
    expected, spread = factor * alpha, varies * alpha * alpha
    passed = _ONE - expected
    return expected, spread, passed, passed * passed + spread


@inlined
def _over(alpha: Any, entry: Any, means: Any, variances: Any, transmittance: Any) -> Any:
    """Return means, variances and transmittance with one more splat in front."""
    # Means before variances, whose terms take the contrast with the mean *behind* the splat.
    r, g, b, factor, varies = entry
    (m0, m1, m2), (v0, v1, v2) = means, variances
    expected, spread, passed, shrink = _random(tiles.clamped(alpha), factor, varies)
    d0, d1, d2 = r - m0, g - m1, b - m2
    means = m0 + expected * d0, m1 + expected * d1, m2 + expected * d2
    variances = v0 * shrink + spread * d0 * d0, v1 * shrink + spread * d1 * d1, v2 * shrink + spread * d2 * d2
    return means, variances, passed * transmittance


@kernel
def _forward(
    first: int, last: int, columns: int, starts: Array, gaussians: Array, table: Array, background: Array, mean: Array,
    variance: Array, alpha: Array,
) -> None:  # fmt: skip
    s, entries = np.empty(7 * PIXELS, f4), np.empty((CHUNK + 1, 11), f4)
    for tile in range(first, last):
        s[_TRANSMITTANCE : _TRANSMITTANCE + PIXELS] = _ONE
        s[_VARIANCE:] = _ZERO
        tiles.load(background, tile, columns, s, _MEAN)
        # Back to front, and to the end of the list: no early stop, see `render_moments`.
        for begin in range(starts[tile + 1] - 1, starts[tile] - 1, -CHUNK):
            end = max(begin - CHUNK, starts[tile] - 1)
            for k in range(0, tiles.read_entries(gaussians, begin, end, -1, table, tile, columns, entries), 2):
                a, b = entries[k], entries[k + 1]
                shape_a, shape_b = tiles.footprint_of(a), tiles.footprint_of(b)
                value_a, value_b = (a[6], a[7], a[8], a[9], a[10]), (b[6], b[7], b[8], b[9], b[10])
                for p in range(PIXELS):
                    m = s[_MEAN + p], s[_MEAN_1 + p], s[_MEAN_2 + p]
                    v = s[_VARIANCE + p], s[_VARIANCE_1 + p], s[_VARIANCE_2 + p]
                    m, v, transmittance = _over(tiles.alpha_at(shape_a, p), value_a, m, v, s[_TRANSMITTANCE + p])
                    m, v, s[_TRANSMITTANCE + p] = _over(tiles.alpha_at(shape_b, p), value_b, m, v, transmittance)
                    s[_MEAN + p], s[_MEAN_1 + p], s[_MEAN_2 + p] = m
                    s[_VARIANCE + p], s[_VARIANCE_1 + p], s[_VARIANCE_2 + p] = v
        for p in range(PIXELS):
            s[_TRANSMITTANCE + p] = _ONE - s[_TRANSMITTANCE + p]
        tiles.store(s, _TRANSMITTANCE, alpha, tile, columns)
        tiles.store(s, _MEAN, mean, tile, columns)
        tiles.store(s, _VARIANCE, variance, tile, columns)


def _make_backward(complete: bool) -> Any:
    """Return the kernel of the gradients.

    Args:
        complete: whether to add those of the accumulated alpha and of the factors' moments, and the
            shares; a quarter slower.
    """
    size = 6 if complete else 5

    @kernel
    def _backward(
        first: int, last: int, columns: int, starts: Array, gaussians: Array, slots: Array, table: Array,
        background: Array, to_mean: Array, to_variance: Array, to_alpha: Array, rows: Array, to_background: Array,
    ) -> None:  # fmt: skip
        """Sum up what is behind every splat, back to front; then carry gradients front to back.

        Let G be the gradient of V, Q_i = G . d_i^2 that of the weight S_i spread_i, and u_i that of
        mu_i, the mean of what splat i and all behind it show. Then, with S_i the product of all
        shrinks in front of i ("front"):

            dL / dspread_i = S_i Q_i + dL / dshrink_i          as shrink contains spread
            dL / dshrink_i = S_i hidden_i,   hidden_i = sum_{j>i} Q_j spread_j S_j / S_{i+1}
            dL / d(m alpha)_i = u_i . d_i - 2 (1 - m alpha_i) dL / dshrink_i
            dL / dd_i = m alpha_i u_i + 2 S_i spread_i G d_i   =: t_i
            dL / dc_i = t_i,     u_{i+1} = u_i - t_i           as d_i = c_i - mu_{i+1}

        hidden_i comes from the recursion hidden_{i-1} = shrink_i hidden_i + Q_i spread_i, back to
        front, since a division by S would fail at 0; u_i and S_i come front to back.
        """
        memory = np.empty(np.diff(starts[first : last + 1]).max() * size * PIXELS, f4)
        s = np.empty(_SIZE, f4)  # _VARIANCE holds the gradient of the variance
        for tile in range(first, last):
            s[_TRANSMITTANCE : _TRANSMITTANCE + PIXELS] = _ONE
            s[_HIDDEN : _HIDDEN + PIXELS] = _ZERO
            s[_FRONT : _FRONT + PIXELS] = _ONE
            tiles.load(background, tile, columns, s, _MEAN)
            tiles.load(to_mean, tile, columns, s, _TO_MEAN)
            tiles.load(to_variance, tile, columns, s, _VARIANCE)
            tiles.load(to_alpha[:1], tile, columns, s, _TO_TRANSMITTANCE)
            begin = starts[tile]
            # First pass, back to front: alpha, contrasts and hidden of every entry, kept for the
            # second.
            for k in range(starts[tile + 1] - begin - 1, -1, -1):
                i = gaussians[begin + k]
                if tiles.is_faint(table, i):
                    continue
                polynomial = tiles.footprint(table, i, tile, columns)
                r, g, b, factor, varies = table[i, 6], table[i, 7], table[i, 8], table[i, 9], table[i, 10]
                of_entry = memory[k * size * PIXELS : (k + 1) * size * PIXELS]
                for p in range(PIXELS):
                    raw = tiles.alpha_at(polynomial, p)
                    expected, spread, passed, shrink = _random(tiles.clamped(raw), factor, varies)
                    d0, d1, d2, d3 = r - s[_MEAN + p], g - s[_MEAN_1 + p], b - s[_MEAN_2 + p], s[_TRANSMITTANCE + p]
                    hidden = s[_HIDDEN + p]
                    of_entry[_RAW + p], of_entry[_D0 + p], of_entry[_D1 + p] = raw, d0, d1
                    of_entry[_D2 + p], of_entry[_BEYOND + p] = d2, hidden
                    if complete:
                        of_entry[_D3 + p] = d3
                        s[_TRANSMITTANCE + p] = passed * d3
                    weight = s[_VARIANCE + p] * d0 * d0 + s[_VARIANCE_1 + p] * d1 * d1
                    weight += s[_VARIANCE_2 + p] * d2 * d2
                    s[_HIDDEN + p] = hidden * shrink + weight * spread
                    s[_MEAN + p] += expected * d0
                    s[_MEAN_1 + p] += expected * d1
                    s[_MEAN_2 + p] += expected * d2
            # Second pass, front to back: the formulas above, summed over the pixels of the tile.
            for k in range(starts[tile + 1] - begin):
                i = gaussians[begin + k]
                row = rows[slots[begin + k]]
                if tiles.is_faint(table, i):
                    row[:] = _ZERO
                    continue
                factor, varies = table[i, 9], table[i, 10]
                to_r, to_g, to_b, to_factor, to_varies, share = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
                of_entry = memory[k * size * PIXELS : (k + 1) * size * PIXELS]
                for p in range(PIXELS):
                    raw, d0, d1, d2 = of_entry[_RAW + p], of_entry[_D0 + p], of_entry[_D1 + p], of_entry[_D2 + p]
                    u0, u1, u2 = s[_TO_MEAN + p], s[_TO_MEAN_1 + p], s[_TO_MEAN_2 + p]
                    w0, w1, w2 = s[_VARIANCE + p] * d0, s[_VARIANCE_1 + p] * d1, s[_VARIANCE_2 + p] * d2
                    alpha, front = tiles.clamped(raw), s[_FRONT + p]
                    expected, spread, passed, shrink = _random(alpha, factor, varies)
                    to_shrink = of_entry[_BEYOND + p] * front
                    of_spread = (w0 * d0 + w1 * d1 + w2 * d2) * front
                    to_spread = of_spread + to_shrink
                    to_expected = u0 * d0 + u1 * d1 + u2 * d2 - _TWO * passed * to_shrink
                    twice = _TWO * front * spread
                    t0, t1, t2 = u0 * expected + w0 * twice, u1 * expected + w1 * twice, u2 * expected + w2 * twice
                    s[_TO_MEAN + p], s[_TO_MEAN_1 + p], s[_TO_MEAN_2 + p] = u0 - t0, u1 - t1, u2 - t2
                    s[_FRONT + p] = front * shrink
                    to_r += t0
                    to_g += t1
                    to_b += t2
                    # The alpha of the whole list, 1 - prod (1 - m alpha_i): its derivative by m
                    # alpha_i is the product over the others, of which d3 holds those behind.
                    if complete:
                        to_expected += s[_TO_TRANSMITTANCE + p] * of_entry[_D3 + p]
                        s[_TO_TRANSMITTANCE + p] *= passed
                        to_factor += to_expected * alpha
                        to_varies += to_spread * alpha * alpha
                        share += of_spread * spread
                    # d(m alpha) = m dalpha,   dspread = 2 v alpha dalpha,
                    # dalpha = alpha dln(alpha).
                    s[_SLOPE + p] = raw * (_TWO * varies * to_spread * alpha + to_expected * factor)
                tiles.footprint_gradient(table, i, tile, columns, s[_SLOPE:], row)
                row[6], row[7], row[8] = to_r, to_g, to_b
                if complete:
                    row[9], row[10], row[11] = to_factor, to_varies, share
            # What is left of u behind the last splat is the gradient of the background.
            tiles.store(s, _TO_MEAN, to_background, tile, columns)

    return _backward


_backward, _complete_backward = _make_backward(False), _make_backward(True)


def _gradients(
    lists: TileLists, table: Tensor, background: Tensor, upstream: Sequence[Tensor], complete: bool
) -> list[Tensor]:
    """Return the gradients of splats, (multipliers, shares) and background; the second (M, 3) if ``complete``."""
    rows = table.new_empty(lists.gaussians.shape[0], 12 if complete else 9)
    to_background = tiles.whole_tiles(lists, 3)
    assert lists.slots is not None
    kernel, images = _complete_backward if complete else _backward, map(lists.padded, (background, *upstream))
    tiles.over_tiles(kernel, lists, lists.slots, table, *images, rows, to_background)
    # Contiguous, as the sum over a part of each row, which the gradient of a single color is, would round differently.
    return [*tiles.sum_rows(rows, table, lists), lists.cut(to_background).contiguous()]


class _Moments(torch.autograd.Function):
    """Mean and variance of the colors, and the expected accumulated alpha."""

    @staticmethod
    def forward(ctx: Any, splats: Splats, multiplier: Tensor, background: Tensor, *_differentiable: Tensor) -> Any:
        # Without a gradient of the alphas, the faster kernel is enough: None must not become zeros.
        ctx.set_materialize_grads(False)
        table, ctx.lists = tiles.make_table(splats, multiplier), splats.lists
        images = [tiles.whole_tiles(ctx.lists, channels) for channels in (3, 3, 1)]
        tiles.over_tiles(_forward, ctx.lists, table, ctx.lists.padded(background), *images)
        ctx.save_for_backward(table, background)
        mean, variance, alpha = map(ctx.lists.cut, images)
        return mean, variance, alpha[0]

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, to_mean: Tensor | None, to_variance: Tensor | None, to_alpha: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        table, background = ctx.saved_tensors
        complete = to_alpha is not None or ctx.needs_input_grad[1]
        gradients = to_mean, to_variance, None if to_alpha is None else to_alpha[None]
        upstream = [torch.zeros_like(background) if x is None else x for x in gradients]
        *of_splats, more, to_background = _gradients(ctx.lists, table, background, upstream, complete)
        return None, more[:, :2] if complete else None, to_background, *of_splats


moments = _Moments.apply


def shares(splats: Splats, multiplier: Tensor, background: Tensor, weights: Tensor) -> Tensor:
    """Return every splat's share of the weighted variance of the pixels, see `Engine.shares`."""
    table, upstream = tiles.make_table(splats, multiplier), (weights / 3).expand(3, -1, -1)
    # A share is a summand of V times its gradient, here the weight of the pixel: the backward pass
    # of a loss that is the weighted variance, of which only the shares are read.
    nothing = torch.zeros_like(upstream)
    *_, more, _ = _gradients(splats.lists, table, background, (nothing, upstream, nothing), complete=True)
    return more[:, 2].double()
