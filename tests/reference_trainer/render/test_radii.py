"""Radii against the definition in the CUDA sources, Gaussian by Gaussian and tile by tile."""

import math

import pytest
import torch
from oracles import random_scene

from reference_trainer.render.radii import in_front, visible_radii


def _definition(mean, quaternion, scale, camera) -> int:
    """Radius and visibility of one Gaussian, from the definitions."""
    local = camera.world_to_camera[:3, :3] @ mean + camera.world_to_camera[:3, 3]
    x, y, z = local.tolist()
    if z <= 0.2:
        return 0
    w, i, j, k = (quaternion / quaternion.norm()).tolist()
    skew = torch.tensor([[0, -k, j], [k, 0, -i], [-j, i, 0]]).double()
    rotation = torch.eye(3).double() + 2 * w * skew + 2 * skew @ skew
    covariance = rotation @ torch.diag(scale**2) @ rotation.T
    limit_x, limit_y = 0.65 * camera.width / camera.fx, 0.65 * camera.height / camera.fy
    u, v = min(limit_x, max(-limit_x, x / z)), min(limit_y, max(-limit_y, y / z))
    jacobian = torch.tensor([[camera.fx / z, 0, -camera.fx * u / z], [0, camera.fy / z, -camera.fy * v / z]]).double()
    chain = jacobian @ camera.world_to_camera[:3, :3]
    small, large = torch.linalg.eigvalsh(chain @ covariance @ chain.T + 0.3 * torch.eye(2).double()).tolist()
    middle, spread = 0.5 * (large + small), 0.5 * (large - small)
    radius = math.ceil(3 * math.sqrt(middle + math.sqrt(max(0.1, spread**2))))
    center = (camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5)
    meets = all(
        any(16 * tile + 1 <= c + radius and 16 * tile + 16 > c - radius for tile in range(math.ceil(size / 16)))
        for c, size in zip(center, (camera.width, camera.height), strict=True)
    )
    return radius if meets else 0


@pytest.mark.parametrize("size", [0.002, 0.05, 0.3])
def test_radii_equal_the_definition(size):
    scene = random_scene(150, 70, 45, seed=2, size=size)
    means = scene.means * 1.6  # so that many lie off the picture
    radii = visible_radii(means, scene.quaternions, scene.scales, scene.camera)
    expected = [_definition(*rows, scene.camera) for rows in zip(means, scene.quaternions, scene.scales, strict=True)]
    assert radii.dtype == torch.int32
    assert radii.tolist() == expected
    assert 0 < expected.count(0) < 150


def test_in_front_is_the_near_plane():
    scene = random_scene(60, 20, 20, seed=3)
    depths = [(scene.camera.world_to_camera[:3, :3] @ x + scene.camera.world_to_camera[:3, 3])[2] for x in scene.means]
    assert in_front(scene.means, scene.camera).tolist() == [bool(z > 0.2) for z in depths]
