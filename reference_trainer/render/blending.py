"""Front-to-back alpha compositing of tile lists, with a hand-derived backward pass.

Within a tile, the binary logarithm of every alpha is a quadratic polynomial of the pixel's position: one matrix product
of six coefficients per Gaussian with the six monomials of the tile's pixels evaluates all of them. Nothing of the size
of the pixel-Gaussian pairs outlives a block: the backward pass evaluates the alphas again.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.constants import (
    BLOCK_ELEMENTS_CPU,
    BLOCK_ELEMENTS_CUDA,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    TILE,
)
from reference_trainer.render.tiles import Block, TileLists

__all__ = ["BlockAlphas", "block_alphas", "block_size", "composite", "pack", "untile"]

_PIXELS = TILE * TILE
_ABSENT = -1e4  # binary logarithm of the opacity of padding: its alpha is exactly 0
_HALF = 0.5 * math.log2(math.e)  # exp(-x / 2) = 2^(-_HALF x)
_LN_2 = math.log(2.0)


def block_size(device: torch.device) -> int:
    """Return how many pixel-Gaussian pairs to hold at once on a device."""
    return BLOCK_ELEMENTS_CUDA if device.type == "cuda" else BLOCK_ELEMENTS_CPU


def pack(means: Tensor, factors: Tensor, opacities: Tensor) -> Tensor:
    """Gather the geometry of M splats and one absent splat into a table of shape (6, M + 1).

    Its rows are mean x, mean y, l11, l21, l22 and the binary logarithm of the opacity.

    Args:
        means: pixel coordinates, shape (M, 2).
        factors: of the inverse covariances, see `Projection`, shape (M, 3).
        opacities: activated, shape (M,).
    """
    table = torch.cat([means.T, factors.T, torch.log2(opacities)[None]])
    absent = table.new_tensor([0.0, 0.0, 0.0, 0.0, 0.0, _ABSENT])
    return torch.cat([table, absent[:, None]], dim=1)


@lru_cache(maxsize=8)
def _monomials(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Evaluate 1, x, y, x^2, x y, y^2 at a tile's pixels, measured from its centre, shape (64, 6)."""
    axis = torch.arange(TILE, dtype=dtype, device=device) - (TILE - 1) / 2
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)


class _Coefficients(NamedTuple):
    """The polynomials of a block, shape (T, 6, L), and what their derivatives need, each of shape (T, L)."""

    polynomial: Tensor
    dx: Tensor
    dy: Tensor
    l11: Tensor
    l21: Tensor
    l22: Tensor
    w1: Tensor
    w2: Tensor


def _coefficients(table: Tensor, block: Block, lists: TileLists) -> _Coefficients:
    """Expand log2 alpha = log2 o - _HALF |factor (pixel - mean)|^2 around every tile's centre."""
    rows = table.index_select(1, block.gaussians.flatten()).view(-1, *block.gaussians.shape)
    mean_x, mean_y, l11, l21, l22, log_opacity = rows.unbind(0)
    columns = lists.columns
    dx = mean_x - ((block.tiles % columns) * TILE + TILE / 2)[:, None]
    dy = mean_y - (torch.div(block.tiles, columns, rounding_mode="floor") * TILE + TILE / 2)[:, None]
    # Squaring w1 and w2, which are small wherever alpha is not, avoids the cancellation of a dx^2 + 2 b dx dy + c dy^2.
    w1, w2 = l11 * dx + l21 * dy, l22 * dy
    polynomial = torch.stack(
        [
            log_opacity - _HALF * (w1 * w1 + w2 * w2),
            2 * _HALF * (l11 * w1),
            2 * _HALF * (l21 * w1 + l22 * w2),
            -_HALF * (l11 * l11),
            -2 * _HALF * (l11 * l21),
            -_HALF * (l21 * l21 + l22 * l22),
        ],
        dim=1,
    )
    return _Coefficients(polynomial, dx, dy, l11, l21, l22, w1, w2)


class BlockAlphas(NamedTuple):
    """The compositing of one block, each of shape (T, 64, L), nearest splat first.

    Args:
        raw: alphas before the clamp at `MAX_ALPHA`; 0 below `MIN_ALPHA`.
        weights: alpha times the transmittance in front of the splat; 0 from the splat on that ends the pixel.
        transmittance: the light left in front of the splat; 0 from the splat on that ends the pixel.
        passed: 1 - alpha.
    """

    raw: Tensor
    weights: Tensor
    transmittance: Tensor
    passed: Tensor


def block_alphas(table: Tensor, block: Block, lists: TileLists) -> tuple[BlockAlphas, _Coefficients]:
    """Evaluate the alphas and blend weights of a block; not differentiable, work buffers are overwritten."""
    coefficients = _coefficients(table, block, lists)
    monomials = _monomials(table.dtype, table.device).expand(block.tiles.shape[0], _PIXELS, 6)
    raw = torch.bmm(monomials, coefficients.polynomial).exp2_()
    torch.threshold_(raw, MIN_ALPHA, 0.0)
    alpha = raw.clamp(max=MAX_ALPHA)
    passed = 1.0 - alpha
    transmittance = passed.cumprod(-1)
    # A pixel ends at the first splat that would leave too little light: from there on the transmittance counts as 0, so
    # all weights are 0, and in the backward pass so is everything behind.
    torch.threshold_(transmittance, MIN_TRANSMITTANCE, 0.0)
    transmittance.div_(passed)
    return BlockAlphas(raw, alpha.mul_(transmittance), transmittance, passed), coefficients


