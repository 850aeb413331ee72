import math

import numpy as np
import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.render.torch.projection import project

EYE = torch.eye(4)


def camera(**changes):
    values = {"world_to_camera": EYE, "fx": 60.0, "fy": 50.0, "cx": 33.0, "cy": 23.0, "width": 64, "height": 48}
    return Camera(**values | changes)


def quarter_turn() -> torch.Tensor:
    """A camera at (1, 2, 3) that looks along world +x: right is world -z, down is world +y."""
    pose = torch.eye(4, dtype=torch.float64)
    right, down, forward = [0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
    pose[:3, :3] = torch.tensor([right, down, forward])
    pose[:3, 3] = torch.tensor([3.0, -2.0, -1.0])  # -R (1, 2, 3)
    return pose


def test_position_and_direction_of_a_turned_camera():
    turned = camera(world_to_camera=quarter_turn())
    assert turned.position.tolist() == [1.0, 2.0, 3.0]
    assert turned.forward.tolist() == [1.0, 0.0, 0.0]


def test_a_point_lands_where_the_hand_puts_it():
    # 5 in front of the camera, 2 to its right (world -z), 1 below (world +y).
    point = torch.tensor([[6.0, 3.0, 1.0]], dtype=torch.float64)
    one = torch.ones(1, 3, dtype=torch.float64)
    projected = project(
        point, torch.tensor([[1.0, 0, 0, 0]]).double(), 1e-3 * one, camera(world_to_camera=quarter_turn())
    )
    torch.testing.assert_close(projected.means, torch.tensor([[33 + 60 * 2 / 5, 23 + 50 * 1 / 5]]).double())
    assert projected.depths.item() == pytest.approx(5.0)
    torch.testing.assert_close(camera(world_to_camera=quarter_turn()).lift(projected.means, projected.depths), point)
    pixels, depths = camera(world_to_camera=quarter_turn()).project(point)
    torch.testing.assert_close(pixels, projected.means)
    torch.testing.assert_close(depths, projected.depths)


def test_which_points_are_in_the_picture():
    points = torch.tensor([[0.0, 0.0, 1.0], [0.8, 0.0, 1.0], [-0.79, -0.59, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    wide = camera(fx=20.0, fy=20.0, cx=16.0, cy=12.0, width=32, height=24)
    assert wide.inside(*wide.project(points)).tolist() == [True, False, True, False, False]  # 0.8: on the right edge
    assert wide.inside(*wide.project(points[2])).item()


@pytest.mark.parametrize("factor", [0.5, 0.3, 2.0, 1e-3])
def test_scaling_keeps_the_field_of_view_and_the_principal_ray(factor):
    old = camera()
    new = old.resized(max(1, round(64 * factor)), max(1, round(48 * factor)))
    for size, focal, center in (("width", "fx", "cx"), ("height", "fy", "cy")):
        for edge in (0, 1):  # the rays through both edges of the picture stay
            slope = (edge * getattr(old, size) - getattr(old, center)) / getattr(old, focal)
            assert (edge * getattr(new, size) - getattr(new, center)) / getattr(new, focal) == pytest.approx(slope)
    assert new.world_to_camera is old.world_to_camera


def test_to_changes_the_pose_alone():
    moved = camera().to(dtype=torch.float64)
    assert moved.world_to_camera.dtype == torch.float64
    assert (moved.fx, moved.width) == (60.0, 64)


@pytest.mark.parametrize("kind", [int, np.float32, torch.tensor])
def test_numbers_of_any_kind_become_those_of_python(kind):
    found = camera(fx=kind(60), cy=kind(23), width=np.int64(64))
    assert [type(x) for x in (found.fx, found.cy, found.width)] == [float, float, int]
    assert (found.fx, found.cy, found.width) == (60, 23, 64)
    with pytest.raises(TypeError):
        camera(height=48.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world_to_camera": torch.eye(3)}, r"finite \(4, 4\)"),
        ({"world_to_camera": EYE * math.nan}, r"finite \(4, 4\)"),
        ({"fx": 0.0}, "focal lengths .*positive"),
        ({"fy": math.nan}, "focal lengths .*positive"),
        ({"fx": math.inf}, "focal lengths .*positive, finite pixels, got fx=inf"),
        ({"cx": math.inf}, "principal point .*finite, in pixels, got cx=inf"),
        ({"cy": math.nan}, "principal point .*finite"),
        ({"width": 0}, "image size .*positive"),
        ({"height": -3}, "image size .*positive"),
    ],
)
def test_impossible_cameras(changes, message):
    with pytest.raises(ValueError, match=message):
        camera(**changes)
