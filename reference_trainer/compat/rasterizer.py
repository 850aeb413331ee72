"""The public interface of ``diff_gaussian_rasterization`` and its variants on top of the reference renderer."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any, NamedTuple, Self, TypeVar, cast

import torch
from torch import Tensor, nn

from reference_trainer.camera import Camera
from reference_trainer.compat.extensions import Refusing, make_module
from reference_trainer.compat.outputs import Planes, Unknown, kinds_of, names_of_results
from reference_trainer.compat.planes import contributions, filtered, heaviest, surface_planes
from reference_trainer.model.gaussians import compute_relocation
from reference_trainer.render import rasterize, splat
from reference_trainer.render.constants import DILATION
from reference_trainer.render.densification import in_front, splat_weights, visible_radii, with_absolute_gradients
from reference_trainer.render.splats import Splats

__all__ = [
    "GaussianRasterizationSettings", "GaussianRasterizer", "axes_of", "camera_of", "rasterizer_module", "splats_of",
    "warn_of_ignored",
]  # fmt: skip

F = TypeVar("F", bound=Callable[..., Any])

TOLERANCE = 1e-3  # of the entries of a projection matrix that went through single precision twice
ROUNDING = 1e-6  # of what is 0 there, but is a difference of numbers as large as the camera is far from the origin


class _Fields(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    confidence: Tensor | None = None
    antialiasing: bool | None = None
    pixel_weights: Tensor | None = None
    kernel_size: float | None = None
    get_flag: bool | None = None
    metric_map: Tensor | None = None


class GaussianRasterizationSettings(_Fields):
    """What the rasterizers of the INRIA family are told about a view: the fields of several variants.

    Convention: matrices act on row vectors (``x_world @ viewmatrix``), so they are the transposes of the textbook's.
    ``viewmatrix`` is world to camera, ``projmatrix`` world to clip space, both (4, 4); sizes are in pixels, ``tanfovx``
    and ``tanfovy`` tangents of half the fields of view. ``confidence`` (N, 1) is a factor on the gradients of every
    Gaussian (FSGS, CoR-GS), ``antialiasing`` that of INRIA since October 2024, ``pixel_weights`` (H, W) asks for the
    scores of Taming 3DGS, ``kernel_size`` is the blur of Mip-Splatting, square pixels, and with ``get_flag`` the
    pixels at which ``metric_map`` (H W,) is 1 are counted (FastGS). ``campos``, which the view
    matrix tells as well, ``prefiltered`` and ``debug`` are ignored; so are further fields, with a warning unless they
    are None, False or zeros.
    """

    __slots__ = ()

    def __new__(cls, *values: Any, **fields: Any) -> Self:
        """Take the fields that the stand-in knows."""
        further = {name: fields.pop(name) for name in fields.keys() - set(cls._fields)}
        warn_of_ignored("setting", further)
        return super().__new__(cls, *values, **fields)

    @property
    def blur(self) -> float:
        """By which splats are blurred, square pixels."""
        return DILATION if self.kernel_size is None else float(self.kernel_size)


def warn_of_ignored(kind: str, values: dict[str, Any]) -> None:
    """Warn, once per name, of values that the stand-in ignores; not of None, False or zeros without a gradient."""
    for name, value in sorted(values.items()):
        if (value.requires_grad or value.any()) if isinstance(value, Tensor) else value not in (None, False):
            _warn(kind, name)


@functools.cache
def _warn(kind: str, name: str) -> None:
    warnings.warn(
        f"the stand-in rasterizer does not know the {kind} {name}, and ignores it: what it does on a GPU is missing.",
        stacklevel=3,
    )


def camera_of(settings: GaussianRasterizationSettings) -> Camera:
    """Return the camera of a rasterizer call.

    The principal point is the projection matrix's: the picture's center in the INRIA code, elsewhere in some forks.

    Raises:
        ValueError: if the projection matrix is not that of a pinhole camera with the settings' fields of view.

    Example:
        >>> projection = torch.tensor([[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]])
        >>> camera = camera_of(GaussianRasterizationSettings(
        ...     24, 32, 0.5, 0.5, torch.zeros(3), 1.0, torch.eye(4), projection, 0, torch.zeros(3)))
        >>> camera.fx, camera.fy, camera.cx, camera.cy
        (32.0, 24.0, 16.0, 12.0)
    """
    width, height = int(settings.image_width), int(settings.image_height)
    view = settings.viewmatrix.detach().double()
    projection = torch.linalg.solve(view, settings.projmatrix.detach().double())[:, [0, 1, 3]]
    shift_x, shift_y = projection[2, :2].tolist()
    across, down = 1 / settings.tanfovx, 1 / settings.tanfovy
    expected = view.new_tensor([[across, 0, 0], [0, down, 0], [shift_x, shift_y, 1], [0, 0, 0]])
    errors, allowed = (projection - expected).abs(), TOLERANCE * (1 + expected.abs())
    allowed[3] += ROUNDING * view[3].abs().max()
    if not bool((errors <= allowed).all()):
        raise ValueError(
            "viewmatrix^-1 projmatrix must be a pinhole camera with the fields of view tanfovx="
            f"{settings.tanfovx} and tanfovy={settings.tanfovy}; its columns x, y and w are {projection.tolist()}. "
            "Both matrices must be transposed (for row vectors), as the INRIA code passes them."
        )
    return Camera(
        world_to_camera=settings.viewmatrix.detach().T,
        fx=width / (2 * settings.tanfovx),
        fy=height / (2 * settings.tanfovy),
        cx=0.5 * width * (1 + shift_x),
        cy=0.5 * height * (1 + shift_y),
        width=width,
        height=height,
    )


FIELDS = ("antialiasing", "confidence", "pixel_weights")  # of the settings, which tell what the outputs are
SCORES = ("accum_weights", "accum_count", "accum_blend", "accum_dist", "depths")
SURFACES = {"normal", "mean_depth", "distortion"}
FLOOR = 2.5e-5  # least ratio of determinants in INRIA's antialiasing
FLOOR_OF_MIP = 1e-6  # the same in Mip-Splatting


def axes_of(
    settings: GaussianRasterizationSettings, scales: Tensor | None, rotations: Tensor | None, covariances: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return standard deviations (N, 3), those of surfels with a third of 0, and rotations; refuse covariances."""
    if covariances is not None or scales is None or rotations is None:
        raise ValueError(
            "the stand-in rasterizer needs scales and rotations, and no cov3D_precomp: the eigenvectors of a "
            "covariance have no gradient where two axes are equal. Go without --compute_cov3D_python "
            "(pipe.compute_cov3D_python = False)."
        )
    lengths = torch.nn.functional.pad(scales, (0, 3 - scales.shape[1]))
    return lengths * settings.scale_modifier, rotations


