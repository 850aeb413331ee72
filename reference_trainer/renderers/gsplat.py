"""Rendering with gsplat's CUDA kernels in place of this package's own renderer.

Arguments and results are the same, and the constants where gsplat lets them be chosen: near plane and dilation. Three
things differ: alpha is clamped at 0.999 before gsplat 1.6, no gradient passes a clamped alpha, and the projection is
linearized up to a margin beyond the picture's borders, which matters where the principal point is off center. There
are no moments: analytic training and exact scores use this package's renderer.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.checks import checked_colors
from reference_trainer.render.constants import DILATION, NEAR_PLANE
from reference_trainer.renderers.renderer import Renderer

__all__ = ["GsplatRenderer", "GsplatRendering", "GsplatSplats", "load_gsplat_render", "render_by"]


class GsplatSplats(NamedTuple):
    """What density control reads of a render, see `ViewSplats`."""

    indices: Tensor
    means: Tensor
    touched: Tensor


class GsplatRendering(NamedTuple):
    """A rendered view, with the fields of `Rendering`."""

    image: Tensor
    alpha: Tensor
    depth: Tensor | None
    splats: GsplatSplats


class GsplatRenderer(Renderer):
    """gsplat's CUDA kernels."""

    capabilities = frozenset({"depth", "absgrad"})

    def prepare(self, device: torch.device) -> None:
        """Load gsplat."""
        self._render = load_gsplat_render(device)

    def __call__(self, **arguments: Any) -> Any:
        """Render."""
        return self._render(**arguments)


def load_gsplat_render(device: torch.device | str) -> Callable[..., GsplatRendering]:
    """Return a function with the arguments of `render` that renders with gsplat, for Gaussians on a device.

    Raises:
        RuntimeError: if the device is not a CUDA device, or there is none.
        ImportError: if gsplat is missing.
    """
    if torch.device(device).type != "cuda":
        raise RuntimeError(
            f"the gsplat renderer renders on CUDA devices only, and the device is {str(device)!r}: train with --device "
            "cuda, or with --renderer builtin, which runs anywhere."
        )
    if not torch.cuda.is_available():
        raise RuntimeError("the gsplat renderer needs a CUDA device, and torch finds none: use --renderer builtin.")
    try:
        import gsplat
    except ModuleNotFoundError as error:
        raise ImportError(
            "the gsplat renderer needs gsplat: pip install 'ca_reg[gsplat]', or use --renderer builtin."
        ) from error
    return functools.partial(render_by, gsplat.rasterization)


def render_by(
    rasterization: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]],
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    *,
    sh: Tensor | None = None,
    sh_degree: int | None = None,
    colors: Tensor | None = None,
    background: Tensor | None = None,
    depth: bool = False,
    absgrad: bool = False,
) -> GsplatRendering:
    """Render 3D Gaussians with ``gsplat.rasterization``, 1.5 or newer; differentiable in all but the background.

    Arguments and conventions are those of `render`; with ``absgrad`` the backward pass leaves absolute gradients (M, 2)
    in ``splats.means.absgrad``.

    Raises:
        TypeError: if the Gaussians are not float32, the only dtype that gsplat takes.
        ValueError: if not exactly one of ``sh`` and ``colors`` is given.
    """
    # gsplat tells colors from coefficients by their shape and the degree alone.
    values, degree = checked_colors(sh, sh_degree, colors)
    if means.dtype != torch.float32:
        raise TypeError(f"the gsplat renderer knows float32 only, got {means.dtype}: use the builtin one.")
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    images, alphas, info = rasterization(
        means=means,
        quats=quaternions,
        scales=scales,
        opacities=opacities.reshape(-1),
        colors=values,
        viewmats=camera.world_to_camera.to(means)[None],
        Ks=means.new_tensor(intrinsics)[None],
        width=camera.width,
        height=camera.height,
        near_plane=NEAR_PLANE,
        eps2d=DILATION,
        sh_degree=degree,
        packed=True,  # projected means, whose gradient is wanted, of M Gaussians instead of a batch of views
        render_mode="RGB+D" if depth else "RGB",
        absgrad=absgrad,
    )
    # As in `rasterize`: projected centers are no leaves, and density control reads their gradient.
    if info["means2d"].requires_grad:
        info["means2d"].retain_grad()
    image, alpha = images[0].permute(2, 0, 1), alphas[0, ..., 0]
    # Here, because gsplat 1.5 takes no background with packed Gaussians.
    shown = image[:3] if background is None else image[:3] + (1 - alpha) * background.to(means)[:, None, None]
    splats = GsplatSplats(
        indices=info["gaussian_ids"].long(), means=info["means2d"], touched=info["tiles_per_gauss"] > 0
    )
    return GsplatRendering(shown, alpha, image[3] if depth else None, splats)
