"""What the stability study pushes to an extreme, what it compares with, and how each case may end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier, expected_opacity, pixel_moments
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.studies.stability.quantities import (
    PARAMETERS,
    RATE,
    Quantities,
    StressScene,
    base_scene,
    camera_of,
    reference_quantities,
    scene_quantities,
    stack,
)

__all__ = ["Case", "Probe", "all_cases", "decades", "of_scene", "single"]


class Probe(NamedTuple):
    """A comparison: a computation as users run it, and its reference result."""

    measured: Callable[[], Quantities]
    reference: Callable[[], Quantities]


@dataclass(frozen=True)
class Case:
    """One way of pushing the package to an extreme.

    Args:
        family: heading of the table.
        name: what is extreme.
        probe: returns the comparison at a magnitude.
        magnitudes: from harmless to extreme, increasing, positive; a single one for a case without a scale.
        until: the largest magnitude at which all quantities must be right.
        beyond: what is allowed above it: an error that names the mistake; a documented limit, finite but less exact; or
            an infinity where the dtype has no larger number.
        note: the documented limit, or what refuses.
        renders: whether it uses an engine of the renderer; if not, it is judged once for all engines.
    """

    family: str
    name: str
    probe: Callable[[float], Probe]
    magnitudes: tuple[float, ...] = (1.0,)
    until: float = math.inf
    beyond: Literal["refused", "limit", "overflow"] = "limit"
    note: str = ""
    renders: bool = True


def single(family: str, name: str, probe: Callable[[], Probe], *, refused: str = "", renders: bool = True) -> Case:
    """Return a case without a scale, which must be right, or may be refused if ``refused`` names by what."""
    # The only magnitude is 1: with 0 it lies beyond what must be right.
    until = 0.0 if refused else math.inf
    return Case(family, name, lambda _: probe(), until=until, beyond="refused", note=refused, renders=renders)


def decades(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Return the powers of ten from 10^first to 10^last.

    Example:
        >>> decades(-1, 1)
        (0.1, 1.0, 10.0)
    """
    return tuple(float(f"1e{k}") for k in range(first, last + 1, step))


def of_scene(
    scene: StressScene, *, dtype: torch.dtype = torch.float32, independent: bool = True, rate: float = RATE
) -> Probe:
    """Compare everything computed from a scene with float64, at inputs that both precisions represent exactly.

    The scene, all but its pose, is first rounded to ``dtype``. If ``independent``, image, alpha and gradients are
    compared with the independent renderer, else with the same one in float64. ``rate`` is that of dropout, in the draw,
    the moments and the score.
    """
    scene = scene.rounded(dtype)
    return Probe(
        lambda: scene_quantities(scene, dtype, rate=rate),
        lambda: (
            reference_quantities(scene, rate=rate) if independent else scene_quantities(scene, torch.float64, rate=rate)
        ),
    )


@cache
def all_cases() -> tuple[Case, ...]:
    """Return all cases: shape, place and camera; opacities, masks, colors and precision."""
    return (*_geometry_cases(), *_blend_cases())


_STRAIGHT = Camera(torch.eye(4, dtype=torch.float64), 40.0, 38.0, 15.0, 12.7, 32, 24)  # looks along world z
_SHAPE, _PLACE, _CAMERA = "shape and size", "place", "camera and image"
_RATIOS = (2.0, *decades(1, 8))
_FOCALS = (1.0, 10.0, *decades(2, 6))
_SIZES = ((1, 1), (1, 64), (64, 1), (4096, 4), (4, 4096))


