"""``gsplat.rasterization`` on top of the reference renderer, in the place of gsplat's, for scripts without CUDA."""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor

from ca_reg.integrations.gsplat import load_gsplat, version_numbers
from reference_trainer.camera import Camera
from reference_trainer.compat.extensions import Refusing, make_module
from reference_trainer.compat.planes import filtered
from reference_trainer.model.gaussians import compute_relocation
from reference_trainer.render import Splats, rasterize, splat
from reference_trainer.render.constants import DILATION, MIN_ALPHA, NEAR_PLANE
from reference_trainer.render.densification import MAX_RADIUS, absgrad_sink, longer_radii, with_absolute_gradients
from reference_trainer.rotations import rotation_matrices

__all__ = ["gsplat_functions", "make_rasterization", "quat_scale_to_covar_preci"]

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
READ = {
    "means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height", "near_plane", "far_plane",
    "radius_clip", "eps2d", "sh_degree", "packed", "backgrounds", "render_mode", "absgrad", "rasterize_mode",
}  # fmt: skip
WITHOUT_EFFECT = {"tile_size", "channel_chunk", "segmented", "sparse_grad", "ut_params", "renderer_config"}
NEAREST = 1e-6  # a nearer near plane is taken for this one
EXTENT = 3.33  # standard deviations at which an opaque splat has faded to `MIN_ALPHA`
SMALLEST_SPREAD = 0.1  # px^2, of gsplat 1.4
ADVICE = "on a CPU gsplat.rasterization runs, and with it the default and the MCMC strategy"

Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def make_rasterization(original: Rasterization, *, per_axis: bool) -> Rasterization:
    """Make a function with the arguments and results of ``gsplat.rasterization``, for any device.

    It renders the Gaussians that gsplat 1.5 renders, with its near plane, far plane and radii; all arguments but those
    that affect only speed are obeyed or refused. Differences: alpha is clamped at 0.99, as in gsplat 1.6 (0.999
    before), and gradients pass the clamp; the projection is linearized within a margin around the middle of the
    picture, not around the principal point; Gaussians fainter than 1/255 have no radius, with gsplat 1.4 too.

    ``info`` holds ``means2d`` (pixels, part of the graph: `retain_grad` it; ``absgrad`` appears on it at the backward
    pass if it was asked for), ``radii``, ``depths``, ``opacities``, the numbers ``batch_ids``, ``camera_ids`` and
    ``gaussian_ids`` in packed mode, and ``width``, ``height``, ``n_batches`` and ``n_cameras``.

    Args:
        original: the function of the gsplat that is installed, whose signature is taken over; it is not called.
        per_axis: whether radii are those of gsplat since 1.5, per axis, [C, N, 2], or packed [nnz, 2]; else those of
            1.4, [C, N] or [nnz].

    Returns:
        The function. It raises ValueError, which names them, for arguments that the renderer does not support: cameras
        other than pinholes, an ``eps2d`` above 0.3, covariances, batches of scenes, features other than colors,
        ``distributed``, the unscented transform, and gradients of the poses.

    Example:
        >>> def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01,
        ...                   far_plane=1e10, radius_clip=0.0, sh_degree=None, packed=True, backgrounds=None,
        ...                   render_mode="RGB", absgrad=False, rasterize_mode="classic", eps2d=0.3): ...
        >>> render_on_any_device = make_rasterization(rasterization, per_axis=True)
        >>> one, pose = torch.ones(1, 3), torch.eye(4)[None]
        >>> intrinsics = torch.tensor([[[50.0, 0, 16], [0, 50, 16], [0, 0, 1]]])
        >>> image, alpha, info = render_on_any_device(
        ...     one * pose[0, 2, :3], pose[0, :1], 0.1 * one, one[0, :1], one, pose, intrinsics, 32, 32)
        >>> image.shape, alpha.shape, info["radii"].tolist()
        (torch.Size([1, 32, 32, 3]), torch.Size([1, 32, 32, 1]), [[17, 17]])
    """
    signature = inspect.signature(original)

    @functools.wraps(original)
    def rasterization(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        for name, value in bound.arguments.items():
            default = signature.parameters[name].default
            if name not in READ | WITHOUT_EFFECT and (isinstance(value, Tensor) or value != default):
                _refuse(name, f"got {_describe(value)}: leave it at {default!r}")
        given = SimpleNamespace(**bound.arguments)
        _check(given)
        with torch.autocast(given.means.device.type, enabled=False):  # which gsplat's kernels do not know
            return _rasterize(given, per_axis)

    return rasterization


class _View(NamedTuple):
    """What one camera sees: M of the N Gaussians; gsplat's radii (M, 2), 0 for what it does not render.

    ``listed`` holds the indices of those with a radius, among the M.
    """

    splats: Splats
    radii: Tensor
    listed: Tensor


def _rasterize(given: SimpleNamespace, per_axis: bool) -> tuple[Tensor, Tensor, dict[str, Any]]:
    # The renderer's near plane is fixed; a change of the unit of length moves it, and leaves the picture as it is.
    unit = NEAR_PLANE / max(given.near_plane, NEAREST)
    means, scales = given.means * unit, given.scales * unit
    views = [_look(given, number, means, scales, unit, per_axis) for number in range(len(given.viewmats))]
    counts = [len(view.listed) for view in views]

    def tabulate(values: list[Tensor]) -> Tensor:
        """Arrange what M Gaussians of every camera have: [nnz, ...], or [C, N, ...] with zeros for the others."""
        if given.packed:
            return torch.cat([x[view.listed] for x, view in zip(values, views, strict=True)])
        return torch.stack([view.splats.to_all(x, len(means)) for x, view in zip(values, views, strict=True)])

    def rows(table: Tensor, number: int, others: Tensor) -> Tensor:
        """Return what a table has for the M Gaussians of a camera, and ``others`` for those that it does not list."""
        if given.packed:
            return others.index_copy(0, views[number].listed, torch.split(table, counts)[number])
        return table[number].index_select(0, views[number].splats.indices)

    means2d = tabulate([view.splats.projection.means for view in views])
    sink = absgrad_sink(means2d) if given.absgrad and means2d.requires_grad else None
    images, alphas = [], []
    for number, view in enumerate(views):
        projection = view.splats.projection
        moved = projection._replace(means=rows(means2d, number, projection.means))
        background = None if given.backgrounds is None or "RGB" not in given.render_mode else given.backgrounds[number]
        rendering = rasterize(
            view.splats._replace(projection=moved), background=background, depth="D" in given.render_mode
        )
        if sink is not None:
            nothing = torch.zeros_like(projection.means)
            rendering = with_absolute_gradients(rendering, rows(sink, number, nothing), background)
        planes = [*rendering.image] if "RGB" in given.render_mode else []
        if rendering.depth is not None:
            weight = rendering.alpha.clamp_min(1e-10) if "ED" in given.render_mode else 1.0
            planes.append(rendering.depth / (unit * weight))
        images.append(torch.stack(planes, dim=-1))
        alphas.append(rendering.alpha[..., None])
    radii = tabulate([view.radii for view in views])
    cameras = torch.arange(len(views), device=means.device).repeat_interleave(torch.tensor(counts, device=means.device))
    info = {
        "batch_ids": torch.zeros_like(cameras) if given.packed else None,
        "camera_ids": cameras if given.packed else None,
        "gaussian_ids": torch.cat([v.splats.indices[v.listed] for v in views]) if given.packed else None,
        "radii": radii if per_axis else radii.amax(-1),
        "means2d": means2d,
        "depths": tabulate([view.splats.projection.depths / unit for view in views]),
        "opacities": tabulate([view.splats.opacities for view in views]),
        "width": given.width,
        "height": given.height,
        "n_batches": 1,
        "n_cameras": len(views),
    }
    return torch.stack(images), torch.stack(alphas), info


def _look(given: SimpleNamespace, number: int, means: Tensor, scales: Tensor, unit: float, per_axis: bool) -> _View:
    """Project the Gaussians of a camera, and leave out those that gsplat leaves out."""
    pose = given.viewmats[number].detach().clone()
    pose[:3, 3] *= unit
    (fx, _, cx), (_, fy, cy), _ = given.Ks[number].tolist()
    camera = Camera(pose, fx, fy, cx, cy, given.width, given.height)
    splats = splat(means, given.quats, scales, given.opacities, camera, **_colors(given, number))
    floor = 1e-10 if given.rasterize_mode == "antialiased" else None
    if floor is not None or given.eps2d != DILATION:
        splats = filtered(splats, means, given.quats, scales, camera, blur=given.eps2d, floor=floor)
    projection = splats.projection
    centers, extents = projection.means.detach(), _extents(splats, per_axis)
    size = centers.new_tensor([given.width, given.height])
    inside = ((centers + extents > 0) & (centers - extents < size)).all(1)
    shown = inside & (extents > given.radius_clip).any(1) & (projection.depths.detach() <= given.far_plane * unit)
    if bool((splats.lists.touched & ~shown).any()):
        splats = splats.engine.masked(splats, splats.opacities * shown)
    return _View(splats, (extents * shown[:, None]).int(), shown.nonzero()[:, 0])


def _colors(given: SimpleNamespace, number: int) -> dict[str, Any]:
    """Return the colors of a camera as arguments of `splat`."""
    if "RGB" not in given.render_mode:
        return {"colors": torch.zeros_like(given.means)}
    shared = given.colors.ndim == (2 if given.sh_degree is None else 3)
    colors = given.colors if shared else given.colors[number]
    return {"colors": colors} if given.sh_degree is None else {"sh": colors, "sh_degree": given.sh_degree}


@torch.no_grad()
def _extents(splats: Splats, per_axis: bool) -> Tensor:
    """Return half the sides of the rectangles that gsplat renders splats in, whole pixels, shape (M, 2)."""
    # Since 1.5 a splat ends where its alpha falls to 1/255, on each axis; before, at three of its longest deviations.
    if per_axis:
        xx, _, yy = splats.projection.covariances.unbind(-1)
        extent = (2 * (splats.opacities / MIN_ALPHA).clamp_min(1).log()).sqrt().clamp_max(EXTENT)
        return (extent[:, None] * torch.stack([xx, yy], dim=1).sqrt()).ceil().clamp_max(MAX_RADIUS)
    return longer_radii(splats.projection.covariances, SMALLEST_SPREAD)[:, None].expand(-1, 2)


def _check(given: SimpleNamespace) -> None:
    """Raise ValueError for what the renderer does not support."""
    if given.means.ndim != 2:
        _refuse("means", f"must have shape (N, 3), a single scene, got {tuple(given.means.shape)}")
    if given.render_mode not in MODES:
        _refuse("render_mode", f"must be one of {', '.join(MODES)}, got {given.render_mode!r}")
    if "RGB" in given.render_mode and given.colors.shape[-1] != 3:
        _refuse("colors", f"must have three channels, got shape {tuple(given.colors.shape)}")
    if torch.is_grad_enabled() and given.viewmats.requires_grad:
        _refuse("viewmats", "requires a gradient, as poses that are optimized do: switch that off (pose_opt)")


def _refuse(name: str, problem: str) -> None:
    raise ValueError(f"{name} of the stand-in for gsplat.rasterization, which runs without CUDA: {problem}.")


def _describe(value: Any) -> str:
    return f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)


