"""What is computed of a scene, against brute force and against the enumeration of all masks."""

import itertools
from dataclasses import replace

import pytest
import torch
from oracles import brute_force

from reference_trainer.studies.stability.quantities import (
    IMAGES,
    PARAMETERS,
    SCENE_QUANTITIES,
    base_scene,
    camera_of,
    independent_images,
    loss_weights,
    reference_quantities,
    scene_quantities,
    stack,
)
from reference_trainer.studies.stability.stability_study import relative_error


def over_background(scene, **changes):
    tensors = [changes.get(name, getattr(scene, name)) for name in PARAMETERS]
    image, alpha = brute_force(*tensors, scene.camera)
    return image + (1 - alpha) * scene.background[:, None, None], alpha


def test_the_references_equal_brute_force():
    scene = base_scene(8, camera=camera_of(12, 9, focal=15.0))
    leaves = {name: getattr(scene, name).clone().requires_grad_() for name in PARAMETERS}
    image, alpha = over_background(scene, **leaves)
    (torch.cat([image, alpha[None]]) * loss_weights(scene.camera)).sum().backward()
    expected = {"image": image, "alpha": alpha} | {f"d {name}": x.grad for name, x in leaves.items()}
    for quantities in (independent_images(scene), scene_quantities(scene, torch.float64)):
        assert {name: relative_error(quantities[name], expected[name]) for name in IMAGES} == pytest.approx(
            dict.fromkeys(IMAGES, 0.0), abs=1e-12
        )


def test_moments_and_score_are_those_of_all_masks():
    scene = base_scene(5, camera=camera_of(10, 8, focal=15.0))
    scene = replace(scene, opacities=torch.linspace(0.4, 0.8, 5).double())
    result = scene_quantities(scene, torch.float64, rate=0.3)
    mean = square = covered = 0.0
    for mask in itertools.product((0.0, 1.0), repeat=5):
        mask = torch.tensor(mask, dtype=torch.float64)
        chance = torch.prod(0.3 + 0.4 * mask)
        image, alpha = over_background(scene, opacities=scene.opacities * mask)
        mean, square, covered = mean + chance * image, square + chance * image**2, covered + chance * alpha
    variance = square - mean**2
    torch.testing.assert_close(result["mean"], mean, rtol=0, atol=1e-12)
    torch.testing.assert_close(result["variance"], variance, rtol=0, atol=1e-12)
    torch.testing.assert_close(result["CA"], variance.mean(0)[covered > 0.5].mean()[None], rtol=1e-9, atol=0)


def test_a_mask_leaves_out_what_it_says_and_float32_is_close():
    scene = base_scene(8, camera=camera_of(12, 9, focal=15.0)).to(torch.float32).to(torch.float64)
    keep = torch.arange(8) % 2 == 0
    single = scene_quantities(scene, torch.float32, keep=keep)
    double = scene_quantities(scene, torch.float64, keep=keep)
    torch.testing.assert_close(
        double["dropout"], over_background(scene, opacities=scene.opacities * keep)[0], rtol=0, atol=1e-12
    )
    assert set(single) == set(SCENE_QUANTITIES) == set(reference_quantities(scene))
    errors = {name: relative_error(single[name], double[name]) for name in SCENE_QUANTITIES}
    assert all(0 < error < 1e-5 for error in errors.values()), errors


def test_a_stack_lies_on_the_axis_one_behind_the_other():
    scene = stack(7, 0.5, spacing=0.25)
    assert torch.equal(scene.means[:, :2], torch.zeros(7, 2).double())
    assert scene.means[:, 2].tolist() == [2.0, 2.25, 2.5, 2.75, 3.0, 3.25, 3.5]
    assert (independent_images(scene)["alpha"] > 0.9).all()
