from __future__ import annotations

import math
import struct

import numpy as np
import pytest
import torch

from reference_trainer.scenes._colmap_model import CAMERA_MODELS, READERS, view_matrix_from_quaternion
from reference_trainer.scenes.colmap import colmap_frames, read_colmap


def test_text_and_binary_hold_the_same_model(tmp_path, colmap_binary, colmap_text):
    colmap_binary(tmp_path / "bin")
    colmap_text(tmp_path / "txt")
    a, b = read_colmap(tmp_path / "bin"), read_colmap(tmp_path / "txt")
    assert a.cameras.keys() == b.cameras.keys()
    for one, other in ((a.cameras[i], b.cameras[i]) for i in a.cameras):
        assert (one.model, one.distortion, repr(one.pinhole)) == (other.model, other.distortion, repr(other.pinhole))
    assert [image.name for image in a.images] == [image.name for image in b.images] == ["a b.png", "b.png", "c.png"]
    for one, other in zip(a.images, b.images, strict=True):
        assert (one.id, one.camera_id) == (other.id, other.camera_id)
        assert np.array_equal(one.world_to_camera, other.world_to_camera)
    for field in ("positions", "colors"):
        assert np.array_equal(getattr(a.points, field), getattr(b.points, field))
        assert getattr(a.points, field).dtype == getattr(b.points, field).dtype
    assert [t.tolist() for t in a.points.tracks] == [t.tolist() for t in b.points.tracks] == [[3, 9], [9]]


def test_values_are_those_written(tmp_path, colmap_binary):
    colmap_binary(tmp_path)
    model = read_colmap(tmp_path)
    camera = model.cameras[7]
    assert (camera.model.name, camera.distortion) == ("SIMPLE_RADIAL", (0.125,))
    lens = camera.pinhole
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == (32, 24, 40, 40, 16, 12)
    assert model.cameras[1].pinhole.fy == 51.25
    b = model.images[1]
    # The quaternion (1, 1, 1, 1) / 2 turns 120 degrees about (1, 1, 1): x -> y -> z -> x.
    assert np.array_equal(b.world_to_camera[:3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert b.world_to_camera[:3, 3].tolist() == [1, -2, 3.5]
    assert model.points.positions.tolist() == [[0.5, -1.5, 2.25], [-4, 8, 0.125]]
    assert model.points.colors.tolist() == [[255, 0, 17], [1, 2, 3]]
    assert model.seen_by() == {"b.png", "c.png"}


def test_quaternion_is_the_axis_angle_rotation():
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        angle = rng.uniform(-3, 3)
        q = rng.uniform(0.5, 2) * np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])
        v = rng.normal(size=3)
        # Rodrigues
        turned = v * math.cos(angle) + np.cross(axis, v) * math.sin(angle) + axis * (axis @ v) * (1 - math.cos(angle))
        assert np.allclose(view_matrix_from_quaternion(q, (0, 0, 0))[:3, :3] @ v, turned, atol=1e-12)


@pytest.mark.parametrize("name", READERS)
def test_every_truncation_is_refused(tmp_path, colmap_binary, name):
    colmap_binary(tmp_path)
    path = tmp_path / f"{name}.bin"
    whole = path.read_bytes()
    read = READERS[name][".bin"]
    read(path)
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=rf"{name}\.bin is truncated"):
            read(path)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("count", [2**62, 2**63 - 1, 2**64 - 1, 1000])
def test_absurd_counts_are_refused_before_allocating(tmp_path, colmap_binary, name, count):
    colmap_binary(tmp_path)
    path = tmp_path / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    # The whole count is refused, not the first record that is missing.
    with pytest.raises(ValueError, match=rf"COLMAP file: {count} \w+ needs"):
        read_colmap(tmp_path)


def test_damaged_text_names_file_and_line(tmp_path, colmap_text):
    colmap_text(tmp_path)
    for name, bad in {
        "cameras.txt": ["1 PINHOLE 64 48 50.5", "1 PINHOLE 0 48 50 50 1 1", "1 WRONG 64 48 1 1 1 1", "1", "x y z w"],
        "images.txt": ["3 0.5 0.5 0.5", "3 0 0 0 0 1 1 1 1 b.png\n"],
        "points3D.txt": ["10 0 1 2 255 0", "10 0 1 2 255 0 300 0.5", "10 0 1 2 1 1 1 0.5 3"],
    }.items():
        whole = (tmp_path / name).read_text()
        for line in bad:
            (tmp_path / name).write_text(f"# a comment\n{line}\n")
            with pytest.raises(ValueError, match=rf"{name}, line 2"):
                read_colmap(tmp_path)
        (tmp_path / name).write_text(whole)