def _geometry_cases() -> list[Case]:
    """Return the cases; magnitudes are axis ratios, factors, distances, pixels or focal lengths, as the names say."""
    return [
        Case(_SHAPE, "needles, axis ratio, thin axes shrink", lambda x: _axes(0.3, 0.3 / x, 0.3 / x), _RATIOS),
        Case(_SHAPE, "pancakes, axis ratio, thin axis shrinks", lambda x: _axes(0.3, 0.3, 0.3 / x), _RATIOS),
        Case(
            _SHAPE, "needles, axis ratio, long axis grows",
            # Against the renderer itself in float64: tests in decimal arithmetic find the other reference inexact here.
            lambda x: _axes(0.02 * x, 0.02, 0.02, independent=False), _RATIOS,
        ),
        Case(_SHAPE, "pancakes, axis ratio, long axes grow", lambda x: _axes(0.02 * x, 0.02 * x, 0.02), _RATIOS),
        Case(_SHAPE, "scales divided by", lambda x: _scaled(1 / x), decades(0, 12)),
        Case(_SHAPE, "scales multiplied by", _scaled, decades(0, 6)),
        Case(
            _SHAPE, "scales multiplied by, beyond any scene", _scaled, decades(7, 21, 2), until=1e9,
            note="gradients of what is flat over the whole image; refused where squares overflow",
        ),
        single(_SHAPE, "scales of 0", partial(_scaled, 0.0)),
        Case(_SHAPE, "norm of the quaternions", _quaternions, decades(0, 36, 6)),
        Case(_SHAPE, "quaternions divided by", lambda x: _quaternions(1 / x), decades(0, 36, 6)),
        single(_SHAPE, "quaternions of 0: no rotation", _no_rotation),
        Case(_PLACE, "in front of the near plane by 1 / x of it", lambda x: _at_depth(0.2 + 0.2 / x), decades(0, 6)),
        Case(_PLACE, "behind the near plane by 1 / x of it", lambda x: _at_depth(0.2 - 0.2 / x), decades(0, 6)),
        Case(_PLACE, "behind the camera by", lambda x: _at_depth(-x), decades(-6, 6, 3)),
        single(_PLACE, "on the border of the image", _on_border),
        Case(_PLACE, "beside the image, pixels, as wide as that", _beside, decades(0, 6)),
        Case(_PLACE, "beside the image, pixels, ordinary width", lambda x: _beside(x, sigma=3.0), decades(0, 6)),
        Case(_PLACE, "depth and size multiplied by", _far, decades(0, 12)),
        Case(
            _PLACE, "world offset, scene sizes", _offset, decades(0, 8), until=1e3,
            note="float32 has 7 digits: recenter the scene; refused from a quarter of a pixel on",
        ),
        Case(_CAMERA, "focal length, scene shrinks with the field of view", _telephoto, _FOCALS),
        Case(_CAMERA, "focal length, camera backs away", _backs_away, _FOCALS),
        *(single(_CAMERA, f"{width}x{height} pixels", partial(_sized, width, height)) for width, height in _SIZES),
    ]  # fmt: skip


def _axes(a: float, b: float, c: float, *, independent: bool = True) -> Probe:
    """Give all Gaussians the same axis lengths; their orientations are random."""
    axes = torch.tensor([[a, b, c]], dtype=torch.float64)
    return of_scene(replace(base_scene(), scales=axes.expand(24, 3)), independent=independent)


def _scaled(factor: float) -> Probe:
    scene = base_scene()
    return of_scene(replace(scene, scales=scene.scales * factor))


def _quaternions(norm: float) -> Probe:
    scene = base_scene()
    return of_scene(replace(scene, quaternions=scene.quaternions / scene.quaternions.norm(dim=1, keepdim=True) * norm))


def _no_rotation() -> Probe:
    """Compare zero quaternions with the identity; their gradient is defined as 0."""
    scene = base_scene().rounded()
    zero = torch.zeros_like(scene.quaternions)
    identity = replace(scene, quaternions=zero + torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))
    return Probe(
        lambda: scene_quantities(replace(scene, quaternions=zero), torch.float32),
        lambda: {**reference_quantities(identity), "d quaternions": zero},
    )


def _replaced(point: Tensor, scale: float, scene: StressScene) -> Probe:
    """Move the first Gaussian of a scene to a point in camera coordinates and make it isotropic, of a given scale."""
    pose = scene.camera.world_to_camera
    means, scales = scene.means.clone(), scene.scales.clone()
    means[0] = pose[:3, :3].T @ (point - pose[:3, 3])
    scales[0] = scale
    return of_scene(replace(scene, means=means, scales=scales))


def _at_depth(depth: float) -> Probe:
    """Put a Gaussian near the optical axis; the camera looks along world z, so that no rotation rounds its depth."""
    scene = base_scene(camera=_STRAIGHT)
    ahead = scene.means + torch.tensor([0.0, 0, 3], dtype=torch.float64)
    return _replaced(torch.tensor([0.01, -0.02, depth], dtype=torch.float64), 0.02, replace(scene, means=ahead))


