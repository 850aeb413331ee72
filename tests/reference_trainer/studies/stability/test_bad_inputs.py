"""One nan or infinity in every input: an error that names it; where nobody may look, a nan that stays in its place."""

import dataclasses
import math

import pytest
import torch

from ca_reg import CAScore, Draw, GaussianDropout, OpacityNoise
from ca_reg import functional as F
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import render
from reference_trainer.render.engine import using_engine
from reference_trainer.render.renderer import render_moments
from reference_trainer.studies.stability.quantities import PARAMETERS, base_scene, scene_quantities, splats_of

AT = 4  # the number of the element that is bad
HALF = F.Multiplier.dropout(0.5)
SCENE = base_scene()


def spoiled(x, bad):
    x = x.clone()
    x.view(-1)[min(AT, x.numel() - 1)] = bad
    return x


def rendered(**changes):
    return scene_quantities(dataclasses.replace(SCENE, **changes), torch.float32)


def with_camera(**changes):
    return rendered(camera=dataclasses.replace(SCENE.camera, **changes))


def with_harmonics(bad):
    scene = SCENE.to(torch.float32)
    geometry = (scene.means, scene.quaternions, scene.scales, scene.opacities)
    sh = torch.zeros(24, 4, 3)
    sh[5, 2, 1] = bad
    return render(*geometry, scene.camera, sh=sh)


def moments_over(bad):
    return render_moments(splats_of(SCENE.to(torch.float32)), HALF, background=spoiled(torch.ones(3, 24, 32), bad))


RENDERER = {
    **{name: lambda bad, name=name: rendered(**{name: spoiled(getattr(SCENE, name), bad)}) for name in PARAMETERS},
    "background": lambda bad: rendered(background=spoiled(SCENE.background, bad)),
    **{f"camera.{name}": lambda bad, name=name: with_camera(**{name: bad}) for name in ("fx", "fy", "cx", "cy")},
    "world_to_camera": lambda bad: with_camera(world_to_camera=spoiled(SCENE.camera.world_to_camera, bad)),
    "sh": with_harmonics,
    "sh of minus infinity": lambda bad: with_harmonics(-bad),
    "background of the moments": moments_over,
}


@pytest.mark.parametrize("engine", ["numba", "torch"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", RENDERER)
def test_the_renderer_names_the_input(name, bad, engine):
    word = name.replace("camera.", "").partition(" ")[0]
    with using_engine(engine), pytest.raises(ValueError, match=word):
        RENDERER[name](bad)


alphas, colors = torch.full((6,), 0.3), torch.full((6, 3), 0.4)
keep, noise = torch.ones(6, dtype=torch.bool), torch.linspace(-0.4, 0.4, 6)
points = torch.rand(9, 3, generator=torch.Generator().manual_seed(1))


def score(bad):
    return CAScore(lambda opacity, view: (torch.ones(3, 2, 2), torch.ones(2, 2)))(spoiled(alphas, bad), None)


FUNCTIONS = {
    "GaussianDropout, opacity": lambda bad: GaussianDropout(0.2)(spoiled(alphas, bad), drawn=Draw(keep=keep)),
    "OpacityNoise, opacity": lambda bad: OpacityNoise(0.2)(spoiled(alphas, bad), drawn=Draw(noise)),
    "pixel_moments, alphas": lambda bad: F.pixel_moments(spoiled(alphas, bad), colors, HALF),
    "pixel_moments, colors": lambda bad: F.pixel_moments(alphas, spoiled(colors, bad), HALF),
    "pixel_moments, background": lambda bad: F.pixel_moments(alphas, colors, HALF, background=torch.full((3,), bad)),
    "neutral_background, colors": lambda bad: F.neutral_background(alphas, spoiled(colors, bad), HALF),
    "first_order_variance, colors": lambda bad: F.first_order_variance(alphas, spoiled(colors, bad), HALF),
    "color_variance, weights": lambda bad: F.color_variance(spoiled(alphas, bad), colors),
    "color_variance, colors": lambda bad: F.color_variance(alphas, spoiled(colors, bad)),
    "Multiplier, mean": lambda bad: F.Multiplier(bad, 1.0),
    "Multiplier, variance": lambda bad: F.Multiplier(1.0, spoiled(alphas, bad)),
    "clamped_noise, opacity": lambda bad: F.Multiplier.clamped_noise(spoiled(alphas, bad), 0.5),
    "opacity_noise, sigma": lambda bad: F.opacity_noise(alphas, bad),
    "gaussian_dropout, p": lambda bad: F.gaussian_dropout(alphas, bad),
    "CAScore, opacity": score,
    "points of a new model": lambda bad: Gaussians.from_points(
        spoiled(points, bad), points, torch.ones(9), sh_degree=0
    ),
}


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse(name, bad):
    with pytest.raises((ValueError, TypeError), match=r"finite|nan|\[0, 1|infinit|must"):
        FUNCTIONS[name](bad)


opacity, image = torch.linspace(0.1, 0.6, 6), torch.linspace(0.2, 0.8, 6)
PASSED = {
    "apply_dropout": (lambda x: F.apply_dropout(x, torch.arange(6) != 2), opacity),
    "apply_opacity_noise": (lambda x: F.apply_opacity_noise(x, noise), opacity),
    "scale_opacity": (lambda x: F.scale_opacity(x, 0.2), opacity),
    "expected_squared_error": (lambda x: F.expected_squared_error(x, image / 9, image), image),
    "expected_absolute_error": (lambda x: F.expected_absolute_error(x, image / 9, image), image),
}


@pytest.mark.parametrize("name", PASSED)
def test_functions_that_may_not_wait_for_a_gpu_pass_a_nan_on(name):
    call, x = PASSED[name]
    torch.testing.assert_close(call(spoiled(x, math.nan)), spoiled(call(x), math.nan), rtol=0, atol=0, equal_nan=True)
