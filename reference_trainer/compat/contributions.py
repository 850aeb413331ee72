"""Per-splat sums over the pixels at which the splat is drawn: the scores of Taming 3DGS."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.render.splats import Splats
from reference_trainer.render.torch.compositing import (
    blend_weights,
    blocks,
    geometry_rows,
    pad_entries,
    pixel_offsets,
    tile,
)

__all__ = ["contributions"]


@torch.no_grad()
def contributions(splats: Splats, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sum over the pixels at which a splat is drawn: an image (H, W), ones, its blend weights, and its distances.

    Each is (M,); distances are from the splat's center to the pixel, in pixels.
    """
    rows = pad_entries(geometry_rows(splats))
    sums = rows.new_zeros(4, rows.shape[1])
    inside = tile(torch.stack([image.to(rows), torch.ones_like(image).to(rows)]), splats.lists)
    pixels = pixel_offsets(rows)
    for block in blocks(splats.lists, rows.device):
        entries = rows[:, block.gaussians]
        weights = blend_weights(block.alphas(entries))
        drawn = (weights > 0).to(weights)
        x, y = entries[:2, :, None]
        dx, dy = (pixels[i] + block.centers[i][..., None] - center for i, center in enumerate((x, y)))
        values, ones = inside[block.tiles], inside[block.tiles][:, 1:]
        found = torch.cat([values @ drawn, ones @ weights, ones @ (drawn * torch.hypot(dx, dy))], dim=1)
        sums.index_add_(1, block.gaussians.flatten(), found.transpose(0, 1).flatten(1))
    image_sums, counts, weight_sums, distances = sums[:, :-1]
    return image_sums, counts, weight_sums, distances
