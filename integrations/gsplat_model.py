"""Render a gsplat model, and list what it composites per pixel, for the co-adaptation score."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ca_reg.lists import PixelLists

from .gsplat import Rasterization, load_gsplat, unregularized_calls

__all__ = ["GsplatModel", "GsplatView"]

_TILE = 16
_ALL = 2**31 - 1  # end of the range of Gaussian batches per tile: all of them


class GsplatView(NamedTuple):
    """A camera in gsplat's terms: OpenCV axes, half-pixel centers.

    ``viewmat``, (4, 4), is world to camera, ``K``, (3, 3), the intrinsics in pixels; width and height are the image's.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int


@dataclass(frozen=True)
class GsplatModel:
    """Gaussians to be rendered by gsplat, without their opacities. Needs a CUDA device.

    ``CAScore(model.render)`` samples; ``CAScore.exact(ListMoments(model.lists))`` is exact and needs gsplat 1.5 or
    newer; ``CAScore.exact(GsplatMoments(model.rasterized))`` of `reference_trainer.render.triton.gsplat` needs Triton,
    and one pass. All bypass a regularizer that wraps or replaces ``gsplat.rasterization``.

    Args:
        means: world coordinates, shape (N, 3).
        quats: orientation, wxyz, shape (N, 4).
        scales: standard deviations, activated, shape (N, 3).
        colors: RGB, shape (N, 3), or with ``sh_degree`` spherical-harmonic coefficients, shape (N, K, 3).
        sh_degree: highest degree to evaluate; None for RGB.
        background: color behind everything, shape (3,); None for black.
        near_plane: as in ``gsplat.rasterization``, like ``eps2d``.
        eps2d: see there.
        antialiased: whether the model was trained with ``rasterize_mode="antialiased"``.

    Example:
        >>> from ca_reg import CAScore
        >>> from ca_reg.lists import ListMoments
        >>> model = GsplatModel(means, quats, scales, sh, sh_degree=3)  # doctest: +SKIP
        >>> view = GsplatView(viewmat, K, 1008, 756)  # doctest: +SKIP
        >>> CAScore(model.render, p=0.2)(opacities, view).value  # doctest: +SKIP
        >>> CAScore.exact(ListMoments(model.lists), p=0.2)(opacities, view).value  # doctest: +SKIP
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    colors: Tensor
    sh_degree: int | None = None
    background: Tensor | None = None
    near_plane: float = 0.01
    eps2d: float = 0.3
    antialiased: bool = False

    def render(self, opacity: Tensor, view: GsplatView) -> tuple[Tensor, Tensor]:
        """Render a view with activated opacities (N,) or (N, 1); return image (3, H, W) and accumulated alpha (H, W).

        Raises an ImportError without gsplat, a RuntimeError if the Gaussians are not on a CUDA device.
        """
        colors, alphas, _ = self._rasterize(opacity, view, colors=self.colors, sh_degree=self.sh_degree)
        return colors[0].permute(2, 0, 1), alphas[0, ..., 0]

    def rasterized(self, opacity: Tensor, view: GsplatView) -> tuple[Tensor, Mapping[str, Any]]:
        """Return the colors of all Gaussians towards a view, RGB, (N, 3), and gsplat's ``meta`` of its render.

        Arguments and errors are those of :meth:`render`. The background is not among them: give it to what takes these.
        """
        colors = self._colors(load_gsplat(self.means.device), view)
        return colors, self._rasterize(opacity, view, colors=colors)[2]

    def lists(self, opacity: Tensor, view: GsplatView) -> PixelLists:
        """List what every pixel composites, without early termination, for :class:`~ca_reg.lists.ListMoments`.

        Differentiable, as the rasterizer is, in everything but which Gaussian covers which pixel. Arguments and errors
        are those of :meth:`render`.
        """
        gsplat = load_gsplat(self.means.device)
        if "opacities" not in inspect.signature(gsplat.fully_fused_projection).parameters:
            raise ImportError("lists need gsplat 1.5 or newer; with Triton there is GsplatMoments(model.rasterized).")
        flat = opacity.reshape(-1)
        if not len(flat):  # which not every gsplat can list
            none = flat.long()
            return PixelLists(none, none, flat, flat.view(0, 3), view.height, view.width, self.background)
        radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
            **self._given(view), covars=None, calc_compensations=self.antialiased, opacities=flat
        )
        opacities = flat[None] * compensations if self.antialiased else flat[None]
        with torch.no_grad():
            gaussians, pixels = _pairs(gsplat, radii, means2d, depths, conics, opacities, view)
        x, y = means2d[0, gaussians].unbind(-1)
        dx, dy = x - (pixels % view.width + 0.5), y - (pixels // view.width + 0.5)
        xx, xy, yy = conics[0, gaussians].unbind(-1)
        falloff = torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
        alphas = (opacities[0, gaussians] * falloff).clamp(max=largest_alpha(flat.device))
        return PixelLists(
            gaussians, pixels, alphas, self._colors(gsplat, view), view.height, view.width, self.background
        )

    def _rasterize(self, opacity: Tensor, view: GsplatView, **colors: Any) -> tuple[Any, ...]:
        """Return colors, alphas and ``meta`` of gsplat's own render."""
        rasterization: Rasterization = load_gsplat(self.means.device).rasterization
        with unregularized_calls():
            return rasterization(
                **self._given(view),
                **colors,
                opacities=opacity.reshape(-1),
                backgrounds=None if self.background is None else self.background[None],
                rasterize_mode="antialiased" if self.antialiased else "classic",
            )

    def _given(self, view: GsplatView) -> dict[str, Any]:
        """Return the arguments that gsplat's functions share, for one camera."""
        camera = {"viewmats": view.viewmat[None], "Ks": view.K[None], "width": view.width, "height": view.height}
        names = ("means", "quats", "scales", "near_plane", "eps2d")
        return camera | {name: getattr(self, name) for name in names} | {"packed": False}

    def _colors(self, gsplat: Any, view: GsplatView) -> Tensor:
        """Return the view-dependent colors, (N, 3)."""
        if self.sh_degree is None:
            return self.colors
        harmonics = gsplat.spherical_harmonics
        if "viewmats" in inspect.signature(harmonics).parameters:  # 1.6 takes the camera, 1.5 the directions
            values = harmonics(self.sh_degree, means=self.means, viewmats=view.viewmat[None], coeffs=self.colors)[0]
        else:
            center = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
            values = harmonics(self.sh_degree, dirs=self.means - center, coeffs=self.colors)
        colors: Tensor = (values + 0.5).clamp(min=0.0)
        return colors


