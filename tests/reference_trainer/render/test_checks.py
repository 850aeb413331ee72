"""What the renderer refuses: bad numbers by name, and worlds too far from their origin."""

import math
import re
from dataclasses import replace

import pytest
import torch
from oracles import random_scene
from stand_ins.card import counted_synchronizations

from reference_trainer.render import NotFiniteError, render

NAMES = ("means", "quaternions", "scales", "opacities", "colors")


def rendered(scene, **changes):
    tensors = dict(zip(NAMES, scene.tensors(), strict=True)) | {"camera": scene.camera} | changes
    return render(**tensors).image


@pytest.fixture
def scene(any_case):
    return random_scene(40, 24, 16, seed=2).to(any_case.dtype, any_case.device)


def seen(scene):
    """The number of a Gaussian that is in front of the camera."""
    depths = scene.means @ scene.camera.world_to_camera[2, :3] + scene.camera.world_to_camera[2, 3]
    return int((depths > 0.5).nonzero()[7])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", NAMES)
def test_a_bad_number_is_refused_by_name_and_place(scene, name, bad):
    tensor, at = getattr(scene, name).clone(), seen(scene)
    tensor.view(40, -1)[at, -1] = bad
    with pytest.raises(NotFiniteError, match=f"{name} .*finite.* 1 of 40 .*number {at}"):
        rendered(scene, **{name: tensor})


def test_a_nan_that_would_hide_its_gaussian_is_refused(scene):
    # A depth of nan is not in front of the camera, an opacity of nan not above the cut: both were left out in silence.
    for name in ("means", "opacities"):
        tensor = getattr(scene, name).clone()
        tensor[0] = math.nan
        with pytest.raises(NotFiniteError, match=f"{name} must be finite"):
            rendered(scene, **{name: tensor})


def test_harmonics_are_looked_at_as_far_as_they_are_used(scene):
    sh = torch.zeros(40, 16, 3).to(scene.means)
    sh[seen(scene), 9, 0] = math.nan
    inputs = dict(zip(NAMES[:4], scene.tensors()[:4], strict=True))
    render(**inputs, camera=scene.camera, sh=sh, sh_degree=2)
    with pytest.raises(NotFiniteError, match=r"\bsh .*finite"):
        render(**inputs, camera=scene.camera, sh=sh)


@pytest.mark.parametrize("name", ["fx", "fy"])
def test_a_bad_camera_is_told_from_bad_gaussians(scene, name):
    bad = 1e38 if scene.means.dtype == torch.float32 else 1e200
    with pytest.raises(NotFiniteError, match=f"from finite inputs: .*{name}={re.escape(f'{bad:.3g}')}"):
        rendered(scene, camera=replace(scene.camera, **{name: bad}))


def test_scales_whose_squares_overflow_are_refused(scene):
    huge = 1e21 if scene.means.dtype == torch.float32 else 1e160
    with pytest.raises(NotFiniteError, match=r"scales .*up to [0-9.]+e\+(2|15)"):
        rendered(scene, scales=huge * scene.scales)


def test_a_background_that_is_not_finite_is_refused(scene):
    with pytest.raises(NotFiniteError, match=r"background .*finite, .*nan"):
        rendered(scene, background=torch.tensor([0.0, math.nan, 1.0], device=scene.means.device))


def test_a_new_background_takes_no_further_wait(card):
    waits, scene = [], random_scene(40, 24, 16, seed=2).to(torch.float32, card)
    rendered(scene)
    for background in (None, torch.rand(3, device=card), torch.rand(3, device=card)):
        with counted_synchronizations() as found:
            rendered(scene, background=background)
        waits.append(found.total())
    assert waits[2] == waits[1] == waits[0]


def test_a_background_that_is_changed_is_looked_at_again(scene):
    background = torch.rand(3, device=scene.means.device)
    rendered(scene, background=background)
    background[1] = math.nan
    for opacities in (scene.opacities, torch.zeros_like(scene.opacities)):  # also where nothing is in view
        with pytest.raises(NotFiniteError, match=r"background .*finite"):
            rendered(scene, background=background, opacities=opacities)


def test_a_sum_that_overflows_over_finite_numbers_is_no_mistake(scene):
    bright = torch.full_like(scene.colors, 0.9 * torch.finfo(scene.colors.dtype).max)
    picture = rendered(scene, colors=torch.where(torch.arange(40, device=bright.device)[:, None] < 36, bright, 0.0))
    assert picture.shape == (3, 16, 24)


def test_geographic_coordinates_are_refused_in_float32_alone(case):
    scene = random_scene(40, 24, 16, seed=2)
    shift = torch.tensor([4.5e6, 5.3e5, 100.0], dtype=torch.float64)
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ shift
    moved = scene._replace(means=scene.means + shift, camera=replace(scene.camera, world_to_camera=pose))
    if case.dtype == torch.float32:
        with pytest.raises(ValueError, match=r"4.5e\+06 .*origin.*subtract"):
            rendered(moved.to(case.dtype))
    else:
        torch.testing.assert_close(rendered(moved), rendered(scene), rtol=0, atol=1e-6)


def test_an_empty_view_needs_no_numbers(scene):
    assert torch.equal(rendered(scene, opacities=torch.zeros_like(scene.opacities)), torch.zeros_like(rendered(scene)))
