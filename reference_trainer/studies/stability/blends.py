"""Stability cases on opacity, depth order, masks, noise, colors and input precision."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier, expected_opacity, pixel_moments
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.studies.stability.case import Case, Probe, decades, of_scene, single
from reference_trainer.studies.stability.quantities import Quantities, reference_quantities, scene_quantities
from reference_trainer.studies.stability.scenes import PARAMETERS, base_scene, stack

__all__ = ["blend_cases"]

_OPACITY, _BLEND, _RANDOM, _COLOR, _DTYPE = "opacity", "blending", "dropout and noise", "colors", "precision"
_OPACITIES = {"0": 0.0, "1e-8": 1e-8, "1/255 + 1e-6": 1 / 255 + 1e-6, "1 - 1e-7": 1 - 1e-7, "1": 1.0}
_LOGITS = (1.0, 10.0, 20.0, 50.0, 100.0)
_STACKS = (0.01, 0.5, 0.95)
_RATES = {"0": 0.0, "1e-6": 1e-6, "0.999": 0.999, "1 - 1e-7": 1 - 1e-7}
_SIGMAS = (1e-6, 1e-3, 0.05, 0.8, 1.0, 10.0)
_HDR = {"white to HDR background": False, "white to HDR colors and background": True}
_SQUARES = "variances are squares, which overflow float32: the score says NOT_FINITE"


def blend_cases() -> list[Case]:
    """Return the cases; magnitudes are logits, counts of Gaussians or renders, inverse gaps, sigmas or colors."""
    return [
        *(single(_OPACITY, f"opacities {name}", partial(_opacities, x)) for name, x in _OPACITIES.items()),
        Case(
            _OPACITY, "opacity logits", _logits, _LOGITS, until=10.0,
            note="the gradient, o (1 - o), loses its digits and is 0 from 17 on: 1 is the next float32", draws=False,
        ),
        Case(
            _OPACITY, "opacity logits, negative", lambda x: _logits(-x), _LOGITS, until=50.0,
            note="below 1e-38 there is no float32", draws=False,
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
        Case(_RANDOM, "renders K of a score", _renders, (2.0, 100.0, 10_000.0), draws=False),
        single(_RANDOM, "K = 1", partial(_renders, 1.0), refused="the variance of one render", draws=False),
        single(_RANDOM, "no visible pixel: no score, but a reason", partial(_opacities, 0.01)),
        single(_COLOR, "black background", partial(_colored, False, 0.0)),
        *(
            Case(_COLOR, name, partial(_colored, hdr), decades(0, 30, 3), until=1e18, beyond="overflow", note=_SQUARES)
            for name, hdr in _HDR.items()
        ),
        single(_DTYPE, "float16 inputs", lambda: of_scene(base_scene(), dtype=torch.float16)),
        single(_DTYPE, "bfloat16 inputs", lambda: of_scene(base_scene(), dtype=torch.bfloat16)),
        single(_DTYPE, "moments of lists in float16", _short_lists, refused="its checks", draws=False),
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
    """Put all Gaussians at one depth: they must be drawn in storage order."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 38.0, 15.0, 12.7, 32, 24)
    scene = base_scene(camera=camera)
    return of_scene(replace(scene, means=torch.cat([scene.means[:, :2], torch.full((24, 1), 3.0).double()], dim=1)))


def _copies(count: float) -> Probe:
    """Draw copies of one Gaussian in different colors: rounding must not change the order of equal depths."""
    n = int(count)
    scene = base_scene(n)
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
    behind = torch.full_like(scene.background, background)
    return of_scene(replace(scene, background=behind, colors=scene.colors * (background if hdr else 1.0)))


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
