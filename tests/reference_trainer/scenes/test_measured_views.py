import dataclasses
import math

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.scenes.virtual_cameras import interpolate_cameras, measured_views


def rotation(axis: torch.Tensor, degrees: float) -> torch.Tensor:
    """The matrix exponential, an independent way to a rotation."""
    x, y, z = (axis / axis.norm() * math.radians(degrees)).tolist()
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


def camera(turn: torch.Tensor, position: torch.Tensor, **changes) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = turn
    pose[:3, 3] = -turn @ position
    return dataclasses.replace(Camera(pose, 50.0, 40.0, 16.0, 12.0, 32, 24), **changes)


def random_cameras(count: int) -> list[Camera]:
    g = torch.Generator().manual_seed(5)
    return [
        camera(rotation(torch.randn(3, generator=g).double(), 40 * i), torch.randn(3, generator=g, dtype=torch.float64))
        for i in range(1, count + 1)
    ]


def test_the_path_goes_through_the_given_cameras():
    cameras = random_cameras(4)
    path = interpolate_cameras(cameras, 10)  # 3 frames per leg
    assert len(path) == 10
    for given, reached in zip(cameras, path[::3], strict=True):
        torch.testing.assert_close(reached.world_to_camera, given.world_to_camera, rtol=0, atol=1e-6)


def test_every_camera_is_a_rotation_and_positions_are_on_straight_lines():
    cameras = random_cameras(3)
    path = interpolate_cameras(cameras, 9)
    for i, frame in enumerate(path):
        turn = frame.world_to_camera[:3, :3]
        torch.testing.assert_close(turn @ turn.T, torch.eye(3).double(), rtol=0, atol=1e-6)
        assert torch.linalg.det(turn).item() == pytest.approx(1.0, abs=1e-6)
        leg, along = divmod(i, 4) if i < 8 else (1, 4)
        expected = cameras[leg].position + along / 4 * (cameras[leg + 1].position - cameras[leg].position)
        torch.testing.assert_close(frame.position, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("start", "end"), [(-30.0, 50.0), (170.0, 190.0), (100.0, 260.0), (350.0, 370.0)])
def test_turns_are_even_and_take_the_short_way(start, end):
    axis = torch.tensor([0.3, 1.0, -0.5], dtype=torch.float64)
    still = torch.zeros(3, dtype=torch.float64)
    path = interpolate_cameras([camera(rotation(axis, start), still), camera(rotation(axis, end), still)], 5)
    for i, frame in enumerate(path):
        expected = rotation(axis, start + (end - start) * i / 4)
        torch.testing.assert_close(frame.world_to_camera[:3, :3], expected, rtol=0, atol=1e-6)


def test_cameras_without_a_turn_between_them():
    turn = rotation(torch.ones(3), 25.0)
    ends = [camera(turn, torch.zeros(3).double()), camera(turn, torch.ones(3).double())]
    for frame in interpolate_cameras(ends, 4):
        torch.testing.assert_close(frame.world_to_camera[:3, :3], turn, rtol=0, atol=1e-6)


def test_intrinsics_are_those_of_the_first_camera():
    first, second = random_cameras(2)
    second = dataclasses.replace(second, fx=99.0, width=64)
    assert {(c.fx, c.fy, c.width, c.height) for c in interpolate_cameras([first, second], 3)} == {(50.0, 40.0, 32, 24)}


@pytest.mark.parametrize(("count", "frames"), [(0, 5), (1, 5), (2, 1)])
def test_too_few_of_something(count, frames):
    with pytest.raises(ValueError, match="2 cameras and 2 frames"):
        interpolate_cameras(random_cameras(count), frames)


def scene_of(cameras, test=()) -> Scene:
    views = [View(f"photo {i}.png", each, torch.zeros(3, 24, 32)) for i, each in enumerate(cameras)]
    return Scene("scene", tuple(views), test, None, torch.zeros(3))


def test_a_scene_with_test_views_is_measured_there(said):
    scene = scene_of(random_cameras(2))
    scene = dataclasses.replace(scene, test=scene.train)
    assert measured_views(scene) == {"train": scene.train, "test": scene.test}
    assert said == []


def test_without_test_views_a_model_is_measured_between_and_around_the_training_views(said):
    """Cameras at 0, 10 and 40 degrees of a circle, which is where the turns of the new ones are as well."""
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    degrees = (0.0, 10.0, 40.0)
    cameras = [camera(rotation(axis, x), torch.tensor([x, 0.0, 1.0]).double()) for x in degrees]
    found = measured_views(scene_of(cameras))
    assert list(found) == ["train", "between", "around"]
    assert len(said) == 1
    assert said[0].startswith("No test views")
    for split, places in {"between": [5.0, 25.0], "around": [-5.0, 15.0, 55.0]}.items():
        for view, x in zip(found[split], places, strict=True):
            expected = camera(rotation(axis, x), torch.tensor([x, 0.0, 1.0]).double())
            torch.testing.assert_close(view.camera.world_to_camera, expected.world_to_camera, rtol=0, atol=1e-5)
    assert [view.name for view in found["around"]] == ["000", "001", "002"]


def test_the_nearest_camera_is_found_far_from_the_origin():
    """Where a distance by way of products has lost it, as torch.cdist takes it of more than 25 places."""
    angles = torch.arange(30).double() * 12
    places = torch.stack([1000 + angles.deg2rad().cos(), angles.deg2rad().sin(), torch.zeros(30)], 1)
    cameras = [camera(torch.eye(3).double(), place) for place in places]
    between = measured_views(scene_of(cameras))["between"]
    steps = [(view.camera.position - places.to(view.camera.position)).norm(dim=1).min().item() for view in between]
    assert len(steps) >= 15
    assert max(steps) < 0.11  # half of a step of 2 sin(6 degrees), but for single precision


def test_one_training_view_has_nothing_around_it():
    scene = scene_of(random_cameras(1))
    assert measured_views(scene) == {"train": scene.train}
