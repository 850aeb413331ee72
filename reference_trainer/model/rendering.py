"""Rendering a model: activates its raw parameters and hands them to the renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from ca_reg import Params
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import MomentImages, Rendering, Splats, render, render_moments, splat

__all__ = ["arguments", "render_gaussians", "render_moments_of"]


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
    """Render Gaussians, or activated parameters such as a regularizer returns, over a background color (3,).

    Opacities (N,), activated, replace the model's own; ``sh_degree`` is the highest band to use, by default all; with
    ``depth``, depth is accumulated as well; with ``absgrad``, if the renderer is capable of it, the backward pass sets
    ``splats.means.absgrad``. Another renderer, such as gsplat's, takes the arguments of `render`; its result
    is returned as it is.

    Example:
        >>> import torch
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> render_gaussians(gaussians, camera, torch.zeros(3)).image.shape
        torch.Size([3, 16, 16])
    """
    # Renderers that know no absolute gradients do not have the argument.
    given = arguments(model, opacities) | ({"absgrad": True} if absgrad else {})
    out: Rendering = renderer(**given, camera=camera, sh_degree=sh_degree, background=background, depth=depth)
    return out


def render_moments_of(
    model: Gaussians | Params,
    multiplier: Multiplier,
    camera: Camera,
    background: Tensor,
    *,
    sh_degree: int | None = None,
) -> tuple[MomentImages, Splats]:
    """Render the exact mean and variance of a model's picture under random factors on its alphas.

    The background has shape (3,), or (3, H, W). The splats are returned as well; their projected centers keep their
    gradient.
    """
    splats = splat(**arguments(model), camera=camera, sh_degree=sh_degree)
    if splats.projection.means.requires_grad:
        splats.projection.means.retain_grad()
    return render_moments(splats, multiplier, background=background), splats


def arguments(model: Gaussians | Params, opacities: Tensor | None = None) -> dict[str, Any]:
    """Return the renderer's arguments that describe the Gaussians; ``opacities`` (N,) replace the model's own."""
    x = model.params() if isinstance(model, Gaussians) else model
    opacities = x.opacities if opacities is None else opacities
    return dict(means=x.means, quaternions=x.quaternions, scales=x.scales, opacities=opacities, sh=x.sh)
