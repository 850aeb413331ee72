"""Loops of multi-view stereo: matching costs on planes, their aggregation, and slanted refinement.

Everything is in one picture's pixels and inverse depths (one over the depth along its camera's z axis), float32. A
map (3, 4) takes a pixel ``(x, y, 1)`` with inverse depth ``w`` to homogeneous pixels of another picture, whose third
component is the depth there times ``w``. Every result is the same for any number of threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from reference_trainer.compiled.compiling import inlined, kernel

__all__ = ["NARROW", "STRIP", "WIDE", "aggregate", "refine", "sweep"]

Array = Any
f4 = np.float32
STRIP = 32
"""Rows that `sweep` works on at a time, so that their costs stay in the processor's cache."""
NARROW, WIDE = 1, 4
"""Half the widths of the two windows of the sweep: the narrow one keeps edges, the wide one finds faint texture."""
STEPS = 2  # samples on each side of a slanted window's middle, STRIDE pixels apart
STRIDE = 2
SAMPLES = (2 * STEPS + 1) ** 2
_ZERO, _HALF, _ONE, _TWO = f4(0), f4(0.5), f4(1), f4(2)
_NOISE = f4((1.5 / 255) ** 2)  # a variance this small is noise: it drives the correlation of flat windows to 0
_UNSEEN = f4(-2)
_BEST = f4(0.6)  # weight of the better of several source views, for one of them may be hidden


@inlined
def _bilinear(image: Array, x: Any, y: Any, width: Any, height: Any) -> Any:
    """Return a picture's value at a pixel position (centers at halves), that of the border outside."""
    x = min(max(x - _HALF, _ZERO), f4(width) - f4(1.001))
    y = min(max(y - _HALF, _ZERO), f4(height) - f4(1.001))
    j, i = np.int32(x), np.int32(y)
    u, v = x - f4(j), y - f4(i)
    left, up = np.uint64(j), np.uint64(i)  # unsigned: an index below 0 would count from the end, which takes a test
    right, down = left + np.uint64(1), up + np.uint64(1)
    top = image[up, left] + u * (image[up, right] - image[up, left])
    bottom = image[down, left] + u * (image[down, right] - image[down, left])
    return top + v * (bottom - top)


@kernel
def sweep(
    first: int, last: int, reference: Array, means: Array, variances: Array, sources: Array, sizes: Array, maps: Array,
    inverses: Array, cost: Array,
) -> None:  # fmt: skip
    """Fill ``cost`` (H, W, D), in [0, 1], for D planes of constant inverse depth; items are strips of `STRIP` rows.

    It is half of one minus the normalized cross-correlation, averaged over the two windows; ``means`` and
    ``variances`` (2, H, W) are the reference's in these.
    """
    height, width = reference.shape
    count = len(sources)
    most = STRIP + 2 * WIDE
    warped, inside = np.empty((most, width), f4), np.empty((most, width), np.uint8)
    found = np.empty((count, STRIP, width), f4)
    sums = np.empty((3, width + 2 * WIDE + 1), f4)
    for strip in range(first, last):
        top, bottom = strip * STRIP, min(strip * STRIP + STRIP, height)
        above, below = max(top - WIDE, 0), min(bottom + WIDE, height)
        for d in range(len(inverses)):
            w = inverses[d]
            for s in range(count):
                m, rows, columns = maps[s], sizes[s, 0], sizes[s, 1]
                for y in range(above, below):
                    py = f4(y) + _HALF
                    hx = m[0, 1] * py + m[0, 2] + m[0, 3] * w
                    hy = m[1, 1] * py + m[1, 2] + m[1, 3] * w
                    hz = m[2, 1] * py + m[2, 2] + m[2, 3] * w
                    for x in range(width):
                        px = f4(x) + _HALF
                        z = hz + m[2, 0] * px
                        inverse = _ONE / max(z, f4(1e-6))
                        qx, qy = (hx + m[0, 0] * px) * inverse, (hy + m[1, 0] * px) * inverse
                        inside[y - above, x] = z > f4(1e-6) and _ZERO <= qx < f4(columns) and _ZERO <= qy < f4(rows)
                        warped[y - above, x] = _bilinear(sources[s], qx, qy, columns, rows)
                found[s] = _ZERO
                for window in range(2):
                    r = NARROW if window == 0 else WIDE
                    for y in range(top, bottom):
                        low, high = max(y - r, 0), min(y + r + 1, height)
                        sums[:] = _ZERO
                        for row in range(low, high):
                            for x in range(width):
                                value = warped[row - above, x]
                                sums[0, WIDE + 1 + x] += value
                                sums[1, WIDE + 1 + x] += value * value
                                sums[2, WIDE + 1 + x] += value * reference[row, x]
                        a = b = c = _ZERO
                        for x in range(r):
                            a, b, c = a + sums[0, WIDE + 1 + x], b + sums[1, WIDE + 1 + x], c + sums[2, WIDE + 1 + x]
                        for x in range(width):
                            new, old = WIDE + 1 + x + r, WIDE + x - r
                            if x + r < width:
                                a, b, c = a + sums[0, new], b + sums[1, new], c + sums[2, new]
                            a, b, c = a - sums[0, old], b - sums[1, old], c - sums[2, old]
                            share = _ONE / f4((high - low) * (min(x + r + 1, width) - max(x - r, 0)))
                            mean = a * share
                            spread = max(b * share - mean * mean, _ZERO) + _NOISE
                            together = c * share - mean * means[window, y, x]
                            own = variances[window, y, x] + _NOISE
                            found[s, y - top, x] += _HALF * together / math.sqrt(spread * own)
                for y in range(top, bottom):
                    for x in range(width):
                        if not inside[y - above, x]:
                            found[s, y - top, x] = _UNSEEN
            for y in range(top, bottom):
                for x in range(width):
                    score, seen = _mixed(found[:, y - top, x])
                    cost[y, x, d] = _HALF - _HALF * score if seen > 0 else _HALF


