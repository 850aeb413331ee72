"""Per-pixel maps: the variance of the blended colors (CV), and the paper's first-order form of co-adaptation."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.renderer import rasterize
from reference_trainer.render.splats import Splats
from reference_trainer.render.torch import compositing
from reference_trainer.render.torch.compositing import geometry_rows, walk

__all__ = ["color_variance_map", "first_order_map"]


@torch.no_grad()
def color_variance_map(splats: Splats) -> tuple[Tensor, Tensor]:
    """Measure the variance of the colors blended at each pixel (paper, appendix, CV metric).

    Returns:
        The variance, averaged over RGB, shape (H, W), and where any splat contributes, shape (H, W) bool; the variance
        is 0 elsewhere. The image's CV is the mean over the contributing pixels.

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
    drawn, squares = rasterize(splats), rasterize(splats._replace(colors=splats.colors.square()))
    covered = drawn.alpha > 0
    weight = torch.where(covered, drawn.alpha, 1.0)
    return (squares.image / weight - (drawn.image / weight).square()).mean(0).clamp_min(0.0), covered


@torch.no_grad()
def first_order_map(splats: Splats, multiplier: Multiplier) -> Tensor:
    """Render ``v sum_i (c_i alpha_i)^2``, the paper's closed form (appendix, Eq. ca_final, where v is ``p (1 - p)``).

    An approximation that ignores transmittance, the background and what lies behind a splat: hidden splats count like
    visible ones. `ca_reg.functional.first_order_variance` says when it holds. Arguments are those of `render_moments`,
    of the multiplier only the variance counts; returns shape (3, H, W). Always drawn by the torch engine.

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
    spread = multiplier.variance
    if isinstance(spread, Tensor):
        spread = spread[splats.indices].to(splats.colors)[:, None]
    rows = torch.cat([geometry_rows(splats), (spread * splats.colors.square()).T])
    behind = rows.new_zeros(3, splats.lists.height, splats.lists.width)
    return walk(compositing.first_order, rows, behind, splats.lists, extra=0)
