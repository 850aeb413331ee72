"""Which Gaussian touches which tile, by counting instead of sorting.

Gaussians, which are in order of depth, are each in turn appended to the lists of their tiles: a list is in that order
because it was written in it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.compiled.compiling import inlined, kernel
from reference_trainer.compiled.threads import in_threads
from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.render.splats import Projection, TileLists

__all__ = ["bin_gaussians"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _TWO, _HALF = f4(0), f4(1), f4(2), f4(0.5)
_MIN, _TILE = f4(MIN_ALPHA), f4(TILE)
_PARTS = 8  # of the Gaussians, each with a count of its own of every tile, so that they can be filled at once


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
    height: int, rows: Array, strips: Array, spans: Array, entries: Array, counts: Array,
) -> None:  # fmt: skip
    """Find the tiles of every strip, in which an ellipse covers an interval; count the entries of every tile."""
    columns = (width + TILE - 1) // TILE
    for part in range(first, last):
        count = counts[part]
        for i in range(part * rows.shape[0] // _PARTS, (part + 1) * rows.shape[0] // _PARTS):
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
                begin = row * columns + np.int32(left) // TILE
                end = row * columns + np.int32(right) // TILE + 1 if right >= left else begin
                spans[strip, 0], spans[strip, 1] = begin, end
                for tile in range(begin, end):
                    count[tile] += 1
                total += end - begin
            entries[i] = total


@kernel
def _fill_lists(
    first: int, last: int, strips: Array, spans: Array, offsets: Array, places: Array, gaussians: Array, slots: Array
) -> None:
    """Append the Gaussians to the lists of their tiles."""
    count = strips.shape[0] - 1
    for part in range(first, last):
        at = places[part]
        for i in range(part * count // _PARTS, (part + 1) * count // _PARTS):
            slot = offsets[i]
            for strip in range(strips[i], strips[i + 1]):
                for tile in range(spans[strip, 0], spans[strip, 1]):
                    gaussians[at[tile]] = i
                    slots[at[tile]] = slot
                    at[tile] += 1
                    slot += 1


def _ends(counts: Array) -> Array:
    """Return where each of consecutive groups starts, and where the last ends."""
    result = np.zeros(counts.shape[0] + 1, np.int64)
    np.cumsum(counts, out=result[1:])
    return result


def bin_gaussians(projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile: those whose 1/255 ellipse meets the rectangle of the tile's pixel centres.

    The M projected Gaussians are in order of depth, the opacities (M,) activated.
    """
    m, f, c, _ = (x.detach().numpy() for x in projection)
    o = opacities.detach().numpy()
    count, tiles = m.shape[0], -(-width // TILE) * -(-height // TILE)
    rows, of_rows, entries = (np.empty(count, np.int32) for _ in range(3))
    in_threads(_count_strips, count, m, c, o, height, rows, of_rows, least=8192)
    strips, of_parts = _ends(of_rows), np.zeros((_PARTS, tiles), np.int64)
    spans = np.empty((strips[-1], 2), np.int32)
    least = -(-_PARTS * 4096 // max(1, count))  # parts that are worth a thread
    in_threads(_find_spans, _PARTS, m, f, c, o, width, height, rows, strips, spans, entries, of_parts, least=least)
    starts, offsets = _ends(of_parts.sum(0)), _ends(entries)
    places = starts[:-1] + of_parts.cumsum(0) - of_parts
    gaussians, slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    in_threads(_fill_lists, _PARTS, strips, spans, offsets, places, gaussians, slots, least=least)
    arrays = (torch.from_numpy(x) for x in (starts, gaussians, entries > 0, slots, offsets))
    return TileLists(width, height, *arrays)
