"""The public interface of ``diff_gaussian_rasterization`` and its variants on top of the reference renderer."""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

from reference_trainer.compat.antialiasing import filtered
from reference_trainer.compat.contributions import contributions
from reference_trainer.compat.extensions import make_module
from reference_trainer.compat.outputs import Picture, Unknown, kinds_of
from reference_trainer.compat.settings import GaussianRasterizationSettings, camera_of, warn_of_ignored
from reference_trainer.compat.surfels import surface_planes
from reference_trainer.compat.unpacking import names_of_results
from reference_trainer.model.gaussians import compute_relocation
from reference_trainer.render import rasterize, splat
from reference_trainer.render.constants import DILATION
from reference_trainer.render.densification import in_front, splat_weights, visible_radii, with_absolute_gradients

__all__ = ["GaussianRasterizer", "rasterizer_module"]

FIELDS = ("antialiasing", "confidence", "pixel_weights")  # of the settings, which tell what the outputs are
SCORES = ("accum_weights", "accum_count", "accum_blend", "accum_dist", "depths")
SURFACES = {"normal", "mean_depth", "distortion"}
FLOOR = 2.5e-5  # least ratio of determinants in INRIA's antialiasing
FLOOR_OF_MIP = 1e-6  # the same in Mip-Splatting


