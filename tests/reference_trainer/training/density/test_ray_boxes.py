"""MVGS's density control against its rule, and its boxes against pairs of rays."""

import dataclasses
from itertools import combinations

import numpy as np
import pytest
import torch
from strategies import begun, some, stepped

from reference_trainer.camera import Camera
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.density import RayBoxDensity
from reference_trainer.training.density.ray_boxes import ray_box


def closest(o1, d1, o2, d2):
    """The middle between two lines, by least squares for the two distances along them."""
    d1, d2 = d1 / np.linalg.norm(d1), d2 / np.linalg.norm(d2)
    (t, s), *_ = np.linalg.lstsq(np.stack([d1, -d2], 1), o2 - o1, rcond=None)
    return (o1 + t * d1 + o2 + s * d2) / 2


def boxes(views, images, height: int, width: int):
    """Lower and upper corners of the boxes of all pairs of views, pixel by pixel."""
    regions = []
    for view, image in zip(views, images, strict=True):
        error, worst = (image - view.image).abs().double().numpy(), (0.0, 0, 0)
        for i in range(0, error.shape[1] - height, height):
            for j in range(0, error.shape[2] - width, width):
                mean = error[:, i : i + height, j : j + width].mean()
                worst = max(worst, (mean, -i, -j))
        _, i, j = worst
        k = np.array([[view.camera.fx, 0, view.camera.cx], [0, view.camera.fy, view.camera.cy], [0, 0, 1]])
        rotation = view.camera.world_to_camera[:3, :3].double().numpy()
        rays = [
            rotation.T @ np.linalg.inv(k) @ np.array([x + 0.5, y + 0.5, 1.0])
            for y in (-i, height - i) for x in (-j, width - j)
        ]  # fmt: skip
        regions.append((view.camera.position.double().numpy(), rays))
    for (o1, rays1), (o2, rays2) in combinations(regions, 2):
        meets = np.stack([closest(o1, d1, o2, d2) for d1, d2 in zip(rays1, rays2, strict=True)])
        yield meets.min(0), meets.max(0)


@pytest.mark.parametrize("distance", [0.0, 10.0])
def test_ray_boxes_clones_inside_and_halves_the_threshold_of_cameras_far_apart(tiny_scene, distance):
    """Cameras around the origin of the world are far apart in the source's measure, those far from it are not."""
    shift = torch.tensor([0.0, 0.0, distance])
    away = torch.eye(4)
    away[:3, 3] = -shift
    views = tuple(
        dataclasses.replace(
            view, camera=dataclasses.replace(view.camera, world_to_camera=view.camera.world_to_camera @ away)
        )
        for view in tiny_scene.train
    )
    scene = dataclasses.replace(tiny_scene, train=views)
    start = some(1000, size=0.05)
    start.means[:] = 2 * start.means.tanh() + torch.tensor([0.0, 0.0, 3.0]) + shift
    optimizer = stepped(start)
    old = optimizer.gaussians.map(torch.Tensor.detach).map(torch.clone)
    small, large = int(old.scales.amax(1).argmin()), int(old.scales.amax(1).argmax())
    size = 0.999 * old.scales[large].max().item() / scene.extent
    strategy = begun("ray_boxes(height=10, width=15)", scene, 1000, dense_fraction=size, prune_opacity=0.0)
    seen_at = torch.zeros(1000)
    seen_at[[small, large]] = 3e-4  # of 5e-4, or half of it
    strategy.load_state_dict({"gradient_sum": seen_at, "steps": torch.ones(1000)})
    images = [render_gaussians(old, view.camera, scene.background, sh_degree=0).image for view in views]
    inside = torch.zeros(1000, dtype=torch.bool)
    for low, high in boxes(views, images, 10, 15):
        inside |= torch.from_numpy(((old.means.double().numpy() > low) & (old.means.double().numpy() < high)).all(1))
    assert 10 < inside.sum() < 900
    centers = [view.camera.position / view.camera.position.norm() for view in views]
    far = any((one - other).norm() > 1 for one, other in combinations(centers, 2))
    assert bool(far) is (distance == 0)
    strategy.densify(optimizer, 100)
    cloned = inside.clone()
    cloned[small] |= far
    new = optimizer.gaussians.means
    if far:  # the large one is split, and cloned as well if it is inside
        kept = torch.arange(1000) != large
        assert torch.equal(new[: 999 + cloned.sum()], torch.cat([old.means[kept], old.means[cloned]]))
        assert len(new) == 999 + cloned.sum() + 2
    else:
        assert torch.equal(new, torch.cat([old.means, old.means[cloned]]))


def test_ray_boxes_draws_views_that_depend_on_the_step_alone(tiny_scene, monkeypatch):
    drawn = []
    monkeypatch.setattr(RayBoxDensity, "_inside", lambda self, optimizer, views, step: drawn.append(views) or False)
    strategy = begun("ray_boxes(2)", tiny_scene, 4)
    for step in (*range(12), 3):
        strategy.grow(stepped(some(4)), step)
    names = [tuple(view.name for view in views) for views in drawn]
    assert names[3] == names[-1]
    assert all(len({*pair}) == 2 for pair in names)
    assert len({*names}) > 1


def test_ray_boxes_of_parallel_rays_are_none():
    camera = Camera(torch.eye(4), 10.0, 10.0, 4.0, 3.0, 8, 6)
    pose = torch.eye(4)
    pose[0, 3] = -1.0
    beside = dataclasses.replace(camera, world_to_camera=pose)
    corners = torch.tensor([[1.5, 1.5], [6.5, 4.5]])
    assert ray_box(camera, corners, beside, corners) is None