def _pairs(
    gsplat: Any, radii: Tensor, means2d: Tensor, depths: Tensor, conics: Tensor, opacities: Tensor, view: GsplatView
) -> tuple[Tensor, Tensor]:
    """Return Gaussian and pixel indices of all alphas of at least 1/255, nearest first at every pixel, (P,) each."""
    columns, rows = -(-view.width // _TILE), -(-view.height // _TILE)
    _, intersections, order = gsplat.isect_tiles(
        means2d, radii, depths, tile_size=_TILE, tile_width=columns, tile_height=rows
    )
    offsets = gsplat.isect_offset_encode(intersections, 1, columns, rows)  # of 1 image, n_cameras before 1.5.3
    gaussians, pixels, _ = gsplat.rasterize_to_indices_in_range(
        range_start=0,
        range_end=_ALL,
        # gsplat stops at a transmittance of 1e-4; an infinite one never falls below that, so the lists are complete.
        transmittances=torch.full((1, view.height, view.width), torch.inf, device=means2d.device),
        means2d=means2d,
        conics=conics,
        opacities=opacities,
        image_width=view.width,
        image_height=view.height,
        tile_size=_TILE,
        isect_offsets=offsets.reshape(1, rows, columns),
        flatten_ids=order,
    )
    return gaussians.long(), pixels.long()


@functools.lru_cache
def largest_alpha(device: torch.device) -> float:
    """Return this gsplat's clamp of alpha (0.999 up to 1.5, then 0.99), from a render of one opaque splat."""
    one, eye = torch.ones(1, 3, device=device), torch.eye(4, device=device)
    intrinsics = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]], device=device)
    model = GsplatModel(one * eye[2, :3], eye[:1], one, one)
    with torch.no_grad():
        _, alpha = model.render(one[0, :1], GsplatView(eye, intrinsics, 1, 1))
    return float(alpha)