class GaussianRasterizer(nn.Module):
    """Renders one view as a rasterizer of the INRIA family would.

    The gradient of ``means2D`` is that of the projected positions, in normalized device coordinates (the picture spans
    [-1, 1]): half the width and height times the gradient per pixel. Its values are not read. With four columns, the
    last two receive the sums over the pixels of its absolute values (AbsGS).

    Two things differ from the CUDA code. A splat is drawn wherever its alpha reaches 1/255; there it ends at the tiles
    that meet a square of three standard deviations. And quaternions are normalized here, so that their gradient has no
    component along them; the repositories normalize them before the call, with the same effect.

    Args:
        raster_settings: of the view.
    """

    outputs: tuple[str, ...] | None = None

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Say which points (N, 3) lie beyond the near plane; shape (N,) bool."""
        return in_front(positions, camera_of(self.raster_settings))

    def visible_filter(
        self, means3D: Tensor, scales: Tensor, rotations: Tensor, cov3D_precomp: Tensor | None = None
    ) -> Tensor:
        """Return the radii of Gaussians, as `forward` does, without drawing them (Scaffold-GS)."""
        scales, rotations = self._axes(scales, rotations, cov3D_precomp)
        return visible_radii(means3D, rotations, scales, camera_of(self.raster_settings))

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
        dc: Tensor | None = None,
        **further: Any,
    ) -> tuple[Any, ...]:
        """Render Gaussians: world coordinates (N, 3), opacities (N, 1) or (N,), scales (N, 3), rotations wxyz (N, 4).

        ``means2D`` (N, 3), or (N, 4) for AbsGS, receives the screen-space gradients. Colors are spherical-harmonic
        coefficients ``shs`` (N, K, 3), whose first band may stand apart in ``dc`` (N, 1, 3), or ``colors_precomp`` (N,
        3). Scales (N, 2) are those of surfels (2DGS), which are drawn as flat Gaussians. Further arguments are
        ignored, with a warning unless they are None, False or zeros.

        Returns:
            The values that the caller unpacks, told by its names, see `kinds_of`; by default first the image (3, H, W),
            not clamped, and radii in pixels, (N,) int32, 0 for what is out of view. Depth and inverse depth are sums
            of weight times (inverse) camera depth; they and alpha have shape (1, H, W). Weights are every Gaussian's
            sum of weights over the pixels, shape (N,), pixels (N, 1) the number of those at which it is drawn, both
            without a gradient; so are the scores of Taming 3DGS, see `contributions`. Normals, mean depth and
            distortion are those of `surface_planes`.

        Raises:
            ValueError: if ``means2D`` has another shape, a covariance is given, the outputs cannot be told, or a
                further argument waits for a gradient of every Gaussian: zeros that require one.
        """
        settings, (n, columns) = self.raster_settings, means2D.shape
        names = self.outputs or names_of_results()
        kinds = kinds_of(names, {name for name in FIELDS if getattr(settings, name) is not None})
        parts = {part for kind in kinds if kind is not None for part in kind.split("+")}
        for name, value in further.items():
            if isinstance(value, Tensor) and value.requires_grad and len(value) == n and not value.any():
                raise ValueError(
                    f"the argument {name} of the rasterizer, zeros of shape {tuple(value.shape)}, waits for a gradient "
                    "that only the CUDA code computes: run without --cpu, or switch off what asks for it."
                )
        warn_of_ignored("argument", further)
        if n != len(means3D) or not 2 <= columns <= 4:
            raise ValueError(
                f"means2D of {type(self).__module__} must have shape ({len(means3D)}, 3), or 4 columns for sums of "
                f"absolute gradients, got {tuple(means2D.shape)}."
            )
        scales, rotations = self._axes(scales, rotations, cov3D_precomp)
        if dc is not None and shs is not None:
            shs = torch.cat([dc, shs], dim=1)
        camera = camera_of(settings)
        if settings.confidence is not None:
            weight = settings.confidence.detach().reshape(n, 1)
            means3D, scales, rotations = (_weighted(x, weight) for x in (means3D, scales, rotations))
            opacities = _weighted(opacities.reshape(n, 1), weight)
            shs = None if shs is None else _weighted(shs, weight[:, None])
            colors_precomp = None if colors_precomp is None else _weighted(colors_precomp, weight)
        splats = splat(
            means3D, rotations, scales, opacities, camera, sh=shs, sh_degree=settings.sh_degree, colors=colors_precomp
        )
        blur = DILATION if settings.kernel_size is None else float(settings.kernel_size)
        if settings.antialiasing or settings.kernel_size is not None:
            floor = FLOOR if settings.antialiasing else FLOOR_OF_MIP
            splats = filtered(splats, means3D, rotations, scales, camera, blur=blur, floor=floor)
        # Pixels per unit of normalized device coordinates, for every column.
        half = [0.5 * camera.width, 0.5 * camera.height, 0.5 * camera.width, 0.5 * camera.height]
        sink = means2D.index_select(0, splats.indices) * means2D.new_tensor(half[:columns])
        # Adds zeros, which receive the gradient of the projected positions.
        projection = splats.projection
        splats = splats._replace(projection=projection._replace(means=projection.means + (sink - sink.detach())[:, :2]))
        inverse, surfaces = "inverse_depth" in parts, not SURFACES.isdisjoint(parts)
        true_depth = surfaces or "depth" in parts
        depths = projection.depths.reciprocal() if inverse else projection.depths  # only summed: sorting is done
        rendering = rasterize(
            splats._replace(projection=splats.projection._replace(depths=depths)),
            background=settings.bg,
            depth=inverse or true_depth,
        )
        if columns == 4:
            rendering = with_absolute_gradients(rendering, sink[:, 2:], settings.bg)
        found: dict[str, Tensor] = {"image": rendering.image, "alpha": rendering.alpha[None]}
        if rendering.depth is not None:
            found["inverse_depth" if inverse else "depth"] = rendering.depth[None]
        if inverse and true_depth:  # absolute gradients are those of the first picture
            rendering = rasterize(splats, depth=True)
            assert rendering.depth is not None
            found["depth"] = rendering.depth[None]
        if "weights" in parts:
            found["weights"] = means3D.new_zeros(n).index_copy(0, splats.indices, splat_weights(splats))
        if surfaces:
            found |= surface_planes(rendering._replace(splats=splats), means3D, rotations, scales, camera)
        drawn = rendering.alpha.detach() > 0
        found["radii"] = visible_radii(means3D, rotations, scales, camera, blur=blur)
        if settings.pixel_weights is not None or "pixels" in parts:
            image = (rendering.alpha if settings.pixel_weights is None else settings.pixel_weights).reshape(drawn.shape)
            table = torch.stack([*contributions(splats, image), projection.depths.detach()])
            table = table.new_zeros(5, n).index_copy(1, splats.indices, table)
            found |= dict(zip(SCORES, table, strict=True)) | {"my_radii": found["radii"], "pixels": table[1, :, None]}
        labels = (*(names or kinds), "radii")  # for a caller that names only one value
        return tuple(_output(kind, label, found, drawn) for kind, label in zip(kinds, labels, strict=False))

    def _axes(
        self, scales: Tensor | None, rotations: Tensor | None, covariances: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return standard deviations (N, 3), those of surfels with a third of 0, and rotations; refuse covariances."""
        if covariances is not None or scales is None or rotations is None:
            raise ValueError(
                "the stand-in rasterizer needs scales and rotations, and no cov3D_precomp: the eigenvectors of a "
                "covariance have no gradient where two axes are equal. Train without --compute_cov3D_python."
            )
        lengths = torch.nn.functional.pad(scales, (0, 3 - scales.shape[1]))
        return lengths * self.raster_settings.scale_modifier, rotations