def _on_border() -> Probe:
    """Put Gaussians on the four edges and the four corners of the image."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 32.0, 32.0, 16.0, 12.0, 32, 24)
    pixels = [(0, 0), (32, 0), (0, 24), (32, 24), (16, 0), (16, 24), (0, 12), (32, 12)]
    # Different depths, in steps that float32 represents exactly: their order is not what this case is about.
    depths = 2.0 + 0.125 * torch.arange(8, dtype=torch.float64)
    slopes = (torch.tensor(pixels, dtype=torch.float64) - torch.tensor([16.0, 12.0])) / 32.0
    means = torch.cat([slopes * depths[:, None], depths[:, None]], dim=1)
    return of_scene(replace(base_scene(8, camera=camera), means=means))


def _beside(pixels: float, sigma: float | None = None) -> Probe:
    """Put a Gaussian outside the image, by default so wide that it still reaches in."""
    camera = camera_of()
    width = pixels if sigma is None else sigma
    # So many pixels to the right of the border, at depth 3.
    slope = (pixels + camera.width - camera.cx) / camera.fx
    return _replaced(3.0 * torch.tensor([slope, 0.05, 1.0]).double(), 3.0 * width / camera.fx, base_scene())


def _far(factor: float) -> Probe:
    """Scale the scene and its distance: the same picture, at large depths."""
    scene = base_scene()
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] *= factor
    camera = replace(scene.camera, world_to_camera=pose)
    return of_scene(replace(scene, means=scene.means * factor, scales=scene.scales * factor, camera=camera))


def _offset(offset: float) -> Probe:
    """Shift scene and camera in the world; the reference stays unrounded, because float32's rounding is the subject."""
    scene = base_scene().rounded()
    # Along no axis, so that all three coordinates are rounded.
    shift = offset * torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ shift
    moved = replace(scene, means=scene.means + shift, camera=replace(scene.camera, world_to_camera=pose))
    return Probe(lambda: scene_quantities(moved, torch.float32), lambda: reference_quantities(moved))


def _telephoto(focal: float) -> Probe:
    """Shrink the scene across the optical axis as the focal length grows, so that it fills the image."""
    scene = base_scene(camera=replace(_STRAIGHT, fx=focal, fy=focal))
    # 40 is the focal length of the base scene, which fills the image.
    across = torch.tensor([40.0 / focal, 40.0 / focal, 1.0], dtype=torch.float64)
    means = scene.means * across + torch.tensor([0.0, 0, 3], dtype=torch.float64)
    return of_scene(replace(scene, means=means, scales=scene.scales * min(40.0 / focal, 4.0)))


def _backs_away(focal: float) -> Probe:
    """Move the camera away as the focal length grows."""
    distance = math.ceil(3.0 * max(focal / 40.0, 0.5))
    return of_scene(base_scene(camera=camera_of(focal=focal, distance=distance)))


def _sized(width: int, height: int) -> Probe:
    return of_scene(base_scene(camera=camera_of(width, height, focal=40.0 * max(1.0, max(width, height) / 32))))


_OPACITY, _BLEND, _RANDOM, _COLOR, _DTYPE = "opacity", "blending", "dropout and noise", "colors", "precision"
_OPACITIES = {"0": 0.0, "1e-8": 1e-8, "1/255 + 1e-6": 1 / 255 + 1e-6, "1 - 1e-7": 1 - 1e-7, "1": 1.0}
_LOGITS = (1.0, 10.0, 20.0, 50.0, 100.0)
_STACKS = (0.01, 0.5, 0.95)
_RATES = {"0": 0.0, "1e-6": 1e-6, "0.999": 0.999, "1 - 1e-7": 1 - 1e-7}
_SIGMAS = (1e-6, 1e-3, 0.05, 0.8, 1.0, 10.0)
_HDR = {"white to HDR background": False, "white to HDR colors and background": True}
_SQUARES = "variances are squares, which overflow float32: the score says NOT_FINITE"