@contextmanager
def gsplat_functions() -> Iterator[None]:
    """Let gsplat's rasterization and density control run without CUDA, within a block.

    Replaced, in all modules of gsplat, are ``rasterization``, ``compute_relocation``, ``quat_scale_to_covar_preci`` and
    ``distributed.cli``, which runs its function once. Whatever else gsplat computes on a GPU, such as
    ``rasterization_2dgs``, raises RuntimeError with its name; what gsplat computes in torch is left as it is.

    Raises:
        ImportError: if gsplat is missing or too old.
    """
    with ExitStack() as undo:
        kernels = make_module("gsplat.csrc", __getattr__=Refusing("gsplat", ADVICE).__getattr__)
        for name, module in {"gsplat.csrc": kernels, "gsplat.cuda._backend": None}.items():
            undo.callback(_put_module, name, sys.modules.get(name))
            _put_module(name, module)
        gsplat = load_gsplat()
        rendering, relocation, distributed = (
            importlib.import_module(f"gsplat.{name}") for name in ("rendering", "relocation", "distributed")
        )
        original = rendering.rasterization
        stand_ins: dict[Callable[..., Any], Callable[..., Any]] = {
            original: make_rasterization(original, per_axis=version_numbers(gsplat.__version__) >= [1, 5]),
            rendering.rasterization_2dgs: Refusing("gsplat.rasterization_2dgs", ADVICE),
            relocation.compute_relocation: compute_relocation,
            gsplat.quat_scale_to_covar_preci: quat_scale_to_covar_preci,
            distributed.cli: _run_once,
        }
        for name, module in list(sys.modules.items()):
            if name.partition(".")[0] == "gsplat":
                for attribute, value in list(vars(module).items()):
                    if inspect.isfunction(value) and value in stand_ins:
                        undo.enter_context(patch.object(module, attribute, stand_ins[value]))
        yield


