"""The walk over the tile lists: the image, its exact moments, and their first order.

Tiles with lists of similar length are padded to a block and handed to a formula. Nothing of the
size of the pixel-Gaussian pairs outlives its block: the backward pass evaluates the formula again.

A formula takes a `Block`, the rows of its entries and the background of its tiles, and is
differentiable. A block has T tiles of 64 pixels, with L entries each, nearest first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.render.constants import (
    BLOCK_PAIRS_CPU,
    BLOCK_PAIRS_CUDA,
    BYTES_PER_PAIR_CUDA,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    TILE,
)
from reference_trainer.render.splats import Splats, TileLists

__all__ = [
    "PIXELS", "Block", "blend_weights", "block_pairs", "blocks", "composite", "first_order", "geometry_rows", "moments",
    "over", "pad_entries", "pixel_offsets", "tile", "untile", "walk",
]  # fmt: skip

PIXELS = TILE * TILE
_ABSENT = -1e4  # binary logarithm of the opacity of padding: its alpha is exactly 0
_HALF = 0.5 * math.log2(math.e)  # exp(-x / 2) = 2^(-_HALF x)

Formula = Callable[["Block", Tensor, Tensor], Tensor]


class Block(NamedTuple):
    """Tiles whose lists are padded to one length.

    Args:
        tiles: tile indices, row by row over the image, shape (T,).
        centers: of the tiles, pixels, shape (2, T, 1).
        gaussians: the Gaussian of every entry, nearest first, shape (T, L); M, the number of
            Gaussians, marks padding.
    """

    tiles: Tensor
    centers: Tensor
    gaussians: Tensor

    def alphas(self, geometry: Tensor) -> Tensor:
        """Evaluate the alphas at every pixel, (T, 64, L), not clamped; 0 below `MIN_ALPHA`.

        The geometry is `geometry_rows` of the entries, (6, T, L); differentiable in it.
        """
        x, y, l11, l21, l22, log_opacity = geometry.unbind(0)
        dx, dy = x - self.centers[0], y - self.centers[1]
        # log2 alpha = log2 o - _HALF |factor (pixel - mean)|^2, expanded around the tile's center.
        # Squaring w1 and w2, which are small wherever alpha is not, avoids the cancellation of
        # a dx^2 + 2 b dx dy + c dy^2.
        w1, w2 = l11 * dx + l21 * dy, l22 * dy
        polynomial = [
            log_opacity - _HALF * (w1 * w1 + w2 * w2), 2 * _HALF * (l11 * w1), 2 * _HALF * (l21 * w1 + l22 * w2),
            -_HALF * (l11 * l11), -2 * _HALF * (l11 * l21), -_HALF * (l21 * l21 + l22 * l22),
        ]  # fmt: skip
        # The monomials at 64 pixels times the coefficients of L entries: one matrix product per
        # block.
        x, y = pixel_offsets(geometry)
        exponents = torch.cat([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1) @ torch.stack(polynomial, dim=1)
        return torch.nn.functional.threshold(exponents, math.log2(MIN_ALPHA), -math.inf).exp2()


def pixel_offsets(like: Tensor) -> Tensor:
    """Return x and y of a tile's pixels relative to its center, typed as a tensor, (2, 64, 1)."""
    axis = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y]).view(2, PIXELS, 1)


def geometry_rows(splats: Splats) -> Tensor:
    """Return x, y, l11, l21, l22 and log2 of the opacity of M splats, shape (6, M)."""
    means, factors = splats.projection.means, splats.projection.factors
    # Splats that a mask drops may still be in the lists, of other engines; at `MIN_ALPHA` itself rounding would decide.
    opacities = splats.opacities
    log_opacities = torch.where(opacities >= MIN_ALPHA, torch.log2(opacities.clamp_min(MIN_ALPHA)), _ABSENT)
    return torch.cat([means.T, factors.T, log_opacities[None]])