def _blend_cases() -> list[Case]:
    """Return the cases; magnitudes are logits, counts of Gaussians or renders, inverse gaps, sigmas or colors."""
    return [
        *(single(_OPACITY, f"opacities {name}", partial(_opacities, x)) for name, x in _OPACITIES.items()),
        Case(
            _OPACITY, "opacity logits", _logits, _LOGITS, until=10.0,
            note="the gradient, o (1 - o), loses its digits and is 0 from 17 on: 1 is the next float32", renders=False,
        ),
        Case(
            _OPACITY, "opacity logits, negative", lambda x: _logits(-x), _LOGITS, until=50.0,
            note="below 1e-38 there is no float32", renders=False,
        ),
        *(Case(_BLEND, f"Gaussians on one pixel, opacity {o}", partial(_stacked, o), decades(0, 4)) for o in _STACKS),
        Case(
            _BLEND, "Gaussians on one pixel, opacity 1", partial(_stacked, 1.0), decades(0, 3), until=1.0,
            note="two alphas of 0.99 leave 1e-4 of the light, just where a pixel ends: rounding decides on the second",
        ),
        single(_BLEND, "equal depths", _one_plane),
        Case(_BLEND, "copies of one Gaussian, turned camera", _copies, (2.0, 7.0, 33.0, 300.0)),
        Case(_BLEND, "depths that differ by 1 / x", lambda x: of_scene(stack(24, 0.5, spacing=1 / x)), decades(0, 7)),
        single(_BLEND, "no Gaussian", _nothing),
        single(_RANDOM, "all dropped", lambda: _masked(torch.zeros(24, dtype=torch.bool))),
        single(_RANDOM, "one left", lambda: _masked(torch.arange(24) == 5)),
        single(_RANDOM, "none dropped", lambda: _masked(torch.ones(24, dtype=torch.bool))),
        *(
            single(_RANDOM, f"drop rate {name}", partial(of_scene, base_scene(), independent=False, rate=x))
            for name, x in _RATES.items()
        ),
        Case(_RANDOM, "sigma of the opacity noise", _noise, _SIGMAS),
        single(_RANDOM, "opacity noise of sigma 0", partial(_noise, 0.0)),
        Case(_RANDOM, "renders K of a score", _renders, (2.0, 100.0, 10_000.0), renders=False),
        single(_RANDOM, "K = 1", partial(_renders, 1.0), refused="the variance of one render", renders=False),
        single(_RANDOM, "no visible pixel: no score, but a reason", partial(_opacities, 0.01)),
        single(_COLOR, "black background", partial(_colored, False, 0.0)),
        *(
            Case(_COLOR, name, partial(_colored, hdr), decades(0, 30, 3), until=1e18, beyond="overflow", note=_SQUARES)
            for name, hdr in _HDR.items()
        ),
        single(_DTYPE, "float16 inputs", lambda: of_scene(base_scene(), dtype=torch.float16)),
        single(_DTYPE, "bfloat16 inputs", lambda: of_scene(base_scene(), dtype=torch.bfloat16)),
        single(_DTYPE, "moments of lists in float16", _short_lists, refused="its checks", renders=False),
        single(_DTYPE, "torch.autocast to bfloat16", _autocast),
    ]  # fmt: skip


def _opacities(value: float) -> Probe:
    scene = base_scene()
    return of_scene(replace(scene, opacities=torch.full_like(scene.opacities, value)))


def _logits(value: float) -> Probe:
    """Compare opacities and their gradient with closed forms, because even float64 autograd rounds the latter to 0."""

    def measured() -> Quantities:
        points, logits = torch.zeros(1, 3), torch.tensor([value], requires_grad=True)
        model = Gaussians.from_points(points, points, torch.ones(1), sh_degree=0)
        opacities = replace(model, opacity_logits=logits).opacities
        (gradient,) = torch.autograd.grad(opacities.sum(), logits)
        return {"alpha": opacities.detach(), "d opacities": gradient}

    tail = math.exp(-abs(value))
    opacity = (1.0 if value >= 0 else tail) / (1.0 + tail)
    exact = {"alpha": opacity, "d opacities": tail / (1.0 + tail) ** 2}
    return Probe(measured, lambda: {name: torch.tensor([x], dtype=torch.float64) for name, x in exact.items()})


def _stacked(opacity: float, count: float) -> Probe:
    return of_scene(stack(int(count), opacity))


def _one_plane() -> Probe:
    """Put all Gaussians at one depth: they must be rendered in storage order."""
    scene = base_scene(camera=_STRAIGHT)
    return of_scene(replace(scene, means=torch.cat([scene.means[:, :2], torch.full((24, 1), 3.0).double()], dim=1)))


def _copies(count: float) -> Probe:
    """Render copies of one Gaussian in different colors: rounding must not change the order of equal depths."""
    n = int(count)
    scene = base_scene(n)
    # All but the colors, which reveal the order of equal depths.
    same = {name: getattr(scene, name)[:1].expand(n, -1) for name in ("means", "quaternions", "scales")}
    return of_scene(replace(scene, **same, opacities=torch.full((n,), 0.3, dtype=torch.float64)))


