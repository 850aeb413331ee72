"""Cases of nan and infinity, in every input in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAScore, GaussianDropout, OpacityNoise
from ca_reg import functional as F
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import render
from reference_trainer.render.moments import render_moments
from reference_trainer.studies.stability.case import Case, Probe, single
from reference_trainer.studies.stability.quantities import (
    Quantities,
    reference_quantities,
    scene_quantities,
    splats_of,
)
from reference_trainer.studies.stability.scenes import PARAMETERS, base_scene

__all__ = ["input_cases"]

_RENDERER, _FUNCTIONS, _PASSED = "bad input: renderer", "bad input: functions", "bad input: passed on"
_BAD = {"nan": math.nan, "inf": math.inf}
_AT = 5  # the number of the Gaussian that is bad
_HALF = F.Multiplier.dropout(0.5)


def input_cases() -> list[Case]:
    """Return the cases: errors that name the input; of functions that may not look, the nan stays where it was."""
    return [*_renderer(), *_functions(), *_passed()]


def _renderer() -> Iterator[Case]:
    """Put one bad number into what is rendered."""
    for label, bad in _BAD.items():
        for name in (*PARAMETERS, "background"):
            yield single(_RENDERER, f"{label} in {name}", partial(_bad_tensor, name, bad), refused=name)
        for name in ("fx", "fy", "cx", "cy"):
            yield single(_RENDERER, f"{label} in camera.{name}", partial(_bad_camera, name, bad), refused="camera")
        yield single(_RENDERER, f"{label} in the pose", partial(_bad_pose, bad), refused="world_to_camera")
        yield single(_RENDERER, f"{label} in the harmonics", partial(_bad_harmonics, bad), refused="sh")
        moments = partial(_bad_background, bad)
        yield single(_RENDERER, f"{label} in a background of the moments", moments, refused="background")
        points = partial(_bad_points, bad)
        yield single(_RENDERER, f"{label} in points of a new model", points, refused="positions", draws=False)


def _functions() -> Iterator[Case]:
    """Put one bad number into what the functions and modules of `ca_reg` take."""
    alphas, colors = torch.full((6,), 0.3), torch.full((6, 3), 0.4)
    keep, noise = torch.ones(6, dtype=torch.bool), torch.linspace(-0.4, 0.4, 6)

    def score(bad: float) -> Tensor:
        result = CAScore(lambda opacity, view: (torch.ones(3, 2, 2), torch.ones(2, 2)))(_with(alphas, bad), None)
        return torch.tensor([result.value])

    calls: dict[str, Callable[[float], Tensor]] = {
        "GaussianDropout, opacity": lambda bad: GaussianDropout(0.2)(_with(alphas, bad), keep=keep),
        "OpacityNoise, opacity": lambda bad: OpacityNoise(0.2)(_with(alphas, bad), noise=noise),
        "pixel_moments, alphas": lambda bad: F.pixel_moments(_with(alphas, bad), colors, _HALF).mean,
        "pixel_moments, colors": lambda bad: F.pixel_moments(alphas, _with(colors, bad), _HALF).mean,
        "pixel_moments, background": lambda bad: (
            F.pixel_moments(alphas, colors, _HALF, background=torch.full((3,), bad)).mean
        ),
        "neutral_background, colors": lambda bad: F.neutral_background(alphas, _with(colors, bad), _HALF),
        "first_order_variance, colors": lambda bad: F.first_order_variance(alphas, _with(colors, bad), _HALF),
        "color_variance, weights": lambda bad: F.color_variance(_with(alphas, bad), colors).variance,
        "color_variance, colors": lambda bad: F.color_variance(alphas, _with(colors, bad)).variance,
        "Multiplier, mean": lambda bad: torch.tensor(F.Multiplier(bad, 1.0).mean),
        "Multiplier, variance": lambda bad: torch.as_tensor(F.Multiplier(1.0, _with(alphas, bad)).variance),
        "clamped_noise, opacity": lambda bad: torch.as_tensor(F.Multiplier.clamped_noise(_with(alphas, bad), 0.5).mean),
        "opacity_noise, sigma": lambda bad: F.opacity_noise(alphas, bad)[0],
        "gaussian_dropout, p": lambda bad: F.gaussian_dropout(alphas, bad)[0],
        "CAScore, opacity": score,
    }
    for name, call in calls.items():
        for label, bad in _BAD.items():
            probe = partial(_called, call, bad)
            yield single(_FUNCTIONS, f"{label}: {name}", probe, refused="its checks", draws=False)


def _passed() -> Iterator[Case]:
    """Check that functions that may not wait for a GPU hand on a nan, where it is and nowhere else."""
    opacity, image = torch.linspace(0.1, 0.6, 6), torch.linspace(0.2, 0.8, 6)
    keep, noise = torch.arange(6) != 2, torch.linspace(-0.4, 0.4, 6)
    calls: dict[str, tuple[Callable[[Tensor], Tensor], Tensor]] = {
        "apply_dropout": (lambda x: F.apply_dropout(x, keep), opacity),
        "apply_opacity_noise": (lambda x: F.apply_opacity_noise(x, noise), opacity),
        "scale_opacity": (lambda x: F.scale_opacity(x, 0.2), opacity),
        "expected_squared_error": (lambda x: F.expected_squared_error(x, image.to(x) / 9, image.to(x)), image),
        "expected_absolute_error": (lambda x: F.expected_absolute_error(x, image.to(x) / 9, image.to(x)), image),
    }
    for name, (call, x) in calls.items():
        yield single(_PASSED, f"nan: {name}", partial(_stays, call, x), draws=False)


def _with(x: Tensor, bad: float) -> Tensor:
    """Return a copy with one bad element."""
    x = x.clone()
    x.view(-1)[_AT - 1] = bad
    return x


def _called(call: Callable[[float], Tensor], bad: float) -> Probe:
    return Probe(lambda: {"image": call(bad)}, lambda: {"image": call(0.3).double()})


def _stays(call: Callable[[Tensor], Tensor], x: Tensor) -> Probe:
    """Compare with the clean result but for the one element."""
    return Probe(
        lambda: {"image": call(_with(x, math.nan))},
        lambda: {"image": _with(call(x.double()), math.nan)},
    )


def _bad_tensor(name: str, bad: float) -> Probe:
    scene = base_scene()
    tensor = getattr(scene, name).clone()
    tensor[_AT if name != "background" else 1] = bad
    return Probe(
        lambda: scene_quantities(scene.with_(**{name: tensor}), torch.float32), lambda: reference_quantities(scene)
    )


def _bad_camera(name: str, bad: float) -> Probe:
    scene = base_scene()
    return Probe(
        lambda: scene_quantities(scene.with_(camera=_camera(scene.camera, name, bad)), torch.float32),
        lambda: reference_quantities(scene),
    )


def _camera(camera: Camera, name: str, bad: float) -> Camera:
    """Return a camera with one bad number."""
    changes: dict[str, Any] = {name: bad}
    return replace(camera, **changes)


def _bad_pose(bad: float) -> Probe:
    scene = base_scene()

    def measured() -> Quantities:
        pose = scene.camera.world_to_camera.clone()
        pose[0, 3] = bad
        return scene_quantities(scene.with_(camera=replace(scene.camera, world_to_camera=pose)), torch.float32)

    return Probe(measured, lambda: reference_quantities(scene))


def _bad_harmonics(bad: float) -> Probe:
    scene = base_scene().to(torch.float32)
    sh = torch.zeros(24, 4, 3)
    broken = sh.clone()
    broken[_AT, 2, 1] = bad

    def image(sh: Tensor) -> Quantities:
        geometry = (scene.means, scene.quaternions, scene.scales, scene.opacities)
        return {"image": render(*geometry, scene.camera, sh=sh).image}

    return Probe(lambda: image(broken), lambda: image(sh))


def _bad_background(bad: float) -> Probe:
    splats = splats_of(base_scene().to(torch.float32))

    def variance(background: Tensor) -> Quantities:
        return {"variance": render_moments(splats, _HALF, background=background).variance}

    return Probe(lambda: variance(_with(torch.ones(3, 24, 32), bad)), lambda: variance(torch.ones(3, 24, 32)))


def _bad_points(bad: float) -> Probe:
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(1))

    def model(points: Tensor) -> Quantities:
        return {"image": Gaussians.from_points(points, points.clamp(0, 1), torch.ones(9), sh_degree=0).means}

    return Probe(lambda: model(_with(points, bad)), lambda: model(points))