def block_pairs(device: torch.device) -> int:
    """Return how many pixel-Gaussian pairs a device holds at once."""
    if device.type != "cuda":
        return BLOCK_PAIRS_CPU if device.type == "cpu" else BLOCK_PAIRS_CUDA
    return min(BLOCK_PAIRS_CUDA, torch.cuda.get_device_properties(device).total_memory // BYTES_PER_PAIR_CUDA)


def blocks(lists: TileLists, device: torch.device) -> Iterator[Block]:
    """Yield blocks of all tiles with a list; one that is too long gets a block of its own."""
    pairs = block_pairs(device)
    lengths, tiles = torch.sort(lists.lengths, descending=True, stable=True)
    sizes = lengths.cpu().tolist()
    first, end = 0, sum(n > 0 for n in sizes)
    while first < end:
        last = min(end, first + max(1, pairs // (PIXELS * sizes[first])))
        indices = tiles[first:last]
        place = torch.arange(sizes[first], device=device)
        where = (lists.starts[indices, None] + place).clamp_(max=lists.gaussians.shape[0] - 1)
        gaussians = lists.gaussians[where].long()
        gaussians.masked_fill_(place >= lengths[first:last, None], lists.touched.shape[0])
        corners = torch.stack([indices % lists.columns, indices.div(lists.columns, rounding_mode="floor")])
        yield Block(indices, (corners * TILE + TILE // 2)[..., None], gaussians)
        first = last


def walk(formula: Formula, rows: Tensor, background: Tensor, lists: TileLists, *, extra: int) -> Tensor:
    """Evaluate a formula on every tile's list over a background; differentiable in both.

    Args:
        formula: takes a block, the rows of its entries (R, T, L) and the background of its tiles
            (T, C, 64); returns (T, C + extra, 64), which without any splats is the background,
            followed by zeros.
        rows: values of every splat, the first six those of `geometry_rows`, shape (R, M).
        background: images, shape (C, H, W).
        lists: the splats of every tile.
        extra: channels of the result, images (C + extra, H, W), beyond those of ``background``.
    """
    result: Tensor = _Walk.apply(formula, rows, background, lists, extra)  # type: ignore[no-untyped-call]
    return result


class _Walk(torch.autograd.Function):
    """Evaluates and differentiates a formula block by block."""

    @staticmethod
    def forward(ctx: Any, formula: Formula, rows: Tensor, background: Tensor, lists: TileLists, extra: int) -> Tensor:
        entries, tiles = pad_entries(rows), tile(background, lists)
        result = torch.nn.functional.pad(tiles, (0, 0, 0, extra))
        ctx.blocks = list(blocks(lists, rows.device))
        for block in ctx.blocks:
            result[block.tiles] = formula(block, entries[:, block.gaussians], tiles[block.tiles])
        ctx.formula, ctx.lists = formula, lists
        ctx.save_for_backward(rows, background)
        return untile(result, lists)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, Tensor, None, None]:
        rows, background = ctx.saved_tensors
        lists: TileLists = ctx.lists
        entries, tiles, upstream = pad_entries(rows), tile(background, lists), tile(gradients[0], lists)
        to_entries, to_tiles = torch.zeros_like(entries), upstream[:, : background.shape[0]].clone()
        for block in ctx.blocks:
            inputs = [x.detach().requires_grad_() for x in (entries[:, block.gaussians], tiles[block.tiles])]
            # A backward() within torch.autocast would otherwise compute these products in 16 bits.
            with torch.enable_grad(), torch.autocast(rows.device.type, enabled=False):
                result = ctx.formula(block, *inputs)
                of_block, of_tiles = torch.autograd.grad(result, inputs, upstream[block.tiles], materialize_grads=True)
            # A Gaussian is in the lists of many tiles; padding goes to the row that is cut off
            # below.
            to_entries.index_add_(1, block.gaussians.flatten(), of_block.flatten(1))
            to_tiles[block.tiles] = of_tiles
        return None, to_entries[:, :-1], untile(to_tiles, lists), None, None


def pad_entries(rows: Tensor) -> Tensor:
    """Return rows (R, M) with an invisible splat appended, (R, M + 1)."""
    absent = rows.new_zeros(rows.shape[0], 1)
    absent[5] = _ABSENT
    return torch.cat([rows, absent], dim=1)


def untile(tiles: Tensor, lists: TileLists) -> Tensor:
    """Reorder per-tile pixels of shape (tiles, C, 64) into an image of shape (C, H, W)."""
    grid = tiles.view(lists.rows, lists.columns, -1, TILE, TILE)
    return lists.cut(grid.permute(2, 0, 3, 1, 4).reshape(-1, lists.rows * TILE, lists.columns * TILE))


def tile(image: Tensor, lists: TileLists) -> Tensor:
    """Reorder an image (C, H, W) into pixels of tiles (tiles, C, 64), zero outside the image."""
    grid = lists.padded(image).view(-1, lists.rows, TILE, lists.columns, TILE)
    return grid.permute(1, 3, 0, 2, 4).reshape(lists.rows * lists.columns, -1, PIXELS)


def _clamped(raw: Tensor) -> Tensor:
    """Clamp alphas at `MAX_ALPHA` and let gradients pass, as the INRIA rasterizer does."""
    return torch.where(raw > MAX_ALPHA, MAX_ALPHA + (raw - raw.detach()), raw)


def _running(x: Tensor, *, product: bool) -> Tensor:
    """Return running products or sums along the last dimension.

    On CUDA `torch.cumsum` has no deterministic algorithm, and raises where one is required. Only
    there are shifted copies combined, log2 L times.
    """
    if x.device.type == "cpu" or not torch.are_deterministic_algorithms_enabled():
        return x.cumprod(-1) if product else x.cumsum(-1)
    step = 1
    while step < x.shape[-1]:
        near, far = x[..., :-step], x[..., step:]
        x = torch.cat([x[..., :step], far * near if product else far + near], dim=-1)
        step *= 2
    return x


class _BlendWeights(torch.autograd.Function):
    """Alpha times transmittance; its gradient is twice as fast as that of `torch.cumprod`."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        # w_i = alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j).
        alpha = raw.clamp(max=MAX_ALPHA)
        passed = 1 - alpha
        remaining = _running(passed, product=True)
        # Zero from the first splat on that would leave too little light.
        transmittance = torch.where(remaining >= MIN_TRANSMITTANCE, remaining / passed, 0.0)
        weights = alpha.mul_(transmittance)
        ctx.save_for_backward(passed, transmittance, weights)
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        passed, transmittance, weights = ctx.saved_tensors
        # dw_i / dalpha_i = T_i, and for j > i  dw_j / dalpha_i = -w_j / (1 - alpha_i): a splat adds
        # its own light, and scales all light from behind by 1 - alpha. With gradients g_j of the
        # weights, sum_{j>i} w_j g_j is the total less what has been passed. Gradients pass the
        # clamp.
        along = _running(weights * gradients[0], product=False)
        result: Tensor = transmittance * gradients[0] - (along[..., -1:] - along) / passed
        return result


def blend_weights(raw: Tensor) -> Tensor:
    """Return alpha times the transmittance in front of every splat, (T, 64, L), unclamped alphas given.

    The weights are 0 from the splat on that terminates its pixel.
    """
    weights: Tensor = _BlendWeights.apply(raw)  # type: ignore[no-untyped-call]
    return weights


def composite(block: Block, rows: Tensor, background: Tensor) -> Tensor:
    """Composite C values over a background (T, C, 64), and the alpha, (T, C + 1, 64).

    The rows are geometry and values of the entries, (6 + C, T, L).
    """
    return over(blend_weights(block.alphas(rows[:6])), rows[6:], background)


def over(weights: Tensor, values: Tensor, background: Tensor) -> Tensor:
    """Blend values over a background; append the accumulated alpha, (T, C + 1, 64).

    Weights are (T, 64, L), values (C, T, L), and the background broadcasts to (T, C, 64).
    """
    alpha = weights.sum(-1)[:, None]
    shown = values.transpose(0, 1) @ weights.transpose(1, 2)
    return torch.cat([shown + (1 - alpha) * background, alpha], dim=1)


def moments(block: Block, rows: Tensor, background: Tensor) -> Tensor:
    """Return mean and variance of C values, and the expected alpha, (T, 2 C + 1, 64).

    The recursion of `ca_reg.functional.pixel_moments`, back to front: with d the contrast of a
    splat with the mean of what is behind it, the mean grows by m alpha d, and the variance V
    becomes ((1 - m alpha)^2 + v alpha^2) V + v alpha^2 d^2. Every term is a square times a
    non-negative weight: nothing cancels.

    The rows (9 + C, T, L) are the entries' geometry, mean m and variance v of the random factor, a
    factor on the summand v alpha^2 d^2, whose gradient is the summand's share, and values.
    """
    alpha = _clamped(block.alphas(rows[:6])).permute(2, 0, 1)[:, :, None]
    m, v, factor = rows[6:9].transpose(1, 2)[..., None, None]
    expected, spread = m * alpha, v * alpha.square()
    values = rows[9:].permute(2, 1, 0)[..., None]
    terms = expected, factor * spread, (1 - expected).square() + spread, values
    mean, variance = background, torch.zeros_like(background)
    # unbind, because indexing would copy everything in the backward pass.
    entries = zip(*(reversed(x.unbind(0)) for x in terms), strict=True)
    for e, s, shrink, value in entries:
        contrast = value - mean
        variance = shrink * variance + s * contrast.square()
        mean = mean + e * contrast
    return torch.cat([mean, variance, 1 - (1 - expected).prod(0)], dim=1)


def first_order(block: Block, rows: Tensor, background: Tensor) -> Tensor:
    """Return ``sum_i r_i alpha_i^2`` for C values r, (T, C, 64); the background is ignored."""
    return rows[6:].transpose(0, 1) @ _clamped(block.alphas(rows[:6])).square().transpose(1, 2)
