"""Render a model: its raw parameters activated and handed to the renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import Rendering, render

__all__ = ["render_gaussians"]


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor,
    *,
    opacities: Tensor | None = None,
    sh_degree: int | None = None,
    depth: bool = False,
    renderer: Callable[..., Any] = render,
) -> Rendering:
    """Render a model.

    Args:
        gaussians: the model.
        camera: the view.
        background: colour behind it, shape (3,).
        opacities: activated opacities (N,) to use instead of the model's own, such as regularized ones.
        sh_degree: highest band of spherical harmonics to use; all by default.
        depth: whether to accumulate depth as well.
        renderer: with the arguments of `render`, such as gsplat's; what it returns is returned.

    Example:
        >>> import torch
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> render_gaussians(gaussians, camera, torch.zeros(3)).image.shape
        torch.Size([3, 16, 16])
    """
    out: Rendering = renderer(
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales,
        gaussians.opacities if opacities is None else opacities,
        camera,
        sh=gaussians.sh,
        sh_degree=sh_degree,
        background=background,
        depth=depth,
    )
    return out
