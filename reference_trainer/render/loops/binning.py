"""Which Gaussian touches which tile, by counting instead of sorting.

Gaussians are put in order of depth by a radix sort, and then each in turn appended to the lists of its tiles: a list
is in order of depth because it was written in it. All that is kept of them on the way stands in that order too, so that
memory is read from one end to the other.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.compiled.compiling import inlined, kernel
from reference_trainer.compiled.threads import in_threads
from reference_trainer.render.splats import Projection, TileLists

__all__ = ["bin_gaussians"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _TWO, _HALF = f4(0), f4(1), f4(2), f4(0.5)
_MIN, _TILE = f4(MIN_ALPHA), f4(TILE)
_PARTS = 8  # of the order of depth, each with a count of its own of every tile, so that they can be filled at once
_BITS = 11  # of a digit of the radix sort: three make a float32


@inlined
def _first_pixel(x: Any, size: Any) -> Any:
    """Return the first pixel whose centre is at x or beyond it; in [0, size]."""
    return max(_ZERO, min(size, np.ceil(x - _HALF)))


@inlined
def _last_pixel(x: Any, size: Any) -> Any:
    """Return the last pixel whose centre is at x or before it; in [-1, size - 1]."""
    return max(-_ONE, min(size - _ONE, np.floor(x - _HALF)))


@inlined
def _squared_radius(opacity: Any) -> Any:
    """Return the squared Mahalanobis distance at which alpha is `MIN_ALPHA`."""
    return _TWO * max(_ZERO, math.log(opacity / _MIN))


@kernel
def _sort_by_depth(depths: Array) -> Any:
    """Return the order of positive depths, nearest first; equal ones stay in order."""
    count, mask = depths.shape[0], (1 << _BITS) - 1
    keys, order = depths.view(np.uint32).copy(), np.arange(count).astype(np.int32)
    other_keys, other_order = np.empty_like(keys), np.empty_like(order)
    for shift in range(0, 3 * _BITS, _BITS):  # the bits of positive floats are in the order of the floats
        places = np.zeros(mask + 2, np.int64)
        for i in range(count):
            places[((keys[i] >> shift) & mask) + 1] += 1
        for digit in range(mask):
            places[digit + 1] += places[digit]
        for i in range(count):
            digit = (keys[i] >> shift) & mask
            place = places[digit]
            places[digit] = place + 1
            other_keys[place], other_order[place] = keys[i], order[i]
        keys, other_keys, order, other_order = other_keys, keys, other_order, order
    return order


@kernel
def _count_strips(
    first: int, last: int, centers: Array, covariances: Array, opacities: Array, height: int, rows: Array, counts: Array
) -> None:
    """Find the first row of tiles that each ellipse touches, and how many."""
    size = f4(height)
    for i in range(first, last):
        reach = math.sqrt(_squared_radius(opacities[i]) * covariances[i, 2])
        top, bottom = _first_pixel(centers[i, 1] - reach, size), _last_pixel(centers[i, 1] + reach, size)
        rows[i] = np.int32(top) // TILE
        counts[i] = np.int32(bottom) // TILE - rows[i] + 1 if bottom >= top else 0


@kernel
def _find_spans(
    first: int, last: int, centers: Array, factors: Array, covariances: Array, opacities: Array, width: int,
    height: int, rows: Array, strips: Array, spans: Array, entries: Array,
) -> None:  # fmt: skip
    """Find the tiles of every strip: within one, an ellipse covers an interval of columns."""
    columns = (width + TILE - 1) // TILE
    for i in range(first, last):
        x, y = centers[i, 0], centers[i, 1]
        a, b, c = factors[i, 0], factors[i, 1], factors[i, 2]
        limit = _squared_radius(opacities[i])
        tip = covariances[i, 1] * math.sqrt(limit / covariances[i, 0])  # the dy at which it reaches furthest right
        total = 0
        for strip in range(strips[i], strips[i + 1]):
            row = rows[i] + strip - strips[i]
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
        entries[i] = total


@kernel
def _put_in_order(
    first: int, last: int, order: Array, begins: Array, spans: Array, strips: Array, ordered: Array, slots: Array,
    counts: Array,
) -> None:  # fmt: skip
    """Copy the spans in order of depth, which is random access, once; count the entries of every tile, by parts."""
    for part in range(first, last):
        count = counts[part]
        for place in range(part * order.shape[0] // _PARTS, (part + 1) * order.shape[0] // _PARTS):
            i = order[place]
            slots[place] = begins[i, 1]
            source = begins[i, 0]
            for strip in range(strips[place], strips[place + 1]):
                begin, end = spans[source, 0], spans[source, 1]
                ordered[strip, 0], ordered[strip, 1] = begin, end
                for tile in range(begin, end):
                    count[tile] += 1
                source += 1


@kernel
def _fill_lists(
    first: int, last: int, order: Array, strips: Array, spans: Array, firsts: Array, places: Array, gaussians: Array,
    slots: Array,
) -> None:  # fmt: skip
    """Append the Gaussians to the lists of their tiles."""
    for part in range(first, last):
        at = places[part]
        for place in range(part * order.shape[0] // _PARTS, (part + 1) * order.shape[0] // _PARTS):
            i, slot = order[place], firsts[place]
            for strip in range(strips[place], strips[place + 1]):
                for tile in range(spans[strip, 0], spans[strip, 1]):
                    gaussians[at[tile]] = i
                    slots[at[tile]] = slot
                    at[tile] += 1
                    slot += 1


def _ends(counts: Array) -> Array:
    """Return where each of consecutive groups starts, and where the last ends."""
    result = np.zeros((counts.shape[0] + 1, *counts.shape[1:]), np.int64)
    np.cumsum(counts, axis=0, out=result[1:])
    return result


def bin_gaussians(projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile: those whose 1/255 ellipse meets the rectangle of the tile's pixel centres.

    Args:
        projection: M projected Gaussians.
        opacities: activated, shape (M,).
        width: image width, pixels.
        height: image height, pixels.
    """
    m, f, c, z = (x.detach().numpy() for x in projection)
    o = opacities.detach().numpy()
    count, tiles, order = m.shape[0], -(-width // TILE) * -(-height // TILE), _sort_by_depth(z)
    rows, counts = np.empty(count, np.int32), np.empty((count, 2), np.int32)  # of each the strips, and the entries
    in_threads(_count_strips, count, m, c, o, height, rows, counts[:, 0], least=8192)
    strips = _ends(counts[:, 0])
    spans = np.empty((strips[-1], 2), np.int32)
    in_threads(_find_spans, count, m, f, c, o, width, height, rows, strips, spans, counts[:, 1], least=4096)

    begins, strips, ordered = _ends(counts), _ends(counts[order, 0]), np.empty_like(spans)
    firsts, of_parts = np.empty(count, np.int64), np.zeros((_PARTS, tiles), np.int64)
    parts = -(-_PARTS * 4096 // max(1, count))  # that are worth a thread
    in_threads(_put_in_order, _PARTS, order, begins, spans, strips, ordered, firsts, of_parts, least=parts)
    starts = _ends(of_parts.sum(0))
    places = starts[:-1] + of_parts.cumsum(0) - of_parts
    gaussians, slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    in_threads(_fill_lists, _PARTS, order, strips, ordered, firsts, places, gaussians, slots, least=parts)
    return TileLists(
        width=width,
        height=height,
        starts=torch.from_numpy(starts),
        gaussians=torch.from_numpy(gaussians),
        touched=torch.from_numpy(counts[:, 1] > 0),
        slots=torch.from_numpy(slots),
        offsets=torch.from_numpy(begins[:, 1].copy()),
    )
