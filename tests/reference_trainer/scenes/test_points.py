from __future__ import annotations

import struct
from pathlib import Path

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.points import (
    check_no_leak,
    choose_points,
    colmap_points,
    filled,
    random_points,
)
from reference_trainer.scenes.scene import PointCloud


def cloud(seen_by):
    return PointCloud(torch.zeros(1, 3), torch.zeros(1, 3), "sparse/0", seen_by)


def test_leak_is_refused_by_name_with_the_way_out():
    with pytest.raises(ValueError, match=r"sparse/0 .*2 images .*: c, d\..*--allow-test-points"):
        check_no_leak(cloud(frozenset("abcd")), ["a", "b"])
    with pytest.raises(ValueError, match="20 images"):
        check_no_leak(cloud(frozenset(map(str, range(20)))), [])


def test_no_leak_passes():
    check_no_leak(cloud(frozenset("ab")), ["a", "b", "c"])
    check_no_leak(cloud(frozenset()), ["a"])
    check_no_leak(cloud(None), ["a"])
    check_no_leak(cloud(frozenset("abcd")), ["a"], allow=True)


@pytest.mark.parametrize("train", ["images/5923", "5923", "a/b/images/5923.png", r"images\5923.jpg"])
def test_one_photograph_has_a_name_in_every_format(train):
    """COLMAP names files within the image folder, transforms.json paths within the scene, often without extension."""
    check_no_leak(cloud(frozenset({"5923.jpg"})), [train], ["images/5924", "images/15923"])


@pytest.mark.parametrize(
    ("seen", "train", "held_out"),
    [
        ("5924.jpg", ["images/5923"], ["images/5924"]),
        ("15923.jpg", ["images/5923"], []),  # names that end alike are not paths that do
        ("0001.jpg", ["left/0001"], ["right/0001"]),  # which of the two cannot be told
        ("right/0001.jpg", ["left/0001"], ["right/0001"]),
        ("a.png", ["a.jpg"], ["a.png"]),
        ("5923.5.jpg", ["images/5923"], []),
        ("", ["a.jpg"], []),
    ],
)
def test_another_photograph_is_not_taken_for_one_that_trains(seen, train, held_out):
    with pytest.raises(ValueError, match="1 image outside"):
        check_no_leak(cloud(frozenset({seen})), train, held_out)


def test_colmap_points(tmp_path, colmap_binary):
    colmap_binary(tmp_path)
    points = colmap_points(tmp_path)
    assert points.positions.dtype == points.colors.dtype == torch.float32
    assert points.positions.tolist() == [[0.5, -1.5, 2.25], [-4, 8, 0.125]]
    torch.testing.assert_close(points.colors[0] * 255, torch.tensor([255.0, 0, 17]))
    assert points.seen_by == {"b.png", "c.png"}
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    assert colmap_points(tmp_path) is None
    with pytest.raises(ValueError, match="no points"):
        choose_points(tmp_path, ".", [], [], torch.Generator())


def looking(position, target):
    """A camera at a place that looks at a point; which way is up does not matter here."""
    position, target = torch.tensor(position), torch.tensor(target)
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.3, 1.0, 0.2])), dim=0)
    pose = torch.eye(4)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(pose, 60.0, 50.0, 35.0, 22.0, 64, 48)


CAMERAS = [
    looking([3.0, 0.0, -4.0], [1.0, 2.0, 3.0]),
    looking([-3.0, 1.0, -4.0], [1.0, 2.0, 3.0]),
    looking([0.0, 5.0, -4.0], [1.0, 2.0, 3.0]),
]


def frames(cameras, bounds=None):
    return [Frame(str(i), Path(str(i)), camera, bounds=bounds) for i, camera in enumerate(cameras)]


