"""Orbit cameras: where they stand, what they see, and that stray Gaussians do not matter."""

import math

import pytest
import torch

from reference_trainer.model.ply import load_ply
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.virtual_cameras import bounding_sphere, orbit_views

CENTER = torch.tensor([3.0, -2.0, 5.0])


def shell(n=4000):
    """Points on a sphere of radius 2 around CENTER."""
    g = torch.Generator().manual_seed(0)
    return CENTER + 2 * torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)


def pixels(camera, points):
    x, y, z = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).unbind(1)
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)


@pytest.mark.parametrize(("width", "height"), [(120, 90), (60, 100)])
def test_the_sphere_touches_the_shorter_side_and_the_center_is_in_the_middle(width, height):
    points = shell()
    for camera in orbit_views(points, torch.full((4000, 1), 0.3), count=7, width=width, height=height):
        assert 2 * math.degrees(math.atan(min(width, height) / 2 / camera.fx)) == pytest.approx(45)
        seen = pixels(camera, points) - torch.tensor([width / 2, height / 2])
        # The quantile leaves 2 % of the points outside, and 4,000 of them place the center to about 1 %.
        assert seen.norm(dim=1).quantile(0.98).item() == pytest.approx(min(width, height) / 2, rel=0.06)
        assert pixels(camera, CENTER[None])[0].tolist() == pytest.approx([width / 2, height / 2], abs=2)


def test_cameras_stand_on_a_level_circle_upright():
    cameras = orbit_views(shell(), torch.ones(4000), count=6, width=50, height=50)
    positions = torch.stack([camera.position for camera in cameras]).double()
    assert positions[:, 1].max() - positions[:, 1].min() < 1e-5
    assert positions[0, 1] < CENTER[1]  # above, because y points down
    assert positions[0, 2] < CENTER[2]
    distances = torch.cdist(positions, positions)
    assert distances[0, 3] / distances[0, 1] == pytest.approx(2, abs=1e-4)  # a regular hexagon
    assert distances[0, 3] / distances[0, 2] == pytest.approx(2 / math.sqrt(3), abs=1e-4)
    for camera in cameras:
        rotation = camera.world_to_camera[:3, :3].double()
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), rtol=0, atol=1e-6)
        assert torch.linalg.det(rotation) > 0
        assert rotation[0, 1].abs() < 1e-6  # the horizon is level
        assert rotation[1, 1] > 0.9  # and y points down in the picture


def test_neither_a_few_far_gaussians_nor_many_transparent_ones_move_the_cameras():
    points, weights = shell(), torch.ones(4000)
    plain = orbit_views(points, weights, count=3, width=40, height=40)
    far = torch.full((20, 3), 1e4)
    haze = torch.full((4000, 3), -50.0)
    disturbed = orbit_views(
        torch.cat([points, far, haze]),
        torch.cat([weights, torch.ones(20), torch.full((4000,), 1e-6)]),
        count=3,
        width=40,
        height=40,
    )
    for one, other in zip(plain, disturbed, strict=True):
        assert (one.position - other.position).norm() < 0.1
    visible = orbit_views(
        torch.cat([points, haze]), torch.cat([weights, torch.zeros(4000)]), count=1, width=4, height=4
    )
    torch.testing.assert_close(visible[0].world_to_camera, plain[0].world_to_camera, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("world", "up"),
    [
        ("y-down", [0, -1, 0]),
        ("y-up", [0, 1, 0]),
        ("z-up", [0, 0, 1]),
        ("z-down", [0, 0, -1]),
        ("x-up", [1, 0, 0]),
        ("x-down", [-1, 0, 0]),
    ],
)
def test_up_is_up_in_every_world(world, up):
    """Cameras look down from above, and what is higher in the world is higher in the picture."""
    top = CENTER + torch.tensor(up, dtype=torch.float32)
    for camera in orbit_views(shell(), torch.ones(4000), count=3, width=50, height=50, world=world):
        assert camera.forward @ (top - CENTER) == pytest.approx(-math.sin(math.radians(20)), abs=1e-5)
        (column, row), (top_column, top_row) = pixels(camera, torch.stack([CENTER, top])).tolist()
        assert top_row < row - 5
        assert top_column == pytest.approx(column, abs=0.2)
        assert torch.linalg.det(camera.world_to_camera[:3, :3]) > 0


@pytest.mark.parametrize(("count", "angles"), [(1, [0]), (2, [-30, 30]), (3, [-30, 0, 30]), (4, [-30, -10, 10, 30])])
def test_an_arc_is_centered_on_the_first_camera_of_the_circle(count, angles):
    cameras = orbit_views(shell(), torch.ones(4000), count=count, width=9, height=9, arc=math.radians(60))
    found = [math.degrees(math.atan2(-camera.forward[0], camera.forward[2])) for camera in cameras]
    assert found == pytest.approx(angles, abs=1e-3)


@pytest.mark.parametrize("fill", [0.3, 0.8])
def test_the_sphere_fills_that_share(fill):
    points = shell()
    (camera,) = orbit_views(points, torch.ones(4000), count=1, width=100, height=100, fill=fill)
    seen = pixels(camera, points) - 50
    assert seen.norm(dim=1).quantile(0.98).item() == pytest.approx(50 * fill, rel=0.06)


def test_of_a_place_the_middle_is_looked_at():
    """A shell of radius 2 in a room 15 times as large, which holds a third of the Gaussians."""
    room = CENTER + 15 * (shell(2000) - CENTER)
    alone = bounding_sphere(shell(), torch.ones(4000))
    placed = bounding_sphere(torch.cat([shell(), room]), torch.ones(6000))
    assert (alone.surroundings, placed.surroundings) == (False, True)
    assert alone.radius == pytest.approx(2, rel=0.01)
    assert placed.radius == pytest.approx(4, rel=0.15)  # twice the median distance, and the median is at the shell
    assert (placed.center - CENTER).norm() < 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"opacities": torch.zeros(4000)}, "total opacity of 0"),
        ({"means": torch.ones(4000, 3)}, "lie on one point"),
    ],
)
def test_what_cannot_be_looked_at_is_refused(change, message):
    arguments = {"means": shell(), "opacities": torch.ones(4000), "count": 1, "width": 8, "height": 8}
    with pytest.raises(ValueError, match=message):
        orbit_views(**(arguments | change))


@pytest.mark.data
@pytest.mark.parametrize("name", ["plant_20k_sh3zero", "spot_10k_mesh2splat_sh3zero"])
def test_real_models_fill_the_picture(name, data_root):
    gaussians = load_ply(data_root / "splats" / f"{name}.ply").gaussians
    for camera in orbit_views(gaussians.means, gaussians.opacities, count=2, width=64, height=64):
        covered = render_gaussians(gaussians, camera, torch.zeros(3)).alpha > 0.5
        rows, columns = covered.nonzero().unbind(1)
        assert max(rows.max() - rows.min(), columns.max() - columns.min()) > 48
        border = torch.cat([covered[0], covered[-1], covered[:, 0], covered[:, -1]])
        assert border.double().mean() < 0.1
