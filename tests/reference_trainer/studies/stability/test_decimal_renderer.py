"""Decimal arithmetic against brute force with autograd in float64, where float64 is not in doubt."""

from dataclasses import replace

import pytest
import torch
from decimal_renderer import exact_images
from oracles import brute_force

from reference_trainer.render.engine import engines_on, using_engine
from reference_trainer.studies.stability.quantities import (
    IMAGES,
    PARAMETERS,
    base_scene,
    camera_of,
    independent_images,
    loss_weights,
    scene_quantities,
)
from reference_trainer.studies.stability.stability_study import GRADIENT_TOLERANCE, VALUE_TOLERANCE, relative_error


def test_image_and_gradients_equal_brute_force():
    scene = base_scene(3, camera=camera_of(4, 3, focal=5.0))
    exact = exact_images(scene)
    assert set(exact) == set(IMAGES)
    leaves = [getattr(scene, name).clone().requires_grad_() for name in PARAMETERS]
    sums, alpha = brute_force(*leaves, scene.camera)
    image = sums + (1 - alpha) * scene.background[:, None, None]
    (torch.cat([image, alpha[None]]) * loss_weights(scene.camera)).sum().backward()
    torch.testing.assert_close(exact["image"], image.detach(), rtol=0, atol=1e-14)
    torch.testing.assert_close(exact["alpha"], alpha.detach(), rtol=0, atol=1e-14)
    for name, x in zip(PARAMETERS, leaves, strict=True):
        torch.testing.assert_close(exact[f"d {name}"], x.grad, rtol=1e-11, atol=1e-12)


def test_splats_behind_the_near_plane_and_below_the_cut_are_left_out():
    scene = base_scene(3, camera=camera_of(3, 2, focal=5.0))
    means, opacities = scene.means.clone(), scene.opacities.clone()
    means[0] -= 4 * scene.camera.forward
    opacities[1] = 0.003
    scene = replace(scene, means=means, opacities=opacities)
    _, alpha = brute_force(*(getattr(scene, name) for name in PARAMETERS), scene.camera)
    exact = exact_images(scene)
    torch.testing.assert_close(exact["alpha"], alpha, rtol=0, atol=1e-14)
    assert alpha.max() > 0.1
    assert torch.equal(exact["d colors"][:2], torch.zeros(2, 3).double())


@pytest.mark.parametrize("opacities", [(0.995, 0.1), (0.98, 0.98, 0.98)])
def test_opacities_that_are_clamped_or_end_a_pixel_are_refused(opacities):
    scene = replace(base_scene(len(opacities)), opacities=torch.tensor(opacities).double())
    with pytest.raises(ValueError, match="neither clamp"):
        exact_images(scene)


def needles(ratio):
    """Three long needles in 16 pixels, with numbers that float32 holds."""
    scene = base_scene(3, camera=camera_of(4, 4, focal=5.0))
    scales = torch.tensor([[0.02 * ratio, 0.02, 0.02]], dtype=torch.float64).expand(3, 3)
    return replace(scene, scales=scales).rounded()


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [2.0, 1e2, 1e4, 1e6, 1e8])
def test_long_needles_are_rendered_right_where_float64_itself_is_in_doubt(ratio):
    """The stability study compares needles with the renderer in float64: the reference of the other cases ends here."""
    scene = needles(ratio)
    exact = exact_images(scene)
    rendered = {"float64": scene_quantities(scene, torch.float64)}
    if ratio <= 1e6:  # then its covariances of 1e16 and 0.3 leave float64 nothing to invert
        rendered["reference"] = independent_images(scene)
    for engine in engines_on(torch.device("cpu")):
        with using_engine(engine):
            rendered[engine] = scene_quantities(scene, torch.float32)
    for by, quantities in rendered.items():
        for name in IMAGES:
            tolerance = GRADIENT_TOLERANCE if name.startswith("d ") else VALUE_TOLERANCE
            assert relative_error(quantities[name], exact[name]) <= tolerance, (by, name)
