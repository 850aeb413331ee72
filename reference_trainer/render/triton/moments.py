"""The recursion of the exact moments (`ca_reg.functional.pixel_moments`), its gradient, and the shares.

Back to front, with ``d_i = c_i - mu_{i+1}`` the contrast of a splat with the mean of what is behind it:

    mu_i = mu_{i+1} + expected_i d_i        V_i = shrink_i V_{i+1} + spread_i d_i^2        T_i = passed_i T_{i+1}

where ``expected = m alpha``, ``passed = 1 - expected``, ``spread = v alpha^2`` and ``shrink = passed^2 + spread``.
Every term of V is a square times a non-negative weight: nothing cancels. There is no early stop.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.render.constants import TILE
from reference_trainer.render.splats import Splats
from reference_trainer.render.triton import tiles
from reference_trainer.render.triton.launching import kernel
from reference_trainer.render.triton.tiles import Lists, add_row, alpha_at, geometry_sums, make_row, pixels

__all__ = ["moments", "moments_of", "shares", "shares_of"]

_CHUNK = tl.constexpr(16)  # entries between two checkpoints of the backward pass
_STATE = tl.constexpr(5)  # values of a checkpoint, and those kept of an entry, per pixel
_PROGRAMS = 4096  # of the backward pass at once: about what fills the largest card


@triton.jit
def _random(row, raw, MAX: tl.constexpr):
    """Return alpha, expected, spread, passed and shrink."""
    alpha = tl.minimum(raw, MAX)
    expected, spread = tl.load(row + 9) * alpha, tl.load(row + 10) * alpha * alpha
    passed = 1 - expected
    return alpha, expected, spread, passed, passed * passed + spread


@kernel
def moments_forward(
    table, starts, gaussians, background, mean, variance, alpha, width, height,
    columns, STRIDE: tl.constexpr, TILE: tl.constexpr, MAX: tl.constexpr,
):  # fmt: skip
    """Composite mean and variance (3, H, W) and the expected alpha (H, W) of a tile, back to front."""
    tile = tl.program_id(0)
    x, y, place, inside = pixels(tile, width, height, columns, TILE)
    size = (width * height).to(tl.int64)  # ten planes may have more than 2^31 numbers
    m0, m1, m2 = tiles.load3(background, place, size, inside)
    v0, v1, v2, t = tl.zeros_like(m0), tl.zeros_like(m0), tl.zeros_like(m0), tl.zeros_like(m0) + 1
    begin, e = tl.load(starts + tile), tl.load(starts + tile + 1) - 1
    while e >= begin:
        row = table + tl.load(gaussians + e) * STRIDE
        raw, _geometry = alpha_at(row, x, y)
        _alpha, expected, spread, passed, shrink = _random(row, raw, MAX)
        d0, d1, d2 = tl.load(row + 6) - m0, tl.load(row + 7) - m1, tl.load(row + 8) - m2
        v0, v1, v2 = v0 * shrink + spread * d0 * d0, v1 * shrink + spread * d1 * d1, v2 * shrink + spread * d2 * d2
        m0, m1, m2 = m0 + expected * d0, m1 + expected * d1, m2 + expected * d2
        t *= passed
        e -= 1
    tl.store(alpha + place, 1 - t, mask=inside)
    tiles.store3(mean, place, size, inside, m0, m1, m2)
    tiles.store3(variance, place, size, inside, v0, v1, v2)


@triton.jit
def _behind_chunk(
    state, table, gaussians, first, last, x, y, of_variance, kept,
    STRIDE: tl.constexpr, MAX: tl.constexpr, KEEP: tl.constexpr,
):  # fmt: skip
    """Carry what is behind the splats over entries last - 1 to first; keep contrasts and the rest, if asked to."""
    m0, m1, m2, hidden, t = state
    u0, u1, u2 = of_variance
    e = last - 1
    while e >= first:
        row = table + tl.load(gaussians + e) * STRIDE
        raw, _geometry = alpha_at(row, x, y)
        _alpha, expected, spread, passed, shrink = _random(row, raw, MAX)
        d0, d1, d2 = tl.load(row + 6) - m0, tl.load(row + 7) - m1, tl.load(row + 8) - m2
        if KEEP:
            _store_state(kept + (e - first) * (_STATE * raw.shape[0]), (d0, d1, d2, hidden, t))
        hidden = hidden * shrink + (u0 * d0 * d0 + u1 * d1 * d1 + u2 * d2 * d2) * spread
        m0, m1, m2, t = m0 + expected * d0, m1 + expected * d1, m2 + expected * d2, t * passed
        e -= 1
    return m0, m1, m2, hidden, t


@triton.jit
def _store_state(at, state):
    p = tl.arange(0, state[0].shape[0])
    for k in tl.static_range(_STATE):
        tl.store(at + k * state[0].shape[0] + p, state[k])


@triton.jit
def _load_state(at, PIXELS: tl.constexpr):
    at += tl.arange(0, PIXELS)
    a, b, c = tl.load(at), tl.load(at + PIXELS), tl.load(at + 2 * PIXELS)
    return a, b, c, tl.load(at + 3 * PIXELS), tl.load(at + 4 * PIXELS)


@kernel
def moments_backward(
    table, starts, gaussians, images, checkpoints, rows, count, width, height, columns,
    STRIDE: tl.constexpr, TILE: tl.constexpr, MAX: tl.constexpr, EACH: tl.constexpr,
):  # fmt: skip
    """Carry gradients to the splats, and each splat's share of the weighted variance, of ``count`` tiles.

    ``images`` (10, H, W) are the gradients of mean, variance and alpha, and what is behind, whose own gradients take
    the place of the first three. Few arguments, as addresses take scalar registers, of which AMD's cards have 102.

    Splat i meets what is in front of it only as factors on the gradients. With u the gradient of the mean, U that of
    the variance, u_a that of the expected alpha, all as they arrive at splat i from the front,

        V holds  front_i (spread_i d_i^2 + shrink_i V_{i+1}),    front_{i+1} = front_i shrink_i
        to_spread = front (U d^2 + hidden)                       hidden_i = U V_{i+1}, summed over the channels
        to_expected = u d - 2 passed front hidden + u_a T_{i+1}  (shrink depends on expected through passed^2)
        to_c = u expected + 2 front spread U d                   u -= to_c,  u_a *= passed  for the next splat

    What is behind a splat (its contrast, hidden, T) is only known back to front, all else only front to back. Keeping
    it of every entry would take 1,280 bytes each, and undoing the recursion divides by ``passed``, unstable in thick
    stacks. So a first walk keeps every 16th state (80 bytes per entry, 320 on gsplat's tiles), and the second restores
    16 entries at a time into memory that a program uses again and again (84 MB or 335 MB at most).
    """
    program = tl.program_id(0)
    PIXELS: tl.constexpr = TILE * TILE
    kept = checkpoints + program.to(tl.int64) * (_CHUNK * _STATE * PIXELS)
    checkpoints += tl.num_programs(0).to(tl.int64) * (_CHUNK * _STATE * PIXELS)
    size = (width * height).to(tl.int64)  # ten planes may have more than 2^31 numbers
    for tile in range(program, count, tl.num_programs(0)):
        x, y, place, inside = pixels(tile, width, height, columns, TILE)
        of_variance = tiles.load3(images + 3 * size, place, size, inside)
        U0, U1, U2 = of_variance
        m0, m1, m2 = tiles.load3(images + 7 * size, place, size, inside)
        state = m0, m1, m2, tl.zeros_like(m0), tl.zeros_like(m0) + 1
        begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
        # Floor and one more per tile: no two tiles share a checkpoint, wherever their lists begin.
        saved = checkpoints + (begin // _CHUNK + tile).to(tl.int64) * (_STATE * PIXELS)
        chunks = tl.cdiv(end - begin, _CHUNK)
        chunk = chunks - 1
        while chunk >= 0:
            _store_state(saved + chunk * (_STATE * PIXELS), state)
            first = begin + chunk * _CHUNK
            last = tl.minimum(first + _CHUNK, end)
            state = _behind_chunk(state, table, gaussians, first, last, x, y, of_variance, kept, STRIDE, MAX, False)
            chunk -= 1
        u0, u1, u2 = tiles.load3(images, place, size, inside)
        u_a = tl.load(images + 6 * size + place, mask=inside, other=0.0)
        front = tl.zeros_like(u_a) + 1
        for chunk in range(0, chunks):
            tl.debug_barrier()  # a lane reads what it wrote itself; this also holds where layouts differ
            first = begin + chunk * _CHUNK
            last = tl.minimum(first + _CHUNK, end)
            state = _load_state(saved + chunk * (_STATE * PIXELS), PIXELS)
            _behind_chunk(state, table, gaussians, first, last, x, y, of_variance, kept, STRIDE, MAX, True)
            tl.debug_barrier()
            for e in range(first, last):
                i = tl.load(gaussians + e)
                row = table + i * STRIDE
                d0, d1, d2, hidden, t = _load_state(kept + (e - first) * (_STATE * PIXELS), PIXELS)
                raw, geometry = alpha_at(row, x, y)
                alpha, expected, spread, passed, shrink = _random(row, raw, MAX)
                w0, w1, w2 = U0 * d0, U1 * d1, U2 * d2
                to_shrink, of_spread = front * hidden, front * (w0 * d0 + w1 * d1 + w2 * d2)
                to_spread = of_spread + to_shrink
                to_expected = u0 * d0 + u1 * d1 + u2 * d2 + u_a * t - 2 * passed * to_shrink
                twice = 2 * front * spread
                c0, c1, c2 = u0 * expected + twice * w0, u1 * expected + twice * w1, u2 * expected + twice * w2
                u0, u1, u2, u_a = u0 - c0, u1 - c1, u2 - c2, u_a * passed
                front *= shrink
                # expected = m alpha and spread = v alpha^2: to_alpha = m to_expected + 2 v alpha to_spread, and raw
                # times it is the gradient of ln alpha, as the clamp passes gradients. m and v take the rest.
                slope = raw * (2 * tl.load(row + 10) * to_spread * alpha + to_expected * tl.load(row + 9))
                g0, g1, g2, g3, g4, g5 = geometry_sums(slope, geometry)
                to_r, to_g, to_b, share = tl.sum(c0), tl.sum(c1), tl.sum(c2), tl.sum(of_spread * spread)
                to_m, to_v = tl.sum(to_expected * alpha), tl.sum(to_spread * alpha * alpha)
                gradients = make_row((g0, g1, g2, g3), (g4, g5, to_r, to_g), (to_b, to_m, to_v, share))
                add_row(rows, gradients, e, i, 12, EACH)
        tiles.store3(images, place, size, inside, u0, u1, u2)


def moments_of(table: Tensor, lists: Lists, background: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean and variance (3, H, W) and the expected alpha (H, W) of a table of splats and moments, (M, 11)."""
    mean, variance = (table.new_empty(3, lists.height, lists.width) for _ in range(2))
    alpha = table.new_empty(lists.height, lists.width)
    tiles.over_tiles(moments_forward, lists, table, background.contiguous(), mean, variance, alpha, MAX=lists.max_alpha)
    return mean, variance, alpha


def _gradients(table: Tensor, lists: Lists, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows of gradients (M, 16), columns 9 to 11 those of the moments and the share, and that of behind.

    The images (10, H, W) are the gradients of mean, variance and alpha, and what is behind; they are overwritten.
    """
    rows, each = tiles.gradient_rows(lists, table)
    programs, saved = min(_PROGRAMS, lists.tiles), len(lists.gaussians) // _CHUNK.value + lists.tiles + 1
    checkpoints = table.new_empty(programs * _CHUNK.value + saved, _STATE.value, lists.tile**2)
    # With two pixels to a lane, rows of single entries on gsplat's tiles would spill on a Turing card.
    per_warp = 32 if each and lists.tile > TILE else 64
    tiles.over_tiles(
        moments_backward, lists, table, images, checkpoints, rows, lists.tiles, programs=programs, per_warp=per_warp,
        MAX=lists.max_alpha, EACH=each,
    )  # fmt: skip
    return tiles.sum_rows(rows, each, lists, len(table)), images[:3]


class _Moments(torch.autograd.Function):
    """Mean and variance of the colors, and the expected accumulated alpha."""

    @staticmethod
    def forward(ctx: Any, splats: Splats, multiplier: Tensor, background: Tensor, *_differentiable: Tensor) -> Any:
        table, ctx.lists = tiles.make_table(splats, multiplier), Lists.of(splats.lists)
        ctx.save_for_backward(table, background)
        return moments_of(table, ctx.lists, background)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        table, background = ctx.saved_tensors
        g, to_background = _gradients(table, ctx.lists, torch.cat([*upstream[:2], upstream[2][None], background]))
        return None, g[:, 9:11], to_background, g[:, :2], g[:, 2:5], g[:, 5], g[:, 6:9]


moments = _Moments.apply


def shares_of(table: Tensor, lists: Lists, background: Tensor, weights: Tensor) -> Tensor:
    """Return every row's share of the variance, mean over RGB, for weights of the pixels (H, W); (M,), float64."""
    nothing = weights.new_zeros(3, *weights.shape)
    # Gradients as of a loss that is the weighted variance alone, mean over RGB; none of mean and alpha.
    images = torch.cat([nothing, (weights / 3).expand_as(nothing), nothing[:1], background])
    return _gradients(table, lists, images)[0][:, 11].double()


def shares(splats: Splats, multiplier: Tensor, background: Tensor, weights: Tensor) -> Tensor:
    """Return every splat's share of the weighted variance of the pixels, see `Engine.shares`."""
    return shares_of(tiles.make_table(splats, multiplier), Lists.of(splats.lists), background, weights)
