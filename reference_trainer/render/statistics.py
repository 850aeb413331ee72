"""Per-pixel statistics of the splats behind a rendering, tile by tile."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.functional import color_variance
from reference_trainer.render.blending import block_alphas
from reference_trainer.render.footprints import PIXELS, block_size, footprints, pack, untile
from reference_trainer.render.renderer import Splats
from reference_trainer.render.workspace import Workspace

__all__ = ["color_variance_map"]


@torch.no_grad()
def color_variance_map(splats: Splats) -> tuple[Tensor, Tensor]:
    """Measure how much the colours blended at each pixel differ (paper, appendix, CV metric).

    Args:
        splats: of a rendering.

    Returns:
        The variance, mean over RGB, shape (H, W), and where any splat contributes, shape (H, W) bool; the variance is 0
        elsewhere. The image's CV is the mean over the latter.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.tensor([[0.0, 0, 0], [1.0, 1, 1]]))
        >>> variance, covered = color_variance_map(splats)
        >>> round(variance[8, 8].item(), 2)  # weights 1/2 and 1/4: (1/3) (2/3)
        0.22
    """
    lists = splats.lists
    table = pack(splats.projection.means, splats.projection.factors, splats.opacities)
    colors = torch.cat([splats.colors, splats.colors.new_zeros(1, 3)])
    tiles = table.new_zeros(lists.lengths.shape[0], 2, PIXELS)
    for chunk in lists.chunks(block_size(table.device)):
        polynomial = footprints(table, chunk, lists).polynomial
        workspace = Workspace(4, chunk, table)
        for block in chunk.blocks:
            weights = block_alphas(polynomial, block, workspace.of(block.shape[0], PIXELS, block.shape[1])).weights
            which = chunk.gaussians[block.entries].view(block.shape)
            result = color_variance(weights, colors[which][:, None].expand(-1, PIXELS, -1, -1))
            tiles[chunk.tiles[block.tiles]] = torch.stack([result.variance, result.covered.to(table)], dim=1)
    variance, covered = untile(tiles, lists)
    return variance, covered > 0