def untile(tiles: Tensor, lists: TileLists) -> Tensor:
    """Reorder per-tile pixels of shape (tiles, C, 64) into an image of shape (C, H, W)."""
    grid = tiles.view(lists.rows, lists.columns, -1, TILE, TILE)
    image = grid.permute(2, 0, 3, 1, 4).reshape(-1, lists.rows * TILE, lists.columns * TILE)
    return image[:, : lists.height, : lists.width]


def _tile(image: Tensor, lists: TileLists) -> Tensor:
    """Reorder an image of shape (C, H, W) into per-tile pixels of shape (tiles, C, 64), zero outside the image."""
    padding = (0, lists.columns * TILE - lists.width, 0, lists.rows * TILE - lists.height)
    grid = torch.nn.functional.pad(image, padding).view(-1, lists.rows, TILE, lists.columns, TILE)
    return grid.permute(1, 3, 0, 2, 4).reshape(lists.rows * lists.columns, -1, _PIXELS)


class _Composite(torch.autograd.Function):
    """Weighted sums of per-splat values over the splats of every pixel.

    The small factor comes first in every batched product: that is several times faster on a CPU.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, values: Tensor, lists: TileLists) -> Tensor:
        sums = table.new_zeros(lists.lengths.shape[0], values.shape[1], _PIXELS)
        for block in lists.blocks(block_size(table.device)):
            alphas, _ = block_alphas(table, block, lists)
            sums[block.tiles] = torch.bmm(_gather(values, block), alphas.weights.transpose(1, 2))
        ctx.save_for_backward(table, values)
        ctx.lists = lists
        return untile(sums, lists)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        table, values = ctx.saved_tensors
        lists: TileLists = ctx.lists
        upstream = _tile(gradients[0], lists)
        sums = table.new_zeros(table.shape[1], table.shape[0] + values.shape[1])
        for block in lists.blocks(block_size(table.device)):
            alphas, k = block_alphas(table, block, lists)
            g, v = upstream[block.tiles], _gather(values, block)
            # Alphas: a splat adds T_i v_i itself and dims by 1 / (1 - alpha_i) the sum of all behind it.
            along = torch.bmm(g.transpose(1, 2), v)
            behind = torch.mul(alphas.weights, along).cumsum_(-1)
            behind = torch.sub(behind[..., -1:], behind)
            along.mul_(alphas.transmittance).sub_(behind.div_(alphas.passed)).mul_(alphas.raw)
            # Polynomial coefficients, then the rows of the table.
            monomials = _monomials(table.dtype, table.device).T.expand(block.tiles.shape[0], 6, _PIXELS)
            c, cx, cy, cxx, cxy, cyy = torch.bmm(monomials, along).unbind(1)
            w1 = k.l11 * cx + k.l21 * cy - k.w1 * c
            w2 = k.l22 * cy - k.w2 * c
            geometry = [
                k.l11 * w1,
                k.l21 * w1 + k.l22 * w2,
                k.w1 * cx - k.l11 * cxx - k.l21 * cxy + k.dx * w1,
                k.w1 * cy - k.l11 * cxy - k.l21 * cyy + k.dy * w1,
                k.w2 * cy - k.l22 * cyy + k.dy * w2,
                c * _LN_2,
            ]
            # Values: each splat receives its weight times the pixel's gradient.
            rows = torch.cat([torch.stack(geometry, dim=1), torch.bmm(g, alphas.weights)], dim=1)
            sums.index_add_(0, block.gaussians.flatten(), rows.transpose(1, 2).flatten(0, 1))
        return sums[:, : table.shape[0]].T, sums[:, table.shape[0] :], None


def _gather(values: Tensor, block: Block) -> Tensor:
    """Gather values of shape (M + 1, C) into (T, C, L), those of a block's splats."""
    rows = values.index_select(0, block.gaussians.flatten()).view(*block.gaussians.shape, -1)
    return rows.transpose(1, 2).contiguous()


def composite(means: Tensor, factors: Tensor, opacities: Tensor, values: Tensor, lists: TileLists) -> Tensor:
    """Sum per-splat values over every pixel, weighted by alpha times transmittance.

    The gradient passes through the clamp at `MAX_ALPHA`, as in the INRIA rasterizer.

    Args:
        means: pixel coordinates, shape (M, 2).
        factors: of the inverse covariances, see `Projection`, shape (M, 3).
        opacities: activated, shape (M,).
        values: what to sum, shape (M, C).
        lists: the splats of every tile.

    Returns:
        The sums, shape (C, H, W).
    """
    absent = values.new_zeros(1, values.shape[1])
    result: Tensor = _Composite.apply(  # type: ignore[no-untyped-call]
        pack(means, factors, opacities), torch.cat([values, absent]), lists
    )
    return result