def test_an_image_in_place_of_features_is_refused(tmp_path, colmap_text):
    """Scripts forget the second line of an image, which may be empty; every other image would be lost."""
    colmap_text(tmp_path)
    lines = (tmp_path / "images.txt").read_text().splitlines()
    images = [line for line in lines if line.endswith(".png")]
    assert len(images) == 3
    (tmp_path / "images.txt").write_text("\n".join(images) + "\n")
    with pytest.raises(ValueError, match=r"images\.txt, line 1.*features"):
        read_colmap(tmp_path)


def test_inconsistent_models_are_refused(tmp_path, colmap_text):
    colmap_text(tmp_path)
    images = (tmp_path / "images.txt").read_text()
    (tmp_path / "images.txt").write_text(images.replace("2 1 b.png", "2 5 b.png").replace("3.5 1 b", "3.5 5 b"))
    with pytest.raises(ValueError, match=r"'b\.png' has camera 5; .*\[1, 7\]"):
        read_colmap(tmp_path)
    (tmp_path / "images.txt").write_text(images.replace("c.png", "b.png"))
    with pytest.raises(ValueError, match="same name"):
        read_colmap(tmp_path)
    (tmp_path / "images.txt").write_text(images)
    points = (tmp_path / "points3D.txt").read_text()
    (tmp_path / "points3D.txt").write_text(points.replace("-4 8", "nan 8"))
    with pytest.raises(ValueError, match=r"points3D\.txt: 1 of 2 points"):
        read_colmap(tmp_path)
    (tmp_path / "points3D.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"no points3D\.bin or points3D\.txt.*cameras\.txt"):
        read_colmap(tmp_path)


def test_points_without_tracks_may_come_from_any_image(tmp_path, colmap_text):
    colmap_text(tmp_path)
    (tmp_path / "points3D.txt").write_text("10 0.5 -1.5 2.25 255 0 17 0.5 3 0\n11 -4 8 0.125 1 2 3 0.25\n")
    assert read_colmap(tmp_path).seen_by() == {"a b.png", "b.png", "c.png"}


@pytest.mark.parametrize("number", range(len(CAMERA_MODELS)), ids=lambda number: CAMERA_MODELS[number].name)
def test_every_camera_model_is_parsed(tmp_path, number):
    model = CAMERA_MODELS[number]
    parameters = tuple(range(1, model.parameters + 1))
    data = struct.pack("<QiiQQ", 1, 4, number, 10, 20) + struct.pack(f"<{model.parameters}d", *parameters)
    (tmp_path / "cameras.bin").write_bytes(data)
    (camera,) = READERS["cameras"][".bin"](tmp_path / "cameras.bin").values()
    assert camera.distortion == parameters[-model.distortion :] * bool(model.distortion)
    if model.fisheye:
        with pytest.raises(ValueError, match="Undistort"):
            camera.at(np.eye(4))
    else:
        pinhole = camera.at(np.eye(4))
        assert (pinhole.fx, pinhole.fy) == (1, model.focal_lengths)
        assert (pinhole.cx, pinhole.cy) == (model.focal_lengths + 1, model.focal_lengths + 2)


def test_unknown_camera_model(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 4, 99, 10, 20, 1, 1, 1, 1))
    with pytest.raises(ValueError, match="unknown camera model 99"):
        READERS["cameras"][".bin"](tmp_path / "cameras.bin")


def test_frames_have_the_pinhole_part_and_the_distortion(tmp_path, colmap_binary):
    colmap_binary(tmp_path / "sparse")
    for name in ("a b.png", "b.png", "c.png"):
        (tmp_path / name).touch()
    frames = colmap_frames(read_colmap(tmp_path / "sparse"), tmp_path)
    assert [frame.name for frame in frames] == ["a b.png", "b.png", "c.png"]
    assert [frame.distortion for frame in frames] == [(0.125,), (), ()]
    assert frames[1].camera.world_to_camera.dtype == torch.float64
    assert frames[1].path == tmp_path / "b.png"


@pytest.mark.data
@pytest.mark.parametrize(
    "folder", ["fern/sparse_3views", "fountain/sparse", "fountain/sparse_3near", "herz-jesu/sparse_3views"]
)
def test_points_project_onto_their_features(data_root, folder):
    """The features and their points as pycolmap reads them, the cameras as they are read here."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    model, theirs = read_colmap(data_root / folder / "0"), pycolmap.Reconstruction(data_root / folder / "0")
    errors = []
    for image in model.images:
        camera = model.cameras[image.camera_id].at(image.world_to_camera)
        features = [x for x in theirs.images[image.id].points2D if x.has_point3D()]
        world = torch.from_numpy(np.stack([theirs.points3D[x.point3D_id].xyz for x in features]))
        x, y, z = (world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
        assert (z > 0).all()
        projected = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
        errors.append((projected - torch.from_numpy(np.stack([x.xy for x in features]))).norm(dim=1))
    # A shift by half a pixel, the likeliest mistake of convention, would show.
    assert torch.cat(errors).median() < 0.25