def splats_of(
    settings: GaussianRasterizationSettings, means: Tensor, rotations: Tensor, scales: Tensor, opacities: Tensor,
    camera: Camera, *, sh: Tensor | None, colors: Tensor | None,
) -> Splats:  # fmt: skip
    """Project Gaussians with the blur and the antialiasing of the settings; arguments and errors as of `splat`."""
    splats = splat(means, rotations, scales, opacities, camera, sh=sh, sh_degree=settings.sh_degree, colors=colors)
    if settings.antialiasing or settings.kernel_size is not None:
        floor = FLOOR if settings.antialiasing else FLOOR_OF_MIP
        splats = filtered(splats, means, rotations, scales, camera, blur=settings.blur, floor=floor)
    return splats


def _without_autocast(method: F) -> F:
    """Let a method of a rasterizer compute in the precision of its arguments, as CUDA code does."""

    @functools.wraps(method)
    def precise(self: GaussianRasterizer, *args: Any, **kwargs: Any) -> Any:
        with torch.autocast(self.raster_settings.viewmatrix.device.type, enabled=False):
            return method(self, *args, **kwargs)

    return cast("F", precise)


class GaussianRasterizer(nn.Module):
    """Renders one view as a rasterizer of the INRIA family would.

    The gradient of ``means2D`` is that of the projected positions, in normalized device coordinates (the picture spans
    [-1, 1]): half the width and height times the gradient per pixel. Its values are not read. With four columns, the
    last two receive the sums over the pixels of its absolute values (AbsGS).

    Two things differ from the CUDA code. A splat is rendered wherever its alpha reaches 1/255; there it ends at the
    tiles that meet a square of three standard deviations. And quaternions are normalized here, so that their gradient
    has no component along them; the repositories normalize them before the call, with the same effect.

    Args:
        raster_settings: of the view.
    """

    outputs: tuple[str, ...] | None = None
    _names: tuple[str, ...] | None = None  # of the call before: one that is made again, as for a white pass, has none

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    @_without_autocast
    def markVisible(self, positions: Tensor) -> Tensor:
        """Say which points (N, 3) lie beyond the near plane; shape (N,) bool."""
        return in_front(positions, camera_of(self.raster_settings))

    @_without_autocast
    def visible_filter(
        self, means3D: Tensor, scales: Tensor, rotations: Tensor, cov3D_precomp: Tensor | None = None
    ) -> Tensor:
        """Return the radii of Gaussians, as `forward` does, without rendering them (Scaffold-GS)."""
        scales, rotations = axes_of(self.raster_settings, scales, rotations, cov3D_precomp)
        return visible_radii(means3D, rotations, scales, camera_of(self.raster_settings))

    @_without_autocast
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
        means2D_densify: Tensor | None = None,
        **further: Any,
    ) -> tuple[Any, ...]:
        """Render Gaussians: world coordinates (N, 3), opacities (N, 1) or (N,), scales (N, 3), rotations wxyz (N, 4).

        ``means2D`` (N, 3) receives the screen-space gradients, the last columns of (N, 4) the sums of their absolute
        values over the pixels (AbsGS), as do the first two of ``means2D_densify`` (Deformable-3D-Gaussians).
        Colors are spherical-harmonic coefficients ``shs`` (N, K, 3), whose first band may stand apart in ``dc`` (N, 1,
        3), or ``colors_precomp`` (N, 3). Scales (N, 2) are those of surfels (2DGS), rendered as flat Gaussians.
        Further arguments are ignored, with a warning unless they are None, False or zeros.

        Returns:
            The values that the caller unpacks, told by its names, see `kinds_of`; by default first the image (3, H, W),
            not clamped, and radii in pixels, (N,) int32, 0 for what is out of view. Depth and inverse depth are sums
            of weight times (inverse) camera depth; they and alpha have shape (1, H, W). Weights are every Gaussian's
            sum of weights over the pixels, shape (N,), pixels (N, 1) the number of those at which it is rendered, both
            without a gradient; so are the scores of Taming 3DGS, see `contributions`, the counts of FastGS (N,), and
            for every pixel the Gaussian of the largest weight, -1 for none, and that weight (1, H, W). Normals, mean
            depth and distortion are those of `surface_planes`.

        Raises:
            ValueError: if ``means2D`` has another shape, a covariance is given, the outputs cannot be told, or a
                further argument waits for a gradient of every Gaussian: zeros that require one.
        """
        settings, (n, columns) = self.raster_settings, means2D.shape
        names = self._names = self.outputs or names_of_results() or self._names
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
        scales, rotations = axes_of(settings, scales, rotations, cov3D_precomp)
        if dc is not None and shs is not None:
            shs = torch.cat([dc, shs], dim=1)
        camera = camera_of(settings)
        if settings.confidence is not None:
            weight = settings.confidence.detach().reshape(n, 1)
            means3D, scales, rotations = (_weighted(x, weight) for x in (means3D, scales, rotations))
            opacities = _weighted(opacities.reshape(n, 1), weight)
            shs = None if shs is None else _weighted(shs, weight[:, None])
            colors_precomp = None if colors_precomp is None else _weighted(colors_precomp, weight)
        splats = splats_of(settings, means3D, rotations, scales, opacities, camera, sh=shs, colors=colors_precomp)
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
        # Both trainers densify by these: signed gradients of a large splat cancel between its two sides.
        if means2D_densify is not None:
            absolute = means2D_densify.index_select(0, splats.indices)[:, :2] * means2D.new_tensor(half[:2])
            rendering = with_absolute_gradients(rendering, absolute, settings.bg)
        elif columns == 4:
            rendering = with_absolute_gradients(rendering, sink[:, 2:], settings.bg)
        found: dict[str, Tensor] = {"image": rendering.image, "alpha": rendering.alpha[None]}
        if rendering.depth is not None:
            found["inverse_depth" if inverse else "depth"] = rendering.depth[None]
        if inverse and true_depth:  # absolute gradients are those of the first picture
            rendering = rasterize(splats, depth=True)
            assert rendering.depth is not None
            found["depth"] = rendering.depth[None]
        if "weights" in parts:
            found["weights"] = splats.to_all(splat_weights(splats), n)
        if surfaces:
            found |= surface_planes(rendering._replace(splats=splats), means3D, rotations, scales, camera)
        covered = rendering.alpha.detach() > 0
        found["radii"] = visible_radii(means3D, rotations, scales, camera, blur=settings.blur)
        if settings.pixel_weights is not None or "pixels" in parts:
            image = rendering.alpha if settings.pixel_weights is None else settings.pixel_weights
            sums = (*contributions(splats, image.reshape(covered.shape)), projection.depths.detach())
            scores = [splats.to_all(each, n) for each in sums]
            found |= dict(zip(SCORES, scores, strict=True)) | {"my_radii": found["radii"], "pixels": scores[1][:, None]}
        if "metric_counts" in parts:
            chosen = torch.zeros_like(covered) if settings.metric_map is None else settings.metric_map == 1
            count = contributions(splats, (chosen.view_as(covered) & bool(settings.get_flag)).to(means3D))[0]
            found["metric_counts"] = splats.to_all(count, n).int()
        if not parts.isdisjoint(("heaviest", "largest_weight")):
            gaussian, weight = heaviest(splats)
            found |= {"heaviest": gaussian[None].int(), "largest_weight": weight[None]}
        labels = (*(names or kinds), "radii")  # for a caller that names only one value
        return tuple(_output(kind, label, found, covered) for kind, label in zip(kinds, labels, strict=False))


def _output(kind: str | None, label: str | None, found: dict[str, Tensor], covered: Tensor) -> Tensor | Unknown:
    """Return a value as CUDA code would, its planes (..., H, W) stacked; an `Unknown` with its label if one is lacking.

    Planes are a copy, which the caller may overwrite (DNGaussian). Their gradient is taken only where something is
    rendered: elsewhere that of depth / alpha, say, is nan (2DGS).
    """
    parts = str(kind).split("+")
    if not found.keys() >= set(parts):
        return Unknown(str(label))
    if found[parts[0]].shape[-2:] != covered.shape:
        return found[parts[0]]
    planes = torch.cat([found[part] for part in parts])
    if planes.requires_grad:
        planes.register_hook(lambda gradient: torch.where(covered, gradient, 0.0))  # type: ignore[no-untyped-call]
    return planes.as_subclass(Planes)


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

    def refuse(attribute: str) -> Refusing:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        if attribute == "_C":  # imported by some, and used by fewer
            return Refusing(f"{name}._C")
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
