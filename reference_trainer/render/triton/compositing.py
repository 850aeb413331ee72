"""Front-to-back compositing, its gradient, absolute gradients, and renders of many masks.

A pixel's transmittance is negative from the splat on that terminates it (`MIN_TRANSMITTANCE`): one register instead of
two, and the largest of a tile says whether it is finished, which is asked every 32 entries.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from reference_trainer.render.splats import Splats
from reference_trainer.render.triton import tiles
from reference_trainer.render.triton.launching import kernel, launch
from reference_trainer.render.triton.tiles import Lists, add_row, alpha_at, geometry_sums, make_row, pixels

__all__ = ["absolute_gradients", "composite", "composite_masks"]

_MAX_ALPHA, _MIN_ALPHA = tl.constexpr(MAX_ALPHA), tl.constexpr(MIN_ALPHA)
_MIN_TRANSMITTANCE = tl.constexpr(MIN_TRANSMITTANCE)
_CHUNK = tl.constexpr(32)
_MASKS = 4  # images that a program renders: 4 x 64 states of four values, 72 registers in all; 8 would take 162


@triton.jit
def _pass(alpha, t):
    """Return the weight of a splat, and the transmittance behind it."""
    rest = t * (1 - alpha)
    goes_on = rest >= _MIN_TRANSMITTANCE
    return tl.where(goes_on, alpha * t, 0.0), tl.where(goes_on, rest, -tl.abs(t))


@triton.jit
def _store_over(image, place, size, inside, r, g, b, t, background):
    """Store colors over a background (3,), of which t shows."""
    r, g = r + t * tl.load(background), g + t * tl.load(background + 1)
    tiles.store3(image, place, size, inside, r, g, b + t * tl.load(background + 2))


@kernel
def composite_forward(
    table, starts, gaussians, background, image, alpha, width, height,
    columns, STRIDE: tl.constexpr, TILE: tl.constexpr, DEPTH: tl.constexpr,
):  # fmt: skip
    """Render a tile: image (3 or 4, H, W), whose fourth channel is depth, and accumulated alpha (H, W)."""
    tile = tl.program_id(0)
    x, y, place, inside = pixels(tile, width, height, columns, TILE)
    t = tl.where(inside, 1.0, -1.0)  # pixels beyond the border are finished before they begin
    r, g, b, d = tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t)
    begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (begin < end) & (tl.max(t) > 0):
        for e in range(begin, tl.minimum(begin + _CHUNK, end)):
            row = table + tl.load(gaussians + e) * STRIDE
            raw, _geometry = alpha_at(row, x, y)
            weight, t = _pass(tl.minimum(raw, _MAX_ALPHA), t)
            r += weight * tl.load(row + 6)
            g += weight * tl.load(row + 7)
            b += weight * tl.load(row + 8)
            if DEPTH:
                d += weight * tl.load(row + 9)
        begin += _CHUNK
    t, size = tl.abs(t), (width * height).to(tl.int64)
    tl.store(alpha + place, 1 - t, mask=inside)
    _store_over(image, place, size, inside, r, g, b, t, background)
    if DEPTH:
        tl.store(image + 3 * size + place, d, mask=inside)


@kernel
def composite_backward(
    table, starts, gaussians, image, alpha, to_image, to_alpha, rows,
    width, height, columns, STRIDE: tl.constexpr, TILE: tl.constexpr, DEPTH: tl.constexpr,
    ABSOLUTE: tl.constexpr, EACH: tl.constexpr,
):  # fmt: skip
    """Carry gradients to the splats, front to back, so that every alpha is evaluated once.

    With u the gradients of the image's channels and u_a that of alpha = 1 - T, splat i adds T_i alpha_i along_i,
    along_i = sum_c u_c c_i + u_a, and scales all that is behind it, beyond_i, by 1 - alpha_i:

        d / d alpha_i = T_i along_i - beyond_i / (1 - alpha_i)        beyond_i = beyond_{i-1} - T_i alpha_i along_i

    where beyond_0 is the rendered image times its gradient. The gradient passes the clamp of alpha.
    """
    tile = tl.program_id(0)
    x, y, place, inside = pixels(tile, width, height, columns, TILE)
    size = (width * height).to(tl.int64)  # ten planes may have more than 2^31 numbers
    u_a = tl.load(to_alpha + place, mask=inside, other=0.0)
    u_r, u_g, u_b = tiles.load3(to_image, place, size, inside)
    r, g, b = tiles.load3(image, place, size, inside)
    beyond = u_a * tl.load(alpha + place, mask=inside, other=0.0) + u_r * r + u_g * g + u_b * b
    u_d = tl.zeros_like(u_a)
    if DEPTH:
        u_d = tl.load(to_image + 3 * size + place, mask=inside, other=0.0)
        beyond += u_d * tl.load(image + 3 * size + place, mask=inside, other=0.0)
    t = tl.where(inside, 1.0, -1.0)
    begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (begin < end) & (tl.max(t) > 0):
        for e in range(begin, tl.minimum(begin + _CHUNK, end)):
            i = tl.load(gaussians + e)
            row = table + i * STRIDE
            raw, geometry = alpha_at(row, x, y)
            clamped, front = tl.minimum(raw, _MAX_ALPHA), t
            weight, t = _pass(clamped, front)
            along = u_a + u_r * tl.load(row + 6) + u_g * tl.load(row + 7) + u_b * tl.load(row + 8)
            if DEPTH:
                along += u_d * tl.load(row + 9)
            beyond -= weight * along
            # raw times the gradient of alpha is that of ln alpha, from which `geometry_sums` goes on. raw stands
            # for the clamped alpha too, which passes gradients, and 1 - clamped is at least 1 - MAX_ALPHA: no
            # division by 0. The splat at which a pixel terminates has no weight there, and so no gradient.
            slope = tl.where(t > 0, raw * (front * along - beyond / (1 - clamped)), 0.0)  # of ln alpha
            if ABSOLUTE:
                _dx, _dy, w1, w2, l11, l21, l22, _opacity = geometry
                to_x, to_y = tl.abs(slope * (l11 * w1)), tl.abs(slope * (l21 * w1 + l22 * w2))
                nothing = 0.0, 0.0, 0.0, 0.0
                gradients = make_row((tl.sum(to_x), tl.sum(to_y), 0.0, 0.0), nothing, nothing)
                add_row(rows, gradients, e, i, 2, EACH)
            else:
                g0, g1, g2, g3, g4, g5 = geometry_sums(slope, geometry)
                to_r, to_g, to_b = tl.sum(weight * u_r), tl.sum(weight * u_g), tl.sum(weight * u_b)
                to_d = 0.0
                if DEPTH:
                    to_d = tl.sum(weight * u_d)
                gradients = make_row((g0, g1, g2, g3), (g4, g5, to_r, to_g), (to_b, to_d, 0.0, 0.0))
                add_row(rows, gradients, e, i, STRIDE, EACH)
        begin += _CHUNK


@kernel
def composite_masked(
    table, starts, gaussians, background, ratios, images, alphas, first, count,
    width, height, columns, STRIDE: tl.constexpr, TILE: tl.constexpr, MASKS: tl.constexpr,
):  # fmt: skip
    """Render a tile of MASKS of ``count`` images, from the ``first`` on.

    They are given by ratios (M, count) on the opacities of the table.
    What does not depend on the opacity, the exponential among it, is evaluated once for all of them: with pixels along
    the last axis and one warp, a lane holds all images of its two pixels.
    """
    tile = tl.program_id(0)
    x, y, place, inside = pixels(tile, width, height, columns, TILE)
    which = first + tl.program_id(1) * MASKS + tl.arange(0, MASKS)
    shown = inside[None, :] & (which < count)[:, None]
    t = tl.where(shown, 1.0, -1.0)
    r, g, b = tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t)
    begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (begin < end) & (tl.max(t) > 0):
        for e in range(begin, tl.minimum(begin + _CHUNK, end)):
            i = tl.load(gaussians + e)
            row = table + i * STRIDE
            raw, _geometry = alpha_at(row, x, y)
            ratio = tl.load(ratios + i.to(tl.int64) * count + which, mask=which < count, other=0.0)
            lower = ratio[:, None] * raw[None, :]
            weight, t = _pass(tl.where(lower >= _MIN_ALPHA, tl.minimum(lower, _MAX_ALPHA), 0.0), t)
            r += weight * tl.load(row + 6)
            g += weight * tl.load(row + 7)
            b += weight * tl.load(row + 8)
        begin += _CHUNK
    t, size = tl.abs(t), (width * height).to(tl.int64)
    at = which.to(tl.int64)[:, None] * size + place[None, :]
    tl.store(alphas + at, 1 - t, mask=shown)
    at += which.to(tl.int64)[:, None] * (2 * size)  # three channels each
    _store_over(images, at, size, shown, r, g, b, t, background)


class _Composite(torch.autograd.Function):
    """The image over the background, with depth as a fourth channel if asked for, and the accumulated alpha."""

    @staticmethod
    def forward(
        ctx: Any, splats: Splats, background: Tensor, depth: bool, *_differentiable: Tensor
    ) -> tuple[Tensor, Tensor]:
        lists = ctx.lists = Lists.of(splats.lists)
        table = tiles.make_table(splats, splats.projection.depths if depth else None)
        image, alpha = table.new_empty(3 + depth, lists.height, lists.width), table.new_empty(lists.height, lists.width)
        tiles.over_tiles(composite_forward, lists, table, background.contiguous(), image, alpha, DEPTH=depth)
        ctx.save_for_backward(table, image, alpha)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_image: Tensor, to_alpha: Tensor) -> tuple[Tensor | None, ...]:
        table, image, alpha = ctx.saved_tensors
        g = _gradients(ctx.lists, table, image, alpha, to_image, to_alpha, absolute=False)
        to_background = (to_image[:3] * (1 - alpha)).sum((1, 2)) if ctx.needs_input_grad[1] else None
        depth = g[:, 9] if len(image) == 4 else None
        return None, to_background, None, g[:, :2], g[:, 2:5], g[:, 5], g[:, 6:9], depth


composite = _Composite.apply


def _gradients(lists: Lists, table: Tensor, *images: Tensor, absolute: bool) -> Tensor:
    """Return rows of gradients, (M, 16), given the image, alpha, and the gradients of both."""
    rows, each = tiles.gradient_rows(lists, table)
    arguments = (x.contiguous() for x in images)
    constants = {"DEPTH": len(images[0]) == 4, "ABSOLUTE": absolute, "EACH": each}
    tiles.over_tiles(composite_backward, lists, table, *arguments, rows, **constants)
    return tiles.sum_rows(rows, each, lists, len(table))


def composite_masks(splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
    """Render all in one pass, see `Engine.composite_masks`."""
    lists, count = Lists.of(splats.lists), len(opacities)
    highest = opacities.amax(0)
    table = tiles.make_table(splats._replace(opacities=highest))
    # What no mask shows has a faint row in the table and is skipped; its ratios, 0 / 0 without the clamp, are not read.
    ratios = (opacities / highest.clamp_min(MIN_ALPHA)).T.contiguous()
    images = table.new_empty(count, 3, lists.height, lists.width)
    alphas = table.new_empty(count, lists.height, lists.width)
    size, background = (lists.width, lists.height, splats.lists.columns), background.contiguous()
    # Whole groups first, then what is left, in as small a group as holds it.
    groups = count // _MASKS
    for first, programs, masks in (
        (0, groups, _MASKS),
        (groups * _MASKS, min(1, count % _MASKS), triton.next_power_of_2(count % _MASKS)),
    ):
        launch(
            composite_masked, (lists.tiles, programs), table, lists.starts, lists.gaussians, background, ratios,
            images, alphas, first, count, *size, STRIDE=table.shape[1], TILE=lists.tile, MASKS=masks,
        )  # fmt: skip
    return images, alphas


def absolute_gradients(splats: Splats, rendered: Tensor, gradient: Tensor) -> Tensor:
    """Sum the absolute gradients of the centers, see `Engine.absolute_gradients`."""
    lists, table = Lists.of(splats.lists), tiles.make_table(splats, splats.projection.depths)
    rows = _gradients(lists, table, rendered[:4], rendered[4], gradient[:4], gradient[4], absolute=True)
    return rows[:, :2].contiguous()
