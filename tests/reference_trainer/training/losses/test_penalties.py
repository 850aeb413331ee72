"""Penalties on opacities, scales and alpha against their formulas."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.penalties import (
    Alpha,
    Flat,
    Opacity,
    RayExtent,
    Scale,
    dark_background,
    ray_extents,
)


def literal_background(image, threshold):
    """A pixel is background if it and the 49 above it, as far as there are any, are dark."""
    dark = image.max(0) < threshold
    rows, columns = dark.shape
    return np.array([[dark[max(0, i - 49) : i + 1, j].all() for j in range(columns)] for i in range(rows)], float)


def test_the_mean_of_alpha_where_the_photograph_has_none(take_step):
    step = take_step()
    expected = (step.rendering.alpha.numpy() * (1 - step.view.alpha.numpy())).mean()
    assert Alpha(0.6)(step).item() == pytest.approx(0.6 * expected, rel=1e-12)


@pytest.mark.parametrize("rows", [3, 50, 120])
def test_the_dark_background_is_the_rule_of_the_source(rows):
    g = torch.Generator().manual_seed(rows)
    image = torch.rand(3, rows, 40, generator=g) ** 0.05 * (torch.rand(3, rows, 40, generator=g) < 0.004)
    expected = literal_background(image.numpy(), 0.5)
    assert 0 < expected.mean() < 1
    np.testing.assert_array_equal(dark_background(image, 0.5).numpy(), expected)


def test_a_dark_background_counts_instead_of_alpha(take_step):
    step = take_step()
    image = step.view.image.clone()
    image[:, 4:] *= (torch.arange(25) < 12).double()
    step.view = dataclasses.replace(step.view, image=image, alpha=None)
    image = image * (torch.arange(25) < 12).double()
    step.view = dataclasses.replace(step.view, image=image)
    expected = (step.rendering.alpha.numpy() * literal_background(image.numpy(), 0.1)).mean()
    assert expected > 0
    assert Alpha(1.0, dark=0.1)(step).item() == pytest.approx(expected, rel=1e-12)


def test_a_dark_background_is_dark_over_every_color_of_a_step(take_step):
    """With random_background what is transparent was as bright as the color of the first step."""
    step = take_step()
    alpha = (torch.arange(25) < 12).double().expand(17, 25)
    step.view = dataclasses.replace(step.view, image=step.view.image * alpha, alpha=alpha)
    expected = Alpha(1.0, dark=0.1)(step)
    assert expected > 0
    black, step.background = step.background, torch.full_like(step.background, 0.7)
    step.view = step.view.over(step.background, black)
    assert torch.equal(Alpha(1.0, dark=0.1)(step), expected)


def test_gradients_of_alpha(assert_gradients_of_differences):
    assert_gradients_of_differences(Alpha(0.7), "means", "opacity_logits", "log_scales")


def test_arguments_and_photographs(three_views, tiny_scene):
    for text, message in (("alpha(-1.0)", "weight must"), ("alpha(dark=0.0)", r"dark must be in \(0, 1\]")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
    opaque = dataclasses.replace(three_views[1], alpha=None)
    with pytest.raises(ValueError, match=r"\['b'\] .*no alpha.*dark"):
        Alpha().begin(dataclasses.replace(tiny_scene, train=(three_views[0], opaque)))
    Alpha(dark=0.1).begin(dataclasses.replace(tiny_scene, train=(opaque,)))


def test_without_an_alpha_channel_all_is_foreground_if_the_term_is_optional(three_views, tiny_scene, take_step):
    opaque = dataclasses.replace(three_views[1], alpha=None)
    for train, acts in (((opaque,), False), ((three_views[0], opaque), True)):
        term = Alpha(optional=True)
        term.begin(dataclasses.replace(tiny_scene, train=train))
        assert term.acts(0) is acts
    step = take_step()
    step.view = opaque
    assert term(step).item() == 0


@pytest.mark.parametrize("limit", [1.0, 4.0, 1e6])
def test_it_is_the_mean_excess_of_the_ratio(six, take_step, limit):
    scales = np.exp(six.log_scales.numpy())
    expected = 0.3 * np.mean([max(max(row) / min(row) - limit, 0) for row in scales])
    assert Flat(0.3, limit)(take_step()).item() == pytest.approx(expected, rel=1e-12)


def test_gradients_of_flat(assert_gradients_of_differences):
    assert_gradients_of_differences(Flat(0.3, 2.0), "log_scales")


def test_arguments_of_flat():
    for text, message in (("flat(-1.0)", "weight must"), ("flat(1.0, 0.5)", "limit must be finite and at least 1")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)


@pytest.mark.parametrize("limit", [0.0, 0.5, 1e6])
def test_it_is_the_mean_squared_excess_of_the_longest_axis(six, take_step, limit):
    scales = np.exp(six.log_scales.numpy())
    expected = 0.3 * np.mean([max(max(row) - limit, 0) ** 2 for row in scales])
    assert Scale(0.3, limit)(take_step()).item() == pytest.approx(expected, rel=1e-12)


def test_gradients_of_scale(assert_gradients_of_differences):
    assert_gradients_of_differences(Scale(0.3, 0.5), "log_scales")


def test_arguments_of_scale():
    for text, message in (("scale(-1.0)", "weight must"), ("scale(1.0, -0.5)", "limit must be finite and at least 0")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)


@pytest.mark.parametrize("limit", [1e-9, 0.1, 1e6])
def test_it_is_the_excess_of_the_deviation_along_the_ray_by_the_distance(six, take_step, limit):
    """By the covariance, u' C u, with SciPy's rotations; one of the six stands behind the camera."""
    means = six.means.clone()
    means[2, 2] = -3.0
    step, scales = take_step(means=means), np.exp(six.log_scales.numpy())
    axes = Rotation.from_quat(six.quaternions.numpy(), scalar_first=True).as_matrix()
    pose = step.view.camera.world_to_camera.numpy()
    offsets = means.numpy() + pose[:3, :3].T @ pose[:3, 3]
    extents = [
        np.sqrt(u @ (r * s**2) @ r.T @ u) / (u @ u)
        for u, r, s in zip(offsets, axes, scales, strict=True)
        if (pose[:3, :3] @ u)[2] > 0
    ]
    assert len(extents) == 5
    expected = 0.3 * sum(max(extent - limit, 0) for extent in extents)
    assert RayExtent(0.3, limit)(step).item() == pytest.approx(expected, rel=1e-12)
    assert (expected > 0) == (limit < 1)


def test_a_gaussian_at_the_camera_has_no_extent_and_no_gradient():
    scales = torch.ones(1, 3, requires_grad=True)
    extents = ray_extents(torch.zeros(1, 3), scales, torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    (gradient,) = torch.autograd.grad(extents.sum(), scales)
    assert extents.item() == 0
    assert torch.equal(gradient, torch.zeros(1, 3))


def test_gradients_of_ray_extent(assert_gradients_of_differences):
    assert_gradients_of_differences(RayExtent(0.3, 0.02), "log_scales", "quaternions")


def test_arguments_of_ray_extent():
    for text, message in (("ray_extent(-1.0)", "weight must"), ("ray_extent(1.0, 0.0)", "limit must be positive")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)


def test_it_is_the_mean(six, take_step):
    assert Opacity(0.3)(take_step()).item() == pytest.approx(0.3 * six.opacities.numpy().mean(), rel=1e-12)


def test_with_a_split_it_is_the_formula_of_dngaussian(six, take_step):
    o = six.opacities.numpy()
    expected = 1 - np.mean(o[o > 0.4] ** 2) + np.mean((1 - o[o < 0.4]) ** 2)
    assert Opacity(0.3, 0.4)(take_step()).item() == pytest.approx(0.3 * expected, rel=1e-12)


@pytest.mark.parametrize(("logit", "expected"), [(3.0, 1 - 0.9525741268**2), (-3.0, 1 + 0.9525741268**2)])
def test_an_empty_part_counts_nothing(take_step, logit, expected):
    step = take_step(opacity_logits=torch.full((6,), logit, dtype=torch.float64))
    assert Opacity(1.0, 0.2)(step).item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("split", [None, 0.4])
def test_gradients_of_opacity(assert_gradients_of_differences, split):
    assert_gradients_of_differences(Opacity(0.3, split), "opacity_logits")


def test_arguments_of_opacity():
    for text, message in (("opacity(-1.0)", "weight must"), ("opacity(1.0, 1.0)", r"split must be in \(0, 1\)")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
