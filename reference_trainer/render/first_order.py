"""The paper's first-order form of co-adaptation, tile by tile, for comparison with the exact moments."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA
from reference_trainer.render.footprints import PIXELS, block_size, footprints, monomials, pack, pad, untile
from reference_trainer.render.renderer import Splats

__all__ = ["first_order_map"]


@torch.no_grad()
def first_order_map(splats: Splats, multiplier: Multiplier) -> Tensor:
    """Render ``v sum_i (c_i alpha_i)^2``, the paper's closed form (appendix, Eq. ca_final, where v is ``p (1 - p)``).

    An approximation that knows neither transmittance nor background nor what lies behind a splat: hidden splats count
    like visible ones. `ca_reg.functional.first_order_variance` says when it is right.

    Args:
        splats: of the full model, with its plain opacities.
        multiplier: moments of the factor, numbers for all Gaussians, or tensors of shape (N,); only the variance
            matters.

    Returns:
        The approximate variance per channel, shape (3, H, W).

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.5, 8.5, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.ones(2, 3))
        >>> round(first_order_map(splats, Multiplier.dropout(0.5))[0, 8, 8].item(), 3)  # 0.25 (0.25 + 0.25)
        0.125
    """
    lists = splats.lists
    table = pack(splats.projection.means, splats.projection.factors, splats.opacities)
    spread = multiplier.variance
    if isinstance(spread, Tensor):
        spread = spread[splats.indices].to(splats.colors)[:, None]
    weights = pad(spread * splats.colors.square())
    sums = table.new_zeros(lists.lengths.shape[0], 3, PIXELS)
    for chunk in lists.chunks(block_size(table.device)):
        polynomial = footprints(table, chunk, lists).polynomial
        of_entries = weights.index_select(1, chunk.gaussians)
        for block in chunk.blocks:
            pixels = monomials(table.dtype, table.device).expand(block.shape[0], PIXELS, 6)
            alpha = torch.bmm(pixels, block.of(polynomial).transpose(0, 1)).exp2_()
            torch.threshold_(alpha, MIN_ALPHA, 0.0)
            squares = alpha.clamp_(max=MAX_ALPHA).square_()
            sums[chunk.tiles[block.tiles]] = torch.bmm(block.of(of_entries).transpose(0, 1), squares.transpose(1, 2))
    return untile(sums, lists)
