"""Render a model: its raw parameters activated and handed to the renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from ca_reg import Params
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import MomentImages, Rendering, Splats, render, render_moments, splat

__all__ = ["render_gaussians", "render_moments_of", "splat_gaussians"]


def render_gaussians(
    model: Gaussians | Params,
    camera: Camera,
    background: Tensor,
    *,
    opacities: Tensor | None = None,
    sh_degree: int | None = None,
    depth: bool = False,
    absgrad: bool = False,
    renderer: Callable[..., Any] = render,
) -> Rendering:
    """Render a model.

    Args:
        model: Gaussians, or what is to be rendered of them, such as what a regularizer returned.
        camera: the view.
        background: colour behind it, shape (3,).
        opacities: activated opacities (N,) to use instead of the model's own.
        sh_degree: highest band of spherical harmonics to use; all by default.
        depth: whether to accumulate depth as well.
        absgrad: whether ``splats.projection.means.absgrad`` is wanted; of renderers that are capable of it.
        renderer: with the arguments of `render`, such as gsplat's; what it returns is returned.

    Example:
        >>> import torch
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> render_gaussians(gaussians, camera, torch.zeros(3)).image.shape
        torch.Size([3, 16, 16])
    """
    arguments = _arguments(model, opacities) | ({"absgrad": True} if absgrad else {})
    out: Rendering = renderer(**arguments, camera=camera, sh_degree=sh_degree, background=background, depth=depth)
    return out


def splat_gaussians(
    model: Gaussians | Params, camera: Camera, *, opacities: Tensor | None = None, sh_degree: int | None = None
) -> Splats:
    """Project a model and list it per tile; arguments as of `render_gaussians`."""
    return splat(**_arguments(model, opacities), camera=camera, sh_degree=sh_degree)


def render_moments_of(
    model: Gaussians | Params,
    multiplier: Multiplier,
    camera: Camera,
    background: Tensor,
    *,
    sh_degree: int | None = None,
) -> tuple[MomentImages, Splats]:
    """Render the exact moments of a model under random factors on its alphas.

    Args:
        model: Gaussians, or what is to be rendered of them.
        multiplier: moments of the factor.
        camera: the view.
        background: colour behind it, shape (3,), or one for each pixel, (3, H, W).
        sh_degree: highest band of spherical harmonics to use; all by default.

    Returns:
        The moments, and what was drawn; its projected centres keep their gradient.
    """
    splats = splat_gaussians(model, camera, sh_degree=sh_degree)
    if splats.projection.means.requires_grad:
        splats.projection.means.retain_grad()
    return render_moments(splats, multiplier, background=background), splats


def _arguments(model: Gaussians | Params, opacities: Tensor | None) -> dict[str, Any]:
    """Return the renderer's arguments about the Gaussians."""
    x = model.params() if isinstance(model, Gaussians) else model
    return {
        "means": x.means,
        "quaternions": x.quaternions,
        "scales": x.scales,
        "opacities": x.opacities if opacities is None else opacities,
        "sh": x.sh,
    }
