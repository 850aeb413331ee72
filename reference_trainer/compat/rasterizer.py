"""The public interface of ``diff_gaussian_rasterization`` and its variants on top of the reference renderer."""

from __future__ import annotations

import importlib.machinery
from types import ModuleType

from torch import Tensor, nn

from reference_trainer.compat.radii import in_front, visible_radii
from reference_trainer.compat.settings import GaussianRasterizationSettings, camera_of
from reference_trainer.render import draw, splat
from reference_trainer.render.absolute import splat_weights, with_absolute_gradients

__all__ = ["rasterize", "rasterizer_module"]


def rasterize(
    settings: GaussianRasterizationSettings,
    means: Tensor,
    screen: Tensor,
    opacities: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    *,
    sh: Tensor | None = None,
    colors: Tensor | None = None,
    members: tuple[str, ...],
) -> tuple[Tensor, ...]:
    """Render as a rasterizer of the INRIA family would.

    The gradient of ``screen`` is that of the projected positions, in normalised device coordinates (the picture spans
    [-1, 1]): half the width and height times the gradient per pixel. Its values are not read. With four columns, the
    last two receive the sums over the pixels of its absolute values (AbsGS).

    Two things differ from the CUDA code. A splat is drawn wherever its alpha reaches 1/255; there it ends at the tiles
    that meet a square of three standard deviations. And quaternions are normalised here, so that their gradient has no
    component along them; the repositories normalise them before the call, with the same effect.

    Args:
        settings: of the view.
        means: world coordinates, shape (N, 3).
        screen: receives the screen-space gradients, shape (N, 3) or (N, 4).
        opacities: activated, shape (N, 1) or (N,).
        scales: standard deviations, positive, shape (N, 3).
        quaternions: orientation, wxyz, shape (N, 4).
        sh: spherical-harmonic coefficients, shape (N, K, 3), or
        colors: colours, shape (N, 3).
        members: what the result has after image and radii: ``depth`` or ``inverse_depth``, ``alpha``; for a ``screen``
            of four columns ``weights`` alone.

    Returns:
        The image (3, H, W), not clamped; radii in pixels, shape (N,) int32, 0 for what is out of view; and the members.
        Depth and inverse depth are sums of weight times (inverse) camera depth; they and alpha have shape (1, H, W).
        Weights are every Gaussian's sum of weights over the pixels, shape (N,), without a gradient.

    Raises:
        ValueError: if ``screen`` has another shape, or antialiasing is asked for.
    """
    n = means.shape[0]
    if settings.antialiasing:
        raise ValueError(
            "antialiasing=True is not supported by the stand-in rasterizer: train with antialiasing=False."
        )
    columns = screen.shape[-1]
    if screen.shape != (n, columns) or columns not in (3, 4):
        raise ValueError(f"means2D must have shape ({n}, 3), or ({n}, 4) for AbsGS, got {tuple(screen.shape)}.")
    camera = camera_of(settings)
    if settings.confidence is not None:
        weight = settings.confidence.detach().reshape(n, 1)
        means, scales, quaternions = (_weighted(x, weight) for x in (means, scales, quaternions))
        opacities = _weighted(opacities.reshape(n, 1), weight)
        sh = None if sh is None else _weighted(sh, weight[:, None])
        colors = None if colors is None else _weighted(colors, weight)
    scales = scales * settings.scale_modifier
    splats = splat(means, quaternions, scales, opacities, camera, sh=sh, sh_degree=settings.sh_degree, colors=colors)
    sink = screen.index_select(0, splats.indices) * _per_pixel(camera.width, camera.height, screen)
    # Zeros are added, whose gradient is that of the positions.
    projection = splats.projection
    projection = projection._replace(means=projection.means + (sink - sink.detach())[:, :2])
    if "inverse_depth" in members:
        # The lists are sorted already, so that the depths are only summed.
        projection = projection._replace(depths=projection.depths.reciprocal())
    planes = members if columns == 3 else ()
    rendering = draw(splats._replace(projection=projection), background=settings.bg, depth=bool(planes))
    radii = visible_radii(means, quaternions, scales, camera)
    if columns == 4:
        weights = means.new_zeros(n).index_copy(0, splats.indices, splat_weights(splats))
        return with_absolute_gradients(rendering, sink[:, 2:], settings.bg).image, radii, weights
    found = {"alpha": rendering.alpha, "depth": rendering.depth, "inverse_depth": rendering.depth}
    return (rendering.image, radii, *(found[member][None] for member in planes))  # type: ignore[index]


def _weighted(x: Tensor, weight: Tensor) -> Tensor:
    """Return x with its gradient multiplied by a weight."""
    fixed = x.detach()
    return fixed + (x - fixed) * weight


def _per_pixel(width: int, height: int, screen: Tensor) -> Tensor:
    """Return pixels per unit of normalised device coordinates, for every column of the screen-space points."""
    half = [0.5 * width, 0.5 * height]
    return screen.new_tensor([*half, 0.0] if screen.shape[1] == 3 else half * 2)


def rasterizer_module(name: str, members: tuple[str, ...]) -> ModuleType:
    """Make a module with the interface of a rasterizer package.

    Its class is new for every call: a patch of its ``forward`` ends with the module.

    Args:
        name: ``diff_gaussian_rasterization``, or ``diff_gaussian_rasterization_abs``.
        members: what the rasterizer returns after image and radii, see `rasterize`.

    Example:
        >>> module = rasterizer_module("diff_gaussian_rasterization", ())
        >>> module.GaussianRasterizationSettings._fields[:2]
        ('image_height', 'image_width')
    """
    columns = 4 if name.endswith("_abs") else 3

    class GaussianRasterizer(nn.Module):
        """Renders one view.

        Args:
            raster_settings: of the view.
        """

        def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
            super().__init__()
            self.raster_settings = raster_settings

        def markVisible(self, positions: Tensor) -> Tensor:
            """Say which points (N, 3) lie beyond the near plane; shape (N,) bool."""
            return in_front(positions, camera_of(self.raster_settings))

        def forward(
            self,
            means3D: Tensor,
            means2D: Tensor,
            opacities: Tensor,
            shs: Tensor | None = None,
            colors_precomp: Tensor | None = None,
            scales: Tensor | None = None,
            rotations: Tensor | None = None,
            cov3D_precomp: Tensor | None = None,
        ) -> tuple[Tensor, ...]:
            """Render; see `rasterize`."""
            if cov3D_precomp is not None or scales is None or rotations is None:
                raise ValueError(
                    "the stand-in rasterizer needs scales and rotations, and no cov3D_precomp: the eigenvectors of a "
                    "covariance have no gradient where two axes are equal. Train without --compute_cov3D_python."
                )
            if means2D.shape[1] != columns:
                raise ValueError(f"means2D of {name} must have {columns} columns, got shape {tuple(means2D.shape)}.")
            return rasterize(
                self.raster_settings, means3D, means2D, opacities, scales, rotations,
                sh=shs, colors=colors_precomp, members=members,
            )  # fmt: skip

    GaussianRasterizer.__module__, GaussianRasterizer.__qualname__ = name, "GaussianRasterizer"
    module = ModuleType(name, "A stand-in on top of reference_trainer.render.")
    module.__spec__ = importlib.machinery.ModuleSpec(name, loader=None)
    module.GaussianRasterizationSettings = GaussianRasterizationSettings  # type: ignore[attr-defined]
    module.GaussianRasterizer = GaussianRasterizer  # type: ignore[attr-defined]
    return module
