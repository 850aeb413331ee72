"""The public interface of ``diff_gaussian_rasterization`` and its variants on top of the reference renderer."""

from __future__ import annotations

from types import ModuleType

from torch import Tensor, nn

from reference_trainer.compat.extensions import make_module
from reference_trainer.compat.radii import in_front, visible_radii
from reference_trainer.compat.settings import GaussianRasterizationSettings, camera_of
from reference_trainer.render import draw, splat
from reference_trainer.render.absolute import splat_weights, with_absolute_gradients

__all__ = ["GaussianRasterizer", "rasterizer_module"]


class GaussianRasterizer(nn.Module):
    """Renders one view as a rasterizer of the INRIA family would.

    The gradient of ``means2D`` is that of the projected positions, in normalised device coordinates (the picture spans
    [-1, 1]): half the width and height times the gradient per pixel. Its values are not read. With four columns, the
    last two receive the sums over the pixels of its absolute values (AbsGS).

    Two things differ from the CUDA code. A splat is drawn wherever its alpha reaches 1/255; there it ends at the tiles
    that meet a square of three standard deviations. And quaternions are normalised here, so that their gradient has no
    component along them; the repositories normalise them before the call, with the same effect.

    Args:
        raster_settings: of the view.
    """

    columns = 3
    members: tuple[str, ...] = ()

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
        """Render Gaussians: world coordinates (N, 3), opacities (N, 1) or (N,), scales (N, 3), rotations wxyz (N, 4).

        ``means2D`` (N, 3), or (N, 4) for AbsGS, receives the screen-space gradients. Colours are spherical-harmonic
        coefficients ``shs`` (N, K, 3) or ``colors_precomp`` (N, 3).

        Returns:
            The image (3, H, W), not clamped; radii in pixels, shape (N,) int32, 0 for what is out of view; and the
            members. Depth and inverse depth are sums of weight times (inverse) camera depth; they and alpha have shape
            (1, H, W). Weights are every Gaussian's sum of weights over the pixels, shape (N,), without a gradient.

        Raises:
            ValueError: if ``means2D`` has another shape, or antialiasing or a covariance is asked for.
        """
        settings, n = self.raster_settings, means3D.shape[0]
        if cov3D_precomp is not None or scales is None or rotations is None:
            raise ValueError(
                "the stand-in rasterizer needs scales and rotations, and no cov3D_precomp: the eigenvectors of a "
                "covariance have no gradient where two axes are equal. Train without --compute_cov3D_python."
            )
        if means2D.shape != (n, self.columns):
            raise ValueError(
                f"means2D of {type(self).__module__} must have {self.columns} columns, shape ({n}, {self.columns}), "
                f"got shape {tuple(means2D.shape)}."
            )
        if settings.antialiasing:
            raise ValueError(
                "antialiasing=True is not supported by the stand-in rasterizer: train with antialiasing=False."
            )
        camera = camera_of(settings)
        if settings.confidence is not None:
            weight = settings.confidence.detach().reshape(n, 1)
            means3D, scales, rotations = (_weighted(x, weight) for x in (means3D, scales, rotations))
            opacities = _weighted(opacities.reshape(n, 1), weight)
            shs = None if shs is None else _weighted(shs, weight[:, None])
            colors_precomp = None if colors_precomp is None else _weighted(colors_precomp, weight)
        scales = scales * settings.scale_modifier
        splats = splat(
            means3D, rotations, scales, opacities, camera, sh=shs, sh_degree=settings.sh_degree, colors=colors_precomp
        )
        # Pixels per unit of normalised device coordinates, for every column.
        half = [0.5 * camera.width, 0.5 * camera.height, 0.5 * camera.width, 0.5 * camera.height]
        sink = means2D.index_select(0, splats.indices) * means2D.new_tensor(half[: self.columns])
        # Zeros are added, whose gradient is that of the positions.
        projection = splats.projection
        projection = projection._replace(means=projection.means + (sink - sink.detach())[:, :2])
        if "inverse_depth" in self.members:
            # The lists are sorted already, so that the depths are only summed.
            projection = projection._replace(depths=projection.depths.reciprocal())
        planes = self.members if self.columns == 3 else ()
        rendering = draw(splats._replace(projection=projection), background=settings.bg, depth=bool(planes))
        radii = visible_radii(means3D, rotations, scales, camera)
        if self.columns == 4:
            weights = means3D.new_zeros(n).index_copy(0, splats.indices, splat_weights(splats))
            return with_absolute_gradients(rendering, sink[:, 2:], settings.bg).image, radii, weights
        found = {"alpha": rendering.alpha, "depth": rendering.depth, "inverse_depth": rendering.depth}
        return (rendering.image, radii, *(found[member][None] for member in planes))  # type: ignore[index]


def _weighted(x: Tensor, weight: Tensor) -> Tensor:
    """Return x with its gradient multiplied by a weight."""
    fixed = x.detach()
    return fixed + (x - fixed) * weight


def rasterizer_module(name: str, members: tuple[str, ...]) -> ModuleType:
    """Make a module with the interface of a rasterizer package, maybe that of AbsGS, ``..._abs``.

    Its class is new for every call: a patch of its ``forward`` ends with the module. ``members`` is what the result has
    after image and radii: ``depth`` or ``inverse_depth``, ``alpha``; for AbsGS ``weights`` alone.

    Example:
        >>> module = rasterizer_module("diff_gaussian_rasterization", ())
        >>> module.GaussianRasterizationSettings._fields[:2]
        ('image_height', 'image_width')
    """
    columns, forward = 4 if name.endswith("_abs") else 3, GaussianRasterizer.forward
    own = {"members": members, "columns": columns, "forward": forward, "__module__": name}
    rasterizer = type("GaussianRasterizer", (GaussianRasterizer,), own)
    return make_module(name, GaussianRasterizationSettings=GaussianRasterizationSettings, GaussianRasterizer=rasterizer)