def _put_module(name: str, module: ModuleType | None) -> None:
    """Put a module into ``sys.modules``, where gsplat looks for its compiled code; None removes what is there."""
    if module is None:
        sys.modules.pop(name, None)
    else:
        sys.modules[name] = module


def _run_once(fn: Callable[..., Any], args: Any, verbose: bool = False) -> bool:
    """Run what ``gsplat.distributed.cli`` runs on every GPU, as on a machine with one."""
    fn(0, 0, 1, args)
    return True


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances and their inverses, None for what was not asked for: (N, 3, 3), or if ``triu`` (N, 6).

    The six are xx, xy, xz, yy, yz, zz. Quaternions (N, 4) are wxyz, scales (N, 3) standard deviations.

    Example:
        >>> import torch
        >>> quat_scale_to_covar_preci(torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[1.0, 2, 3]]), triu=True)[0]
        tensor([[1., 0., 0., 4., 0., 9.]])
    """
    axes = rotation_matrices(quats)

    def product(lengths: Tensor) -> Tensor:
        with torch.autocast(lengths.device.type, enabled=False):
            matrix = (axes * lengths[:, None]) @ (axes * lengths[:, None]).mT
        return matrix.flatten(1)[:, [0, 1, 2, 4, 5, 8]] if triu else matrix

    return product(scales) if compute_covar else None, product(1 / scales) if compute_preci else None
