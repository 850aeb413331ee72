from __future__ import annotations

import numpy as np
import pytest
import torch

from reference_trainer.scenes.colmap import colmap_frames, read_colmap
from reference_trainer.scenes.numpy_formats import read_llff


def rows_of(camera_to_world_opencv, near=1.0, far=9.0):
    """LLFF rows from OpenCV camera-to-world matrices: the axes down, right, back are +y, +x, -z."""
    rows = []
    for pose in camera_to_world_opencv:
        right, down, forward, position = pose[:3].T
        matrix = np.stack([down, right, -forward, position, [60.0, 80.0, 100.0]], axis=1)
        rows.append([*matrix.ravel(), near, far])
    return np.array(rows)


def some_poses(count):
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(count):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3] = q * np.sign(np.linalg.det(q))
        pose[:3, 3] = rng.normal(size=3)
        poses.append(pose)
    return poses


def images(folder, count):
    folder.mkdir()
    for i in range(count):
        (folder / f"image{i:03}.png").touch()
    return folder


def test_poses_become_opencv_view_matrices(tmp_path):
    poses = some_poses(4)
    np.save(tmp_path / "poses_bounds.npy", rows_of(poses, near=2.0, far=5.0))
    frames = read_llff(tmp_path / "poses_bounds.npy", images(tmp_path / "images", 4))
    for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        assert frame.name == f"image{i:03}.png"
        assert frame.bounds == (2.0, 5.0)
        torch.testing.assert_close(frame.camera.world_to_camera, torch.from_numpy(np.linalg.inv(pose)))
        camera = frame.camera
        assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (80, 60, 100, 100, 40, 30)


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        (np.zeros((3, 16)), r"shape \(N, 17\)"),
        (np.full((3, 17), np.nan), "finite"),
        (rows_of(some_poses(2)), "has 2 poses but .* has 3 images"),
        (rows_of([np.diag([2.0, 2, 2, 1])] * 3), "no rotation"),
        (rows_of([np.diag([1.0, 1, -1, 1])] * 3), "no rotation"),
    ],
)
def test_bad_files_are_refused(tmp_path, rows, reason):
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=reason):
        read_llff(tmp_path / "poses_bounds.npy", images(tmp_path / "images", 3))


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file"):
        read_llff(tmp_path / "poses_bounds.npy", tmp_path)
    for content in (b"", b"no array", b"\x93NUMPY\x01\x00"):
        (tmp_path / "poses_bounds.npy").write_bytes(content)
        with pytest.raises(ValueError, match="NumPy array"):
            read_llff(tmp_path / "poses_bounds.npy", tmp_path)


@pytest.mark.data
@pytest.mark.parametrize(("scene", "folder"), [("fern", "images_8"), ("fountain", "images")])
def test_llff_and_colmap_files_describe_the_same_cameras(data_root, scene, folder):
    root = data_root / scene
    llff = read_llff(root / "poses_bounds.npy", root / folder)
    colmap = colmap_frames(read_colmap(root / "sparse" / "0"), root / folder)
    for one, other in zip(llff, colmap, strict=True):
        assert one.name == other.name
        torch.testing.assert_close(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-6, rtol=0)
        size = (other.camera.width, other.camera.height)
        assert one.camera.resized(*size).fx == pytest.approx(other.camera.fx, rel=1e-6)