def _output(kind: str | None, label: str | None, found: dict[str, Tensor], drawn: Tensor) -> Tensor | Unknown:
    """Return a value as CUDA code would, its planes (..., H, W) stacked; an `Unknown` with its label if one is lacking.

    Planes are a copy, which the caller may overwrite (DNGaussian). Their gradient is taken only where something is
    drawn: elsewhere that of depth / alpha, say, is nan (2DGS).
    """
    parts = str(kind).split("+")
    if not found.keys() >= set(parts):
        return Unknown(str(label))
    if found[parts[0]].shape[-2:] != drawn.shape:
        return found[parts[0]]
    planes = torch.cat([found[part] for part in parts])
    if planes.requires_grad:
        planes.register_hook(lambda gradient: torch.where(drawn, gradient, 0.0))  # type: ignore[no-untyped-call]
    return planes.as_subclass(Picture)


def _weighted(x: Tensor, weight: Tensor) -> Tensor:
    """Return x with its gradient multiplied by a weight."""
    fixed = x.detach()
    return fixed + (x - fixed) * weight


def rasterizer_module(name: str, names: Iterable[str] = (), outputs: tuple[str, ...] | None = None) -> ModuleType:
    """Make a module with the interface of a rasterizer package.

    Its classes are new for every call: a patch of their ``forward`` ends with the module. ``names`` are those of
    further classes, of settings if they end with ``Settings``; ``outputs`` names the rendered values, by default as
    their caller does. Importing anything else from it raises an ImportError with its name.

    Example:
        >>> module = rasterizer_module("diff_gaussian_rasterization")
        >>> module.GaussianRasterizationSettings._fields[:2]
        ('image_height', 'image_width')
    """

    def refuse(attribute: str) -> NoReturn:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        raise ImportError(f"the stand-in for {name} has no {attribute}, which needs CUDA.")

    own = {"outputs": outputs, "forward": GaussianRasterizer.forward, "__module__": name}
    members: dict[str, Any] = {
        each: GaussianRasterizationSettings
        if each.endswith("Settings")
        else type(each, (GaussianRasterizer,), dict(own))
        for each in {"GaussianRasterizationSettings", "GaussianRasterizer", *names}
    }
    return make_module(name, **members, compute_relocation=_relocation, __getattr__=refuse)


def _relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, n_max: int) -> tuple[Tensor, Tensor]:
    """Return what `compute_relocation` does, for at most ``n_max`` Gaussians (3DGS-MCMC)."""
    return compute_relocation(opacities, scales, ratios, binoms[:n_max])