@pytest.mark.parametrize("bounds", [None, (0.5, 30.0)])
def test_random_points_lie_in_the_frusta(bounds):
    points = random_points(frames(CAMERAS, bounds), 500, torch.Generator().manual_seed(0))
    depths = sorted((torch.tensor([1.0, 2.0, 3.0]) - camera.position).norm().item() for camera in CAMERAS)
    near, far = bounds or (depths[1] / 4, depths[1] * 4)
    seen = torch.zeros(500, dtype=torch.bool)
    for camera in CAMERAS:
        x, y, z = (points.positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (u > -1e-3) & (u < 64 + 1e-3) & (v > -1e-3) & (v < 48 + 1e-3)
        seen |= inside & (z > near * 0.999) & (z < far * 1.001)
    assert seen.all()
    assert points.seen_by == frozenset()


def test_random_points_are_uniform_in_inverse_depth():
    camera = Camera(torch.eye(4), 60.0, 50.0, 35.0, 22.0, 64, 48)
    points = random_points(frames([camera], (1.0, 10.0)), 4000, torch.Generator().manual_seed(1))
    share = (1 / points.positions[:, 2] - 0.1) / 0.9
    ordered = share.sort().values
    distance = (ordered - (torch.arange(4000) + 0.5) / 4000).abs().max()
    # Kolmogorov-Smirnov: above 1.95 / sqrt(n) in 1 of 1000 seeds.
    assert distance < 1.95 / 4000**0.5


def test_frusta_without_a_meeting_point_are_refused():
    parallel = [Camera(torch.eye(4), 60.0, 50.0, 35.0, 22.0, 64, 48)] * 2
    with pytest.raises(ValueError, match=r"optical axes .*--points .*COLMAP .*\.ply"):
        random_points(frames(parallel), 10, torch.Generator())
    apart = [looking([3.0, 0.0, 0.0], [6.0, 0.0, 1.0]), looking([-3.0, 0.0, 0.0], [-6.0, 0.0, 1.0])]
    with pytest.raises(ValueError, match="optical axes"):
        random_points(frames(apart), 10, torch.Generator())
    with pytest.raises(ValueError, match="0 < near < far"):
        random_points(frames(parallel, (2.0, 1.0)), 10, torch.Generator())


@pytest.mark.parametrize(("target", "in_box"), [([0.0, 0.0, 0.0], True), ([1.0, 2.0, 3.0], False)])
def test_random_points_repeat_and_leave_the_global_state(target, in_box):
    looks = frames(looking(camera.position.tolist(), target) for camera in CAMERAS)
    before = torch.get_rng_state()
    one, two, other = (random_points(looks, 99, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6))
    assert torch.equal(one.positions, two.positions)
    assert torch.equal(torch.get_rng_state(), before)
    assert not torch.equal(other.positions, one.positions)
    assert (one.positions.abs().max().item() <= 1.3) == in_box


def test_in_a_world_of_millimeters_random_points_are_no_speck_at_the_origin():
    scale = 1000.0
    looks = frames(looking((scale * camera.position).tolist(), [0.0, 0.0, 0.0]) for camera in CAMERAS)
    points = random_points(looks, 500, torch.Generator().manual_seed(0)).positions
    assert points.std(0).min() > 0.1 * scale


def test_a_thin_cloud_gets_random_points_at_its_depths(generator):
    cameras = [looking(at, (0.0, 0.0, 10.0)) for at in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))]
    flat = torch.rand(999, 3, generator=generator) + torch.tensor([0.0, 0.0, 8.0])
    thin = PointCloud(flat, torch.rand(999, 3, generator=generator), "sparse/0", frozenset("ab"))
    more, note = filled(thin, frames(cameras), generator)
    assert "10,000 random ones" in note
    assert torch.equal(more.positions[:999], flat)
    assert torch.equal(more.colors[:999], thin.colors)
    assert (more.source, more.seen_by, len(more.positions)) == ("sparse/0", frozenset("ab"), 10_999)
    known = torch.stack([camera.project(flat)[1] for camera in cameras])
    depths = torch.stack([camera.project(more.positions[999:])[1] for camera in cameras])
    within = (depths > known.min() - 1e-4) & (depths < known.max() + 1e-4)  # of the camera that drew it, at least
    assert within.any(0).all()
    assert within.sum() > 10_000


def test_a_cloud_that_tells_no_depths_stays_as_it_is(generator):
    train = frames([looking((0.0, 0.0, 0.0), (0.0, 0.0, 10.0))])
    behind = PointCloud(torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -2.0]]), torch.zeros(2, 3), "sparse/0")
    assert filled(behind, train, generator) == (behind, "")


def test_no_cloud_becomes_a_random_one(generator):
    none = PointCloud(torch.empty(0, 3), torch.empty(0, 3), "none")
    cloud, note = filled(none, frames(CAMERAS), generator)
    assert (cloud.source, len(cloud.positions)) == ("random", 10_000)
    assert note == "initial points: 10,000 random ones"
