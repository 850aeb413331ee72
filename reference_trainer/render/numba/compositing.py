"""The loop over a tile: front-to-back compositing of its list, and its gradient.

A pixel sees ``C = sum_i T_i a_i c_i + T_end b``: colors c, alphas a, background b, and
transmittances ``T_i = prod_{j<i} (1 - a_j)``. Its transmittance is kept as a negative number from
the splat on that terminates it (`MIN_TRANSMITTANCE`).

The backward pass needs, for every splat, ``dC / da_i = T_i c_i - B_i / (1 - a_i)``, where B_i is
the light from behind it, background included, which the splat dims by 1 - a_i. It goes front to
back as well: B_i is the image less the light of all splats that have been passed, so nothing is
stored per splat, and every alpha is evaluated once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.compiled.compiling import inlined, kernel, prefetch
from reference_trainer.render.constants import MIN_TRANSMITTANCE
from reference_trainer.render.numba import tiles
from reference_trainer.render.numba.tiles import CHUNK, LEAST_ALPHA, PIXELS
from reference_trainer.render.splats import Splats

__all__ = ["absolute_gradients", "composite", "composite_masks"]

Array = Any
f4 = np.float32
_ZERO, _ONE, _MIN_TRANSMITTANCE = f4(0), f4(1), f4(MIN_TRANSMITTANCE)

# Offsets into a tile's state. All values of the pixels share one array, so that the compiler sees
# that nothing overlaps; with an array for each it would not vectorize: four times slower.
_TRANSMITTANCE, _RED, _GREEN, _BLUE, _DEPTH, _BEHIND, _SLOPE = (i * PIXELS for i in range(7))


@inlined
def _pass(alpha: Any, transmittance: Any) -> Any:
    """Return the weight of a splat, and the transmittance behind it."""
    # Without a branch, so that eight pixels or more are one instruction. A terminated pixel, whose
    # transmittance is negative, has a negative rest: it stays terminated and takes no more weight.
    rest = transmittance * (_ONE - alpha)
    goes_on = rest >= _MIN_TRANSMITTANCE
    return alpha * transmittance if goes_on else _ZERO, rest if goes_on else -abs(transmittance)


@inlined
def _have_ended(state: Any) -> Any:
    most = state[_TRANSMITTANCE]
    for p in range(PIXELS):
        most = state[_TRANSMITTANCE + p] if state[_TRANSMITTANCE + p] > most else most
    return most < _ZERO


@inlined
def _finish(state: Any, background: Any, transmittance: Any, image: Any, tile: Any, columns: Any) -> None:
    """Put the background behind a tile, and the tile into the picture."""
    for p in range(PIXELS):
        through = abs(state[_TRANSMITTANCE + p])
        state[_TRANSMITTANCE + p] = through
        state[_RED + p] += through * background[0]
        state[_GREEN + p] += through * background[1]
        state[_BLUE + p] += through * background[2]
    tiles.store(state, _TRANSMITTANCE, transmittance, tile, columns)
    tiles.store(state, _RED, image, tile, columns)


def _make_forward(depth: bool) -> Any:
    """Return the kernel of the image, with depth as its fourth channel if asked for."""

    @kernel
    def _forward(
        first: int, last: int, columns: int, starts: Array, gaussians: Array, table: Array, background: Array,
        transmittance: Array, image: Array,
    ) -> None:  # fmt: skip
        s, entries = np.empty((5 if depth else 4) * PIXELS, f4), np.empty((CHUNK + 1, 10 if depth else 9), f4)
        for tile in range(first, last):
            s[:] = _ZERO
            s[_TRANSMITTANCE : _TRANSMITTANCE + PIXELS] = _ONE
            for begin in range(starts[tile], starts[tile + 1], CHUNK):
                end = min(begin + CHUNK, starts[tile + 1])
                # Two splats at a time: the sums of a pixel are then loaded and stored half as often.
                for k in range(0, tiles.read_entries(gaussians, begin, end, 1, table, tile, columns, entries), 2):
                    a, b = entries[k], entries[k + 1]
                    shape_a, shape_b = tiles.footprint_of(a), tiles.footprint_of(b)
                    red_a, green_a, blue_a, red_b, green_b, blue_b = a[6], a[7], a[8], b[6], b[7], b[8]
                    depth_a, depth_b = (a[9], b[9]) if depth else (_ZERO, _ZERO)
                    for p in range(PIXELS):
                        weight_a, between = _pass(tiles.clamped(tiles.alpha_at(shape_a, p)), s[_TRANSMITTANCE + p])
                        weight_b, rest = _pass(tiles.clamped(tiles.alpha_at(shape_b, p)), between)
                        s[_RED + p] += weight_a * red_a + weight_b * red_b
                        s[_GREEN + p] += weight_a * green_a + weight_b * green_b
                        s[_BLUE + p] += weight_a * blue_a + weight_b * blue_b
                        if depth:
                            s[_DEPTH + p] += weight_a * depth_a + weight_b * depth_b
                        s[_TRANSMITTANCE + p] = rest
                if _have_ended(s):
                    break
            _finish(s, background, transmittance, image, tile, columns)

    return _forward


_forward, _forward_with_depth = _make_forward(False), _make_forward(True)


@inlined
def _lowered(alpha: Any, factor: Any) -> Any:
    """Return an alpha times a factor, cut off and clamped like any alpha."""
    lower = alpha * factor
    return tiles.clamped(lower) if lower >= LEAST_ALPHA else _ZERO


@kernel
def _masked(
    first: int, last: int, columns: int, starts: Array, gaussians: Array, table: Array, background: Array,
    transmittances: Array, images: Array,
) -> None:  # fmt: skip
    """Composite K images of the same lists; table columns from 9 on are factors on alphas."""
    count = images.shape[0]
    states, ended, visible = np.empty((count, 4 * PIXELS), f4), np.empty(count, np.bool_), np.empty(CHUNK + 1, np.int64)
    entries, alphas = np.empty((CHUNK + 1, table.shape[1]), f4), np.empty((CHUNK + 1, PIXELS), f4)
    for tile in range(first, last):
        states[:] = _ZERO
        states[:, _TRANSMITTANCE : _TRANSMITTANCE + PIXELS] = _ONE
        ended[:] = False
        for begin in range(starts[tile], starts[tile + 1], CHUNK):
            if ended.all():
                break
            end = min(begin + CHUNK, starts[tile + 1])
            last_entry = tiles.read_entries(gaussians, begin, end, 1, table, tile, columns, entries)
            # The alphas of the full model are shared by all images; a mask only multiplies them.
            for k in range(last_entry + 1):
                shape, of_entry = tiles.footprint_of(entries[k]), alphas[k]
                for p in range(PIXELS):
                    of_entry[p] = tiles.alpha_at(shape, p)
            for mask in range(count):
                if ended[mask]:
                    continue
                s, shown = states[mask], 0
                for k in range(last_entry):
                    visible[shown] = k
                    shown += entries[k, 9 + mask] > _ZERO
                visible[shown] = last_entry  # an invisible one
                for k in range(0, shown, 2):
                    a, b = entries[visible[k]], entries[visible[k + 1]]
                    alpha_a, alpha_b = alphas[visible[k]], alphas[visible[k + 1]]
                    red_a, green_a, blue_a, red_b, green_b, blue_b = a[6], a[7], a[8], b[6], b[7], b[8]
                    factor_a, factor_b = a[9 + mask], b[9 + mask]
                    for p in range(PIXELS):
                        weight_a, between = _pass(_lowered(alpha_a[p], factor_a), s[_TRANSMITTANCE + p])
                        weight_b, rest = _pass(_lowered(alpha_b[p], factor_b), between)
                        s[_RED + p] += weight_a * red_a + weight_b * red_b
                        s[_GREEN + p] += weight_a * green_a + weight_b * green_b
                        s[_BLUE + p] += weight_a * blue_a + weight_b * blue_b
                        s[_TRANSMITTANCE + p] = rest
                ended[mask] = _have_ended(s)
        for mask in range(count):
            _finish(states[mask], background, transmittances[mask], images[mask], tile, columns)


def _make_backward(depth: bool, absolute: bool) -> Any:
    """Return the kernel of the gradients, or that of the absolute gradients of the centers."""

    @kernel
    def _backward(
        first: int, last: int, columns: int, starts: Array, gaussians: Array, slots: Array, table: Array,
        transmittance: Array, image: Array, to_transmittance: Array, to_image: Array, rows: Array,
    ) -> None:  # fmt: skip
        s, d = np.empty(7 * PIXELS, f4), np.empty(5 * PIXELS, f4)
        for tile in range(first, last):
            tiles.load(to_transmittance, tile, columns, s, _TRANSMITTANCE)
            tiles.load(to_image, tile, columns, s, _RED)
            tiles.load(transmittance, tile, columns, d, _TRANSMITTANCE)
            tiles.load(image, tile, columns, d, _RED)
            # Only what the loss sees of the light matters: B_i enters as the number g . B_i, with g
            # the gradient of the pixel. In front of everything it is g . C + (dL / dT_end) T_end,
            # as T_end too shrinks by 1 - a_i.
            for p in range(PIXELS):
                of_colors = s[_RED + p] * d[_RED + p] + s[_GREEN + p] * d[_GREEN + p] + s[_BLUE + p] * d[_BLUE + p]
                s[_BEHIND + p] = of_colors + s[_TRANSMITTANCE + p] * d[_TRANSMITTANCE + p]
                if depth:
                    s[_BEHIND + p] += s[_DEPTH + p] * d[_DEPTH + p]
                s[_TRANSMITTANCE + p] = _ONE
            ended = False
            for e in range(starts[tile], starts[tile + 1]):
                ahead = min(e + 6, len(gaussians) - 1)
                prefetch(table[gaussians[ahead]])
                prefetch(rows[slots[ahead]])
                i = gaussians[e]
                row = rows[slots[e]]
                if ended or tiles.is_faint(table, i):
                    row[:] = _ZERO
                    continue
                polynomial = tiles.footprint(table, i, tile, columns)
                r, g, b, z = table[i, 6], table[i, 7], table[i, 8], table[i, 9] if depth else _ZERO
                to_r, to_g, to_b, to_depth = _ZERO, _ZERO, _ZERO, _ZERO
                for p in range(PIXELS):
                    raw, now = tiles.alpha_at(polynomial, p), s[_TRANSMITTANCE + p]
                    alpha = tiles.clamped(raw)
                    weight, rest = _pass(alpha, now)
                    along = s[_RED + p] * r + s[_GREEN + p] * g + s[_BLUE + p] * b
                    if depth:
                        along += s[_DEPTH + p] * z
                    beyond = s[_BEHIND + p] - weight * along
                    s[_BEHIND + p], s[_TRANSMITTANCE + p] = beyond, rest
                    # raw (T c - B / (1 - alpha)) is the gradient of ln alpha, from which
                    # `footprint_gradient` goes on. alpha is raw but for the clamp, which lets
                    # gradients pass, and at most 0.99, so that the division is safe.
                    s[_SLOPE + p] = raw * (now * along - beyond / (_ONE - alpha)) if rest > _ZERO else _ZERO
                    # dC / dc_i = T_i a_i
                    to_r += weight * s[_RED + p]
                    to_g += weight * s[_GREEN + p]
                    to_b += weight * s[_BLUE + p]
                    if depth:
                        to_depth += weight * s[_DEPTH + p]
                if absolute:
                    row[0], row[1] = tiles.absolute_slopes(table, i, tile, columns, s[_SLOPE:])
                else:
                    tiles.footprint_gradient(table, i, tile, columns, s[_SLOPE:], row)
                    row[6], row[7], row[8] = to_r, to_g, to_b
                    if depth:
                        row[9] = to_depth
                # Asking all pixels is not free, hence not after each splat.
                if e % CHUNK == 0:
                    ended = _have_ended(s)

    return _backward


_backward, _backward_with_depth = _make_backward(False, False), _make_backward(True, False)
_absolute = _make_backward(True, True)


def composite_masks(splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
    """Composite all masks in one pass, see `Engine.composite_masks`."""
    # What no mask shows has opacity 0 and is skipped as faint; its factors, 0 / 0, are not read.
    highest = opacities.amax(0)
    table = tiles.make_table(splats._replace(opacities=highest), (opacities / highest).T)
    transmittances, images = (tiles.whole_tiles(splats.lists, len(opacities), channels) for channels in (1, 3))
    tiles.over_tiles(_masked, splats.lists, table, background, transmittances, images)
    return splats.lists.cut(images), 1 - splats.lists.cut(transmittances[:, 0])


class _Composite(torch.autograd.Function):
    """The image over the background, with depth as a fourth channel if asked for, and the accumulated alpha."""

    @staticmethod
    def forward(
        ctx: Any, splats: Splats, background: Tensor, depth: bool, *_differentiable: Tensor
    ) -> tuple[Tensor, Tensor]:
        table, ctx.lists = tiles.make_table(splats, splats.projection.depths[:, None] if depth else None), splats.lists
        transmittance, image = (tiles.whole_tiles(ctx.lists, channels) for channels in (1, 3 + depth))
        kernel = _forward_with_depth if depth else _forward
        tiles.over_tiles(kernel, ctx.lists, table, background, transmittance, image)
        ctx.save_for_backward(table, transmittance, image)
        return ctx.lists.cut(image), 1 - ctx.lists.cut(transmittance)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_image: Tensor, to_alpha: Tensor) -> tuple[Tensor | None, ...]:
        table, transmittance, image = ctx.saved_tensors
        upstream = ctx.lists.padded(-to_alpha[None]), ctx.lists.padded(to_image)
        rows, depth = table.new_empty(ctx.lists.gaussians.shape[0], table.shape[1]), len(image) == 4
        kernel = _backward_with_depth if depth else _backward
        tiles.over_tiles(kernel, ctx.lists, ctx.lists.slots, table, transmittance, image, *upstream, rows)
        to_background = (upstream[1][:3] * transmittance).sum((1, 2)) if ctx.needs_input_grad[1] else None
        *sums, to_depths = tiles.sum_rows(rows, table, ctx.lists)
        return None, to_background, None, *sums, to_depths[:, 0] if depth else None


composite = _Composite.apply


def absolute_gradients(splats: Splats, rendered: Tensor, gradient: Tensor) -> Tensor:
    """Sum the absolute gradients of the centers, see `Engine.absolute_gradients`."""
    # The kernel works with transmittance, 1 - alpha, whose gradient has the other sign.
    lists, table = splats.lists, tiles.make_table(splats, splats.projection.depths[:, None])
    rows = table.new_empty(lists.gaussians.shape[0], 2)
    assert lists.slots is not None
    images = (lists.padded(x) for x in (1 - rendered[4:], rendered[:4], -gradient[4:], gradient[:4]))
    tiles.over_tiles(_absolute, lists, lists.slots, table, *images, rows)
    return torch.segment_reduce(rows, "sum", offsets=lists.offsets)
