"""The footprints of splats in tiles: log-alphas as polynomials of the pixel, and the way back for gradients.

Within a tile, the binary logarithm of every alpha is a quadratic polynomial of the pixel's position: one matrix product
of six coefficients per Gaussian with the six monomials of the tile's pixels evaluates all of them.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.constants import BLOCK_ELEMENTS_CPU, BLOCK_ELEMENTS_CUDA, TILE
from reference_trainer.render.tiles import Chunk, TileLists

__all__ = [
    "PIXELS",
    "Footprints",
    "block_size",
    "footprints",
    "monomials",
    "pack",
    "pad",
    "table_gradient",
    "tile",
    "untile",
]

PIXELS = TILE * TILE
_ABSENT = -1e4  # binary logarithm of the opacity of padding: its alpha is exactly 0
_HALF = 0.5 * math.log2(math.e)  # exp(-x / 2) = 2^(-_HALF x)
_LN_2 = math.log(2.0)


def block_size(device: torch.device) -> int:
    """Return how many pixel-Gaussian pairs to hold at once on a device."""
    return BLOCK_ELEMENTS_CPU if device.type == "cpu" else BLOCK_ELEMENTS_CUDA


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
def monomials(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Evaluate 1, x, y, x^2, x y, y^2 at a tile's pixels, measured from its centre, shape (64, 6)."""
    axis = torch.arange(TILE, dtype=dtype, device=device) - (TILE - 1) / 2
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)


class Footprints(NamedTuple):
    """The polynomials of a chunk's entries, shape (6, E), and what their derivatives need, each of shape (E,)."""

    polynomial: Tensor
    dx: Tensor
    dy: Tensor
    l11: Tensor
    l21: Tensor
    l22: Tensor
    w1: Tensor
    w2: Tensor


def footprints(table: Tensor, chunk: Chunk, lists: TileLists) -> Footprints:
    """Expand log2 alpha = log2 o - _HALF |factor (pixel - mean)|^2 around every tile's centre."""
    mean_x, mean_y, l11, l21, l22, log_opacity = table.index_select(1, chunk.gaussians).unbind(0)
    row = torch.div(chunk.tile_of, lists.columns, rounding_mode="floor")
    dx = mean_x - ((chunk.tile_of - row * lists.columns) * TILE + TILE / 2)
    dy = mean_y - (row * TILE + TILE / 2)
    # Squaring w1 and w2, which are small wherever alpha is not, avoids the cancellation of a dx^2 + 2 b dx dy + c dy^2.
    w1, w2 = torch.addcmul(l11 * dx, l21, dy), l22 * dy
    polynomial = torch.stack(
        [
            log_opacity - _HALF * (w1 * w1 + w2 * w2),
            2 * _HALF * (l11 * w1),
            2 * _HALF * (l21 * w1 + l22 * w2),
            -_HALF * (l11 * l11),
            -2 * _HALF * (l11 * l21),
            -_HALF * (l21 * l21 + l22 * l22),
        ]
    )
    return Footprints(polynomial, dx, dy, l11, l21, l22, w1, w2)


def table_gradient(k: Footprints, sums: Tensor) -> Tensor:
    """Carry a gradient from the polynomials of a chunk back to the rows of the table.

    Args:
        k: the footprints.
        sums: gradient with respect to ln alpha, times each monomial, summed over the tile's pixels, shape (6, E).

    Returns:
        Gradient with respect to the rows of the table, shape (6, E).
    """
    c, cx, cy, cxx, cxy, cyy = sums.unbind(0)
    w1 = k.l11 * cx + k.l21 * cy - k.w1 * c
    w2 = k.l22 * cy - k.w2 * c
    return torch.stack(
        [
            k.l11 * w1,
            k.l21 * w1 + k.l22 * w2,
            k.w1 * cx - k.l11 * cxx - k.l21 * cxy + k.dx * w1,
            k.w1 * cy - k.l11 * cxy - k.l21 * cyy + k.dy * w1,
            k.w2 * cy - k.l22 * cyy + k.dy * w2,
            c * _LN_2,
        ]
    )


def pad(values: Tensor) -> Tensor:
    """Return values (M, C) of M splats as rows (C, M + 1), the absent splat's being 0."""
    return torch.nn.functional.pad(values.T, (0, 1))


def untile(tiles: Tensor, lists: TileLists) -> Tensor:
    """Reorder per-tile pixels of shape (tiles, C, 64) into an image of shape (C, H, W)."""
    grid = tiles.view(lists.rows, lists.columns, -1, TILE, TILE)
    image = grid.permute(2, 0, 3, 1, 4).reshape(-1, lists.rows * TILE, lists.columns * TILE)
    return image[:, : lists.height, : lists.width]


def tile(image: Tensor, lists: TileLists) -> Tensor:
    """Reorder an image of shape (C, H, W) into per-tile pixels of shape (tiles, C, 64), zero outside the image."""
    padding = (0, lists.columns * TILE - lists.width, 0, lists.rows * TILE - lists.height)
    grid = torch.nn.functional.pad(image, padding).view(-1, lists.rows, TILE, lists.columns, TILE)
    return grid.permute(1, 3, 0, 2, 4).reshape(lists.rows * lists.columns, -1, PIXELS)