@inlined
def _mixed(scores: Array) -> Any:
    """Return the correlation over all sources that see a pixel, more of the best, and their number."""
    best, total, seen = _UNSEEN, _ZERO, 0
    for s in range(len(scores)):
        if scores[s] > _UNSEEN:
            best, total, seen = max(best, scores[s]), total + scores[s], seen + 1
    if seen > 1:
        best = _BEST * best + (_ONE - _BEST) * (total - best) / f4(seen - 1)
    return best, seen


@kernel
def aggregate(
    first: int, last: int, dy: int, dx: int, image: Array, cost: Array, total: Array, small: Any, large: Any
) -> None:
    """Add to ``total`` (H, W, D) the costs along parallel paths of one direction; items are the paths.

    Semi-global matching (Hirschmueller, 2008, equation 13): a step to the next plane costs ``small``, one to any other
    ``large``, less across edges of the picture. There are H, W or H + W - 1 paths.
    """
    height, width, planes = cost.shape
    one, other = np.empty(planes + 2, f4), np.empty(planes + 2, f4)
    lanes = np.empty(16, f4)
    for path in range(first, last):
        if dy == 0:
            y, x = path, 0 if dx > 0 else width - 1
        else:
            side = max(path - width + 1, 0)
            y = side if dy > 0 else height - 1 - side
            x = path if path < width else (0 if dx > 0 else width - 1)
        before, now = one, other
        before[:] = _ZERO
        jump, least, value = _ZERO, _ZERO, image[y, x]
        while 0 <= y < height and 0 <= x < width:
            step = abs(image[y, x] - value)
            value = image[y, x]
            jump = least + max(large / (_ONE + f4(20) * step), _TWO * small)
            costs, totals = cost[y, x], total[y, x]
            for d in range(planes):
                a = before[d] if before[d] < before[d + 2] else before[d + 2]
                a = a + small
                a = a if a < before[d + 1] else before[d + 1]
                now[d + 1] = costs[d] + ((a if a < jump else jump) - least)
            for d in range(planes):
                totals[d] += now[d + 1]
            # Minima of 16 lanes first, which the compiler turns into vector instructions, unlike a reduction.
            lanes[:] = f4(1e9)
            for block in range(planes // 16):
                for lane in range(16):
                    v = now[1 + 16 * block + lane]
                    lanes[lane] = v if v < lanes[lane] else lanes[lane]
            least = f4(1e9)
            for lane in range(16):
                least = min(least, lanes[lane])
            now[0] = now[planes + 1] = f4(1e9)
            before, now = now, before
            y, x = y + dy, x + dx


@kernel
def refine(
    first: int, last: int, reference: Array, sources: Array, sizes: Array, maps: Array, step: Any, reach: int,
    ends: Array, old: Array, new: Array, scores: Array,
) -> None:  # fmt: skip
    """Improve the slanted planes (3, H, W) of pixels, from those of neighbors and by small changes; items are rows.

    As in PatchMatch stereo (Bleyer et al., 2011), but from a good start, with changes of ``step`` in inverse depth
    instead of random ones, and from ``old`` to ``new``, so that no order of pixels matters. Slopes are inverse depth
    per pixel: on a plane in space they are constant. ``scores`` (H, W) receives the correlation; windows are weighted
    by similarity to their middle.
    """
    height, width = reference.shape
    values, weights = np.empty(SAMPLES, f4), np.empty(SAMPLES, f4)
    found = np.empty(len(sources), f4)
    tilt = step / f4(STEPS * STRIDE)
    for y in range(first, last):
        for x in range(width):
            middle, n = reference[y, x], 0
            total = mean = spread = _ZERO
            for j in range(-STEPS, STEPS + 1):
                for i in range(-STEPS, STEPS + 1):
                    v = reference[min(max(y + STRIDE * j, 0), height - 1), min(max(x + STRIDE * i, 0), width - 1)]
                    values[n] = v
                    weights[n] = math.exp(-abs(v - middle) * f4(8) - f4(i * i + j * j) / f4(2 * STEPS * STEPS))
                    n += 1
            for n in range(SAMPLES):
                total, mean = total + weights[n], mean + weights[n] * values[n]
            mean /= total
            for n in range(SAMPLES):
                weights[n] /= total
                values[n] -= mean
                spread += weights[n] * values[n] * values[n]
            w, gx, gy, best = _ZERO, _ZERO, _ZERO, _UNSEEN
            for trial in range(11):
                tw, tx, ty = w, gx, gy
                if trial < 5:  # its own plane, then those of four neighbors
                    j = reach * ((trial == 1) - (trial == 2))
                    i = reach * ((trial == 3) - (trial == 4))
                    if not (0 <= y + j < height and 0 <= x + i < width):
                        continue
                    tx, ty = old[1, y + j, x + i], old[2, y + j, x + i]
                    tw = old[0, y + j, x + i] - tx * f4(i) - ty * f4(j)
                    if old[0, y + j, x + i] == _ZERO:
                        continue
                elif best == _UNSEEN:
                    break
                elif trial < 7:
                    tw += step if trial == 5 else -step
                elif trial < 9:
                    tx += tilt if trial == 7 else -tilt
                else:
                    ty += tilt if trial == 9 else -tilt
                if not ends[0] < tw < ends[1]:
                    continue
                for s in range(len(sources)):
                    found[s] = _slanted(
                        maps[s], sources[s], sizes[s, 0], sizes[s, 1], x, y, tw, tx, ty, values, weights, spread
                    )
                score, seen = _mixed(found)
                if seen > 0 and score > best:
                    w, gx, gy, best = tw, tx, ty, score
            new[0, y, x], new[1, y, x], new[2, y, x], scores[y, x] = w, gx, gy, best


@inlined
def _slanted(
    m: Array, source: Array, rows: Any, columns: Any, x: Any, y: Any, w: Any, gx: Any, gy: Any, values: Array,
    weights: Array, spread: Any,
) -> Any:  # fmt: skip
    """Return the weighted correlation of a window on a slanted plane, -2 if the source does not see its middle."""
    px, py = f4(x) + _HALF, f4(y) + _HALF
    hx = m[0, 0] * px + m[0, 1] * py + m[0, 2] + m[0, 3] * w
    hy = m[1, 0] * px + m[1, 1] * py + m[1, 2] + m[1, 3] * w
    hz = m[2, 0] * px + m[2, 1] * py + m[2, 2] + m[2, 3] * w
    result = _UNSEEN
    if hz > f4(1e-6) and _ZERO <= hx < hz * f4(columns) and _ZERO <= hy < hz * f4(rows):
        # Homogeneous pixels are linear in the offset from the middle, with the plane's slope in the last column.
        xx, xy = f4(STRIDE) * (m[0, 0] + m[0, 3] * gx), f4(STRIDE) * (m[0, 1] + m[0, 3] * gy)
        yx, yy = f4(STRIDE) * (m[1, 0] + m[1, 3] * gx), f4(STRIDE) * (m[1, 1] + m[1, 3] * gy)
        zx, zy = f4(STRIDE) * (m[2, 0] + m[2, 3] * gx), f4(STRIDE) * (m[2, 1] + m[2, 3] * gy)
        mean = square = together = _ZERO
        n = 0
        for j in range(-STEPS, STEPS + 1):
            for i in range(-STEPS, STEPS + 1):
                inverse = _ONE / max(hz + f4(i) * zx + f4(j) * zy, f4(1e-6))
                qx, qy = (hx + f4(i) * xx + f4(j) * xy) * inverse, (hy + f4(i) * yx + f4(j) * yy) * inverse
                v = _bilinear(source, qx, qy, columns, rows)
                weighted = weights[n] * v
                mean, square, together = mean + weighted, square + weighted * v, together + weighted * values[n]
                n += 1
        result = together / math.sqrt((max(square - mean * mean, _ZERO) + _NOISE) * (spread + _NOISE))
    return result
