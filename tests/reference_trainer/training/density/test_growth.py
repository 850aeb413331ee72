"""FSGS's and MVGS's density control against their rules."""

import dataclasses
import math
from itertools import combinations

import numpy as np
import pytest
import torch
from strategies import begun, some, stepped

from reference_trainer.camera import Camera
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.density import RayBoxDensity
from reference_trainer.training.density.growth import ray_box


def test_proximity_unpools_and_splits_the_sparse(tiny_scene):
    """A far group of four large Gaussians: against the rule, written out with loops over all pairs."""
    scene = dataclasses.replace(tiny_scene)
    start = some(30, seed=3, size=0.01)
    start.means[26:] = torch.tensor([[60.0, 0, 0], [64, 0, 0], [60, 9, 0], [60, 0, 30]])
    start.log_scales[26:] = math.log(2 * scene.extent)
    start.log_scales[29] = math.log(0.5 * scene.extent)  # far, but small
    optimizer = stepped(start)
    old = optimizer.gaussians.map(torch.Tensor.detach)
    pairs = [[(a - b).square().sum().item() for b in old.means.double()] for a in old.means.double()]
    near = [sorted((d, j) for j, d in enumerate(row) if j != i)[:3] for i, row in enumerate(pairs)]
    mean = [sum(d for d, _ in three) / 3 for three in near]
    distance = 0.5 * min(mean[i] for i in (26, 27, 28)) / scene.extent
    strategy = begun(f"proximity(100, {distance}, 1e9)", scene, 30, dense_fraction=10.0, prune_opacity=0.0)
    strategy.densify(optimizer, 99)
    expected = [i for i in range(30) if mean[i] > distance * scene.extent and old.scales[i].max() > scene.extent]
    assert expected == [26, 27, 28]
    new = optimizer.gaussians
    assert len(new) == 30 + 9
    for row, (i, j) in enumerate((source, target) for source in expected for _, target in near[source]):
        torch.testing.assert_close(new.means[30 + row], (old.means[i] + old.means[j]) / 2)
        assert torch.equal(new.log_scales[30 + row], old.log_scales[j])
        assert torch.equal(new.opacity_logits[30 + row], old.opacity_logits[j])
    assert torch.equal(new.quaternions[30:], torch.tensor([[1.0, 0, 0, 0]]).expand(9, 4))
    assert not new.sh[30:].any()
    assert not any(m[30:].any() for m in optimizer.state_dict()["moments"]["means"].values() if m.ndim)

    optimizer = stepped(start)
    strategy.densify(optimizer, 100)  # unpooling is over
    assert len(optimizer.gaussians) == 30
    splits = begun(f"proximity(0, 1e9, {distance})", scene, 30, dense_fraction=10.0, prune_opacity=0.0)
    splits.densify(optimizer, 1)
    assert len(optimizer.gaussians) == 33
    torch.testing.assert_close(optimizer.gaussians.scales[27:], old.scales[[26, 27, 28] * 2] / 1.6)


def test_proximity_looks_at_neighbors_only_if_there_are_three(tiny_scene):
    optimizer = stepped(some(3, size=100.0))
    strategy = begun("proximity(distance=1e-9)", tiny_scene, 3, prune_opacity=0.0)
    strategy.densify(optimizer, 1)
    assert len(optimizer.gaussians) == 3


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
