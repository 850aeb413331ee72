"""What every Gaussian contributes to the variance of a rendering under random factors."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.footprints import PIXELS, footprints, pack, pad, tile
from reference_trainer.render.recursion import (
    behind_tiles,
    block_entries,
    chunk_rows,
    contrasts,
    evaluate_terms,
    in_front,
    moment_block_size,
    multiplier_rows,
)
from reference_trainer.render.renderer import Splats
from reference_trainer.render.workspace import Workspace

__all__ = ["variance_shares"]


@torch.no_grad()
def variance_shares(
    splats: Splats, multiplier: Multiplier, weights: Tensor, *, background: Tensor | None = None
) -> Tensor:
    """Attribute a weighted sum of the variance over the pixels to the Gaussians; the shares add up to it.

    A Gaussian's share at a pixel is its summand of the variance, `ca_reg.functional.contributions`, mean over RGB.

    Args:
        splats: of the full model, with its plain opacities.
        multiplier: moments of the factor, as for `render_moments`.
        weights: of the pixels, shape (H, W); 1 / count in the region of a score makes shares of the score.
        background: as for `render_moments`.

    Returns:
        One share for every projected Gaussian (``splats.indices``), shape (M,), float64.

    Raises:
        ValueError: if the weights or the background have another shape.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> from reference_trainer.render.moments import render_moments
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.1, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.tensor([[0.0, 0, 0], [1.0, 1, 1]]))
        >>> shares = variance_shares(splats, Multiplier.dropout(0.5), torch.full((16, 16), 1 / 256))
        >>> variance = render_moments(splats, Multiplier.dropout(0.5)).variance
        >>> torch.allclose(shares.sum(), variance.double().mean())
        True
    """
    shape = (splats.lists.height, splats.lists.width)
    if weights.shape != shape:
        raise ValueError(f"weights must have one value per pixel, shape {shape}, got {tuple(weights.shape)}.")
    table = pack(splats.projection.means, splats.projection.factors, splats.opacities)
    values = pad(splats.colors)
    factors = multiplier_rows(multiplier, splats)
    behind = behind_tiles(background, splats)
    per_pixel = tile(weights[None].to(splats.opacities), splats.lists)[:, 0]
    sums = torch.zeros(values.shape[1], dtype=torch.float64, device=values.device)
    for chunk in splats.lists.chunks(moment_block_size(table.device)):
        polynomial = footprints(table, chunk, splats.lists).polynomial
        v, f = chunk_rows(values, chunk), chunk_rows(factors, chunk)
        shares = sums.new_empty(1, chunk.gaussians.shape[0])
        workspace = Workspace(6, chunk, table)
        for block in chunk.blocks:
            *buffers, front = workspace.of(block.shape[1], PIXELS, block.shape[0])
            terms = evaluate_terms(block_entries(polynomial, v, f, block), buffers)
            numbers = chunk.tiles[block.tiles]
            scale = in_front(terms, front).mul_(terms.spread).mul_(per_pixel[numbers].T / 3.0)
            mean = behind[numbers].permute(1, 2, 0).contiguous()
            contrast = torch.empty_like(mean)
            of_block = block.of(shares)[0]
            for i in contrasts(terms, mean, [contrast] * len(scale)):
                of_block[:, i] = (contrast.square().sum(0) * scale[i]).sum(0, dtype=torch.float64)
        sums.index_add_(0, chunk.gaussians, shares[0])
    return sums[:-1]
