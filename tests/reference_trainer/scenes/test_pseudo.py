"""Cameras on the way from one to another."""

import dataclasses

import pytest
import torch
from scipy.linalg import fractional_matrix_power

from reference_trainer.camera import Camera
from reference_trainer.scenes.virtual_cameras import camera_between, cameras_between, look_at

DOWN = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def looking(position, target) -> Camera:
    pose = look_at(*(torch.tensor(x, dtype=torch.float64) for x in (position, target)), DOWN)
    return Camera(pose, 50.0, 40.0, 16.0, 12.0, 32, 24)


@pytest.mark.parametrize("along", [-0.5, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("target", [(0.2, 0.1, 3.0), (-4.0, 1.0, -2.0)])
def test_an_arc_is_a_power_of_the_motion_from_one_to_the_other(along, target):
    first, second = looking((0.0, 0.0, 0.0), (0.1, 0.2, 4.0)), looking((1.0, -0.5, 0.3), target)
    motion = second.world_to_camera @ torch.linalg.inv(first.world_to_camera)
    expected = torch.from_numpy(fractional_matrix_power(motion.numpy(), along).real) @ first.world_to_camera
    found = camera_between(first, second, along, "arc")
    torch.testing.assert_close(found.world_to_camera, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("along", [0.2, 0.5, 0.9])
def test_cameras_that_face_a_point_from_one_distance_go_around_it(along):
    target = torch.tensor([0.4, 0.3, 2.0], dtype=torch.float64)
    offsets = torch.tensor([[3.0, -1.0, 0.5], [-2.0, -1.5, 2.0]], dtype=torch.float64)
    ends = [looking((target + 2 * x / x.norm()).tolist(), target.tolist()) for x in offsets]
    found = camera_between(*ends, along, "arc")
    assert not found.world_to_camera.requires_grad
    assert (found.position - target).norm().item() == pytest.approx(2)
    torch.testing.assert_close(found.position + 2 * found.forward, target, rtol=0, atol=1e-9)
    straight = camera_between(*ends, along)
    torch.testing.assert_close(straight.position, torch.lerp(ends[0].position, ends[1].position, along))
    torch.testing.assert_close(straight.world_to_camera[:3, :3], found.world_to_camera[:3, :3])


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_without_a_turn_an_arc_is_a_line_and_half_a_turn_is_finite(turn):
    first = looking((0.0, 0.0, 0.0), (0.0, 0.0, 4.0))
    second = looking((1.0, 0.5, 0.0), (1.0, 0.5, 4.0 * turn))
    found = camera_between(first, second, 0.25, "arc").position
    if turn > 0:
        torch.testing.assert_close(found, torch.tensor([0.25, 0.125, 0.0], dtype=torch.float64))
    assert (found - second.position).norm() < 2


@pytest.mark.parametrize("past", [-0.15, 0.5])
def test_draws_stand_on_the_way_of_any_two_with_the_intrinsics_of_either(tiny_scene, past):
    """60 draws of 6 ordered pairs: one is missed by 1 of 9,000 choices of the seeds."""
    corners = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    views = tuple(
        dataclasses.replace(view, camera=dataclasses.replace(looking(c, (c[0], c[1], 4.0)), fx=50.0 + i))
        for i, (view, c) in enumerate(zip(tiny_scene.train, corners, strict=True))
    )
    draw, pairs = cameras_between(dataclasses.replace(tiny_scene, train=views), "line", past=past), set()
    reached = 0.0
    for seed in range(60):
        camera = draw(torch.Generator().manual_seed(seed))
        x, y, _ = camera.position.tolist()
        shares = [1 - x - y, x, y]
        off = min(range(3), key=lambda i: abs(shares[i]))
        assert shares[off] == pytest.approx(0, abs=1e-9)
        assert 0.5 <= max(shares) <= 1 + past + 1e-9
        reached = max(reached, max(shares))
        pairs.add((camera.fx, off))
    assert len(pairs) == 6
    assert reached > 0.9 * (1 + past)
