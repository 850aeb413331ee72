"""Binocular3DGS's warp against numpy's interpolation, and against geometry: a plane seen from beside."""

import dataclasses

import numpy as np
import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.warp import Warp, edge_aware_smoothness, warp_horizontally


def literal_warp(image, disparity):
    """Every row looked up by numpy.interp; zero where a neighbor of the place is outside."""
    height, width = disparity.shape
    columns = np.arange(width)
    warped, inside = np.zeros_like(image), np.zeros((height, width))
    for row in range(height):
        places = columns + disparity[row]
        left = np.floor(places)
        inside[row] = (left >= 0) & (left + 1 < width)
        for channel in range(len(image)):
            warped[channel, row] = np.interp(places, columns, image[channel, row]) * inside[row]
    return warped, inside


def literal_smoothness(disparity, image):
    gray, total = image.sum(0), 0.0
    for axis in (1, 0):
        edges, steps = ((np.roll(x, -1, axis) - np.roll(x, 1, axis))[1:-1, 1:-1] / 2 for x in (gray, disparity))
        total += np.abs(np.exp(-0.33 * np.abs(edges)) * steps).mean()
    return total


def pictures():
    g = torch.Generator().manual_seed(0)
    image = torch.rand(3, 9, 14, generator=g, dtype=torch.float64)
    disparity = 6 * torch.randn(9, 14, generator=g, dtype=torch.float64)
    disparity[4:] = disparity[4:].round()  # on pixels, also on the first and the last of a row
    return image, disparity


def test_warp_and_smoothness_are_the_formulas():
    image, disparity = pictures()
    warped, inside = warp_horizontally(image, disparity)
    expected, mask = literal_warp(image.numpy(), disparity.numpy())
    assert 0.2 < mask.mean() < 0.9
    np.testing.assert_array_equal(inside.numpy(), mask)
    np.testing.assert_allclose((inside * warped).numpy(), expected, atol=1e-12)
    found = edge_aware_smoothness(disparity, image).item()
    assert found == pytest.approx(literal_smoothness(disparity.numpy(), image.numpy()), rel=1e-12)


def test_the_term_is_the_formula(six, take_step):
    step = take_step(seed=3)
    term, camera = Warp(0.7, shift=0.3, smooth=0.2), step.view.camera
    places = []
    render = step.render
    step.render = lambda camera: places.append(camera) or render(camera)
    value = term(step).item()
    assert value == term(step).item(), "the shift is the step's"
    shift = (places[0].position - camera.position) @ camera.world_to_camera[0, :3]
    assert 0 < abs(shift) <= 0.3
    assert (places[0].position - camera.position - shift * camera.world_to_camera[0, :3]).abs().max() < 1e-12
    shifted = render_gaussians(six, places[0], step.background).image.numpy()
    disparity = (-camera.fx * shift / (step.depth + 1e-5)).numpy()
    warped, inside = literal_warp(shifted, disparity)
    photograph = step.view.image.numpy()
    expected = np.abs(inside * (warped - photograph)).mean() + 0.2 * literal_smoothness(inside * disparity, photograph)
    assert value == pytest.approx(0.7 * expected, rel=1e-9)
    assert len(step.observed) == 1, "density control sees the render of the step alone"


def test_shifts_go_both_ways_up_to_the_largest(take_step):
    """All 40 to one side: once in 10^12 seeds; none beyond 0.8 of the largest: once in 7,500."""
    shifts = []
    for seed in range(40):
        step = take_step(seed=seed)
        rendering, camera = step.rendering, step.view.camera

        def render(moved, rendering=rendering, camera=camera):
            shifts.append(((moved.position - camera.position) @ camera.world_to_camera[0, :3]).item())
            return rendering

        step.render = render
        Warp(shift=0.5)(step)
    assert min(shifts) < 0 < max(shifts)
    assert 0.4 < max(map(abs, shifts)) <= 0.5


def test_the_true_depth_of_a_plane_warps_its_render_onto_the_photograph():
    """An opaque wall of soft spots at z = 2: the error is that of interpolation, and wrong depths err more."""
    g = torch.Generator().manual_seed(0)
    x, y = torch.meshgrid(torch.linspace(-2, 2, 33), torch.linspace(-1, 1, 17), indexing="xy")
    points = torch.stack([x.flatten(), y.flatten(), torch.full((33 * 17,), 2.0)], 1).double()
    colors = torch.rand(len(points), 3, generator=g, dtype=torch.float64)
    wall = Gaussians.from_points(points, colors, torch.full((len(points),), 0.12).double(), sh_degree=0, opacity=0.9)
    wall = dataclasses.replace(wall, log_scales=torch.tensor([0.12, 0.12, 1e-4]).double().log().repeat(len(points), 1))
    camera = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 24.0, 16.0, 48, 32)
    moved = torch.eye(4, dtype=torch.float64)
    moved[0, 3] = -0.2
    black = torch.zeros(3, dtype=torch.float64)
    one, other = (
        render_gaussians(wall, each, black, depth=True)
        for each in (camera, dataclasses.replace(camera, world_to_camera=moved))
    )
    errors = []
    for factor in (1.0, 0.7, 1.4):
        warped, inside = warp_horizontally(other.image, -60 * 0.2 / (factor * one.depth + 1e-5))
        errors.append(((inside * (warped - one.image)).abs().sum() / inside.sum() / 3).item())
    assert errors[0] < 0.01
    assert min(errors[1:]) > 5 * errors[0]


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(Warp(0.7, smooth=0.2), "means", "opacity_logits", "log_scales", seed=3)


def test_arguments():
    for text, message in (
        ("warp(shift=0.0)", "shift must be positive"),
        ("warp(smooth=-1.0)", "smooth must be finite and at least 0, got -1.0"),
        ("warp(-1.0)", "weight must"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
