"""Which Gaussian touches which tile, by counting instead of sorting.

A radix sort orders the Gaussians by depth. Each in turn is then appended to the lists of its tiles,
which are thereby in order of depth as well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from reference_trainer.compiled.compiling import inlined, kernel, prefetch
from reference_trainer.compiled.threads import in_threads
from reference_trainer.render.constants import TILE
from reference_trainer.render.numba.tiles import LEAST_ALPHA
from reference_trainer.render.splats import Projected, TileLists

__all__ = ["bin_gaussians"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _TWO, _HALF = f4(0), f4(1), f4(2), f4(0.5)
_TILE = f4(TILE)
_PARTS = 8  # of the depth order; each fills places of its own in a tile's list, so all run in parallel
_BITS = 12  # of a digit of the radix sort


@inlined
def _first_pixel(x: Any, size: Any) -> Any:
    """Return the first pixel whose center is at x or beyond it; in [0, size]."""
    return max(_ZERO, min(size, np.ceil(x - _HALF)))


@inlined
def _last_pixel(x: Any, size: Any) -> Any:
    """Return the last pixel whose center is at x or before it; in [-1, size - 1]."""
    return max(-_ONE, min(size - _ONE, np.floor(x - _HALF)))


@inlined
def _squared_radius(opacity: Any) -> Any:
    """Return the squared Mahalanobis distance at which alpha is `MIN_ALPHA`."""
    return _TWO * max(_ZERO, math.log(opacity / LEAST_ALPHA))


@kernel
def _nearest_first(depths: Array) -> Any:
    """Return the stable order of positive depths, nearest first."""
    # Digits of 12 bits, the last first; every round is stable, so earlier rounds stay sorted within
    # it.
    keys, mask, shift = depths.view(np.uint32).copy(), (1 << _BITS) - 1, 0
    order = np.arange(len(keys)).astype(np.int32)
    if len(keys):
        keys -= keys.min()  # the bits of positive floats are in the order of the floats
    other_keys, other_order = np.empty_like(keys), np.empty_like(order)
    while len(keys) and keys.max() >> shift > 0:
        # places[d] becomes the number of keys with a smaller digit: where digit d begins.
        places = np.zeros(mask + 2, np.int64)
        for key in keys:
            places[((key >> shift) & mask) + 1] += 1
        for digit in range(mask):
            places[digit + 1] += places[digit]
        for i in range(len(keys)):
            digit = (keys[i] >> shift) & mask
            place = places[digit]
            places[digit] = place + 1
            other_keys[place], other_order[place] = keys[i], order[i]
        keys, other_keys, order, other_order = other_keys, keys, other_order, order
        shift += _BITS
    return order


@kernel
def _measure(
    first: int, last: int, centers: Array, factors: Array, covariances: Array, opacities: Array, height: int,
    ellipses: Array, strips: Array,
) -> None:  # fmt: skip
    """Collect what `_find_spans` needs of every ellipse, and count its rows of tiles.

    An ellipse's values are adjacent: taken nearest first, ellipses are scattered over memory; cache
    misses dominate.
    """
    size = f4(height)
    for i in range(first, last):
        x, y, limit = centers[i, 0], centers[i, 1], _squared_radius(opacities[i])
        # The ellipse x' inverse(covariance) x = limit spans sqrt(limit yy) in y.
        reach = math.sqrt(limit * covariances[i, 2])
        top, bottom = _first_pixel(y - reach, size), _last_pixel(y + reach, size)
        row = np.int32(top) // TILE
        strips[i] = np.int32(bottom) // TILE - row + 1 if bottom >= top else 0
        ellipse = ellipses[i]
        ellipse[0], ellipse[1], ellipse[5], ellipse[7] = x, y, limit, f4(row)
        ellipse[2], ellipse[3], ellipse[4] = factors[i, 0], factors[i, 1], factors[i, 2]
        # dy where it is furthest right
        ellipse[6] = covariances[i, 1] * math.sqrt(limit / covariances[i, 0])


@kernel
def _find_spans(
    first: int, last: int, order: Array, ellipses: Array, width: int, height: int, strips: Array, spans: Array,
    entries: Array,
) -> None:  # fmt: skip
    """Find the interval of tiles that an ellipse covers in each of its rows of tiles."""
    columns = (width + TILE - 1) // TILE
    for place in range(first, last):
        prefetch(ellipses[order[min(place + 8, len(order) - 1)]])
        i = order[place]
        x, y, a, b, c, limit, tip, top = ellipses[i]
        row, total = np.int32(top), 0
        for strip in range(strips[place], strips[place + 1]):
            # The strip holds the pixel centers from upper to lower, relative to the mean. Its
            # leftmost and rightmost points of the ellipse are at the tips, if these are inside,
            # else at the nearer border: there x solves (a dx + b dy)^2 + (c dy)^2 = limit.
            upper = f4(row * TILE) + _HALF - y
            lower = min(f4(row * TILE) + (_TILE - _HALF), f4(height) - _HALF) - y
            to_left, to_right = min(max(-tip, upper), lower), min(max(tip, upper), lower)
            half_left = math.sqrt(max(_ZERO, limit - (c * to_left) * (c * to_left)))
            half_right = math.sqrt(max(_ZERO, limit - (c * to_right) * (c * to_right)))
            left = _first_pixel(x - (half_left + b * to_left) / a, f4(width))
            right = _last_pixel(x + (half_right - b * to_right) / a, f4(width))
            spans[strip, 0] = row * columns + np.int32(left) // TILE
            spans[strip, 1] = row * columns + np.int32(right) // TILE + 1 if right >= left else spans[strip, 0]
            total += spans[strip, 1] - spans[strip, 0]
            row += 1
        entries[i] = total


@kernel
def _walk(
    first: int, last: int, order: Array, strips: Array, spans: Array, offsets: Array, places: Array, gaussians: Array,
    slots: Array,
) -> None:  # fmt: skip
    """Append Gaussians to the lists of their tiles; without lists, only count them."""
    fill = gaussians.shape[0] > 0
    for part in range(first, last):
        at = places[part]
        for place in range(part * order.shape[0] // _PARTS, (part + 1) * order.shape[0] // _PARTS):
            prefetch(offsets[order[min(place + 8, len(order) - 1)] :])
            i = order[place]
            slot = offsets[i]
            for strip in range(strips[place], strips[place + 1]):
                for tile in range(spans[strip, 0], spans[strip, 1]):
                    if fill:
                        gaussians[at[tile]] = i
                        slots[at[tile]] = slot
                    at[tile] += 1
                    slot += 1


def _ends(counts: Array) -> Array:
    """Return where each consecutive group starts, and where the last ends."""
    result = np.zeros(counts.shape[0] + 1, np.int64)
    np.cumsum(counts, out=result[1:])
    return result


def bin_gaussians(projected: Projected, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile, see `Engine.bin`."""
    m, f, c, z = (x.detach().numpy() for x in projected.projection)
    o = projected.opacities.detach().contiguous().numpy()  # if all are in view, those that were given
    count, tiles, order = m.shape[0], -(-width // TILE) * -(-height // TILE), _nearest_first(z)
    ellipses, of_rows, entries = np.empty((count, 8), f4), np.empty(count, np.int32), np.empty(count, np.int32)
    in_threads(_measure, count, m, f, c, o, height, ellipses, of_rows, least=8192)
    strips = _ends(of_rows[order])
    spans = np.empty((strips[-1], 2), np.int32)
    in_threads(_find_spans, count, order, ellipses, width, height, strips, spans, entries, least=4096)
    # Twice over the same lists: once to count the entries of every tile, once to fill them in. The
    # parts of the depth order have places of their own within a tile, so they may be filled in
    # parallel.
    offsets, of_parts, nothing = _ends(entries), np.zeros((_PARTS, tiles), np.int64), np.empty(0, np.int32)
    least = -(-_PARTS * 4096 // max(1, count))  # parts that are worth a thread
    in_threads(_walk, _PARTS, order, strips, spans, offsets, of_parts, nothing, nothing, least=least)
    starts = _ends(of_parts.sum(0))
    places = starts[:-1] + of_parts.cumsum(0) - of_parts
    gaussians, slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    in_threads(_walk, _PARTS, order, strips, spans, offsets, places, gaussians, slots, least=least)
    arrays = (torch.from_numpy(x) for x in (starts, gaussians, entries > 0, slots, offsets))
    return TileLists(width, height, *arrays)