def _nothing() -> Probe:
    """Compare an empty model with its background."""
    scene = base_scene()
    empty = replace(scene, **{name: getattr(scene, name)[:0] for name in PARAMETERS})
    image = scene.background.float().double()[:, None, None].expand(3, 24, 32)
    known = dict.fromkeys(("image", "mean", "dropout", "noise"), image)
    known |= {"alpha": torch.zeros_like(image[0]), "variance": torch.zeros_like(image)}
    known["CA"] = torch.tensor([math.nan], dtype=torch.float64)
    return Probe(lambda: {k: v for k, v in scene_quantities(empty, torch.float32).items() if k in known}, lambda: known)


def _masked(keep: Tensor) -> Probe:
    scene = base_scene().rounded()
    left = replace(scene, opacities=scene.opacities * keep)
    return Probe(
        lambda: {"dropout": scene_quantities(scene, torch.float32, keep=keep)["dropout"]},
        lambda: {"dropout": reference_quantities(left)["image"]},
    )


def _noise(sigma: float) -> Probe:
    """Set sigma of the draw, and of the clamped noise's moments and mean opacity for faint to opaque Gaussians."""
    scene = base_scene().rounded()
    # Over many decades near 0, and dense near 1, where the clamp cuts off up to half of the noise.
    grid = torch.cat([torch.logspace(-8, -1, 8), torch.linspace(0.2, 1.0, 9), 1 - torch.logspace(-7, -2, 6)])

    def compute(dtype: torch.dtype) -> Quantities:
        opacity = grid.to(dtype, copy=True).requires_grad_()
        multiplier = Multiplier.clamped_noise(opacity.detach(), sigma)
        mean = expected_opacity(opacity, sigma)
        result = {"noise": scene_quantities(scene, dtype, sigma=sigma)["noise"], "mean": mean.detach()}
        result["variance"] = torch.as_tensor(multiplier.variance)
        (result["d opacities"],) = torch.autograd.grad(mean.sum(), opacity)
        return result

    return Probe(lambda: compute(torch.float32), lambda: compute(torch.float64))


def _renders(count: float) -> Probe:
    """Score a bright wall of ten layers: the variance of K renders is small compared with their squares."""
    opacity = torch.linspace(0.3, 0.9, 10)

    def score(dtype: torch.dtype) -> Quantities:
        # A plain sum of squares would lose the variance in float32: the mean is 100, the standard deviation below 1.
        colors = 100.0 + torch.linspace(0, 1, 10, dtype=dtype)

        def render_fn(opacity: Tensor, view: None) -> tuple[Tensor, Tensor]:
            opacity = opacity.to(dtype)
            passed = torch.cumprod(1 - opacity, 0)
            weights = opacity * torch.cat([passed.new_ones(1), passed[:-1]])
            image = (weights * colors).sum() + passed[-1] * 100.0
            return image.expand(3, 2, 2), torch.ones_like(image).expand(2, 2)

        result = CAScore(render_fn, samples=int(count))(opacity, None)
        return {"CA": torch.tensor([result.value, result.std_error if count > 2 else 0.0], dtype=torch.float64)}

    return Probe(lambda: score(torch.float32), lambda: score(torch.float64))


def _colored(hdr: bool, background: float) -> Probe:
    """Set the background; for HDR colors, scale them by it."""
    scene = base_scene()
    colors = scene.colors * (background if hdr else 1.0)
    return of_scene(replace(scene, background=torch.full_like(scene.background, background), colors=colors))


def _short_lists() -> Probe:
    alphas, colors = torch.full((500,), 0.02), torch.linspace(0, 1, 500)[:, None]

    def moments(dtype: torch.dtype) -> Quantities:
        mean, variance = pixel_moments(alphas.to(dtype), colors.to(dtype), Multiplier.dropout(0.5))
        return {"mean": mean, "variance": variance}

    return Probe(lambda: moments(torch.float16), lambda: moments(torch.float64))


def _autocast() -> Probe:
    """Compute everything under autocast, as in a mixed-precision training step."""
    probe = of_scene(base_scene())

    def measured() -> Quantities:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return probe.measured()

    return Probe(measured, probe.reference)
