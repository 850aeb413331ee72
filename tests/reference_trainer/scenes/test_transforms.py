from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from reference_trainer.scenes import SceneOptions, load_scene
from reference_trainer.scenes.colmap import colmap_frames, read_colmap
from reference_trainer.scenes.frames import load_view
from reference_trainer.scenes.transforms import read_transforms


def rewrite(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_frames_follow_the_file(blender_scene):
    frames = read_transforms(blender_scene / "transforms_train.json")
    assert [frame.name for frame in frames] == ["train/r_0", "train/r_1", "train/r_2"]
    camera = frames[1].camera
    # Half the field of view has tangent 1/2, so the focal length is the width.
    assert (camera.width, camera.height, camera.cx, camera.cy) == (8, 6, 4, 3)
    assert camera.fx == pytest.approx(8)
    assert camera.fy == pytest.approx(8)
    assert camera.position.tolist() == [0, 0, 5]
    assert camera.forward.tolist() == [0, 0, -1]


def test_a_byte_order_mark_is_no_part_of_the_file(blender_scene):
    path = blender_scene / "transforms_train.json"
    expected = read_transforms(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert [frame.name for frame in read_transforms(path)] == [frame.name for frame in expected]


def test_opengl_points_land_where_they_should(blender_scene):
    # A point to the right of and above the optical axis, in OpenGL terms, is in the upper right quarter of the picture.
    camera = read_transforms(blender_scene / "transforms_train.json")[0].camera
    x, y, z, _ = (camera.world_to_camera @ torch.tensor([1.0, 0.5, 0.0, 1.0], dtype=torch.float64)).tolist()
    assert (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy) == (pytest.approx(6), pytest.approx(2))


def test_intrinsics_in_pixels_win_over_the_angle(blender_scene):
    path = blender_scene / "transforms_train.json"
    rewrite(path, lambda c: c.update(w=80, h=60, fl_x=90.0, fl_y=91.0, cx=41.0, cy=29.0))
    camera = read_transforms(path)[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (80, 60, 90, 91, 41, 29)


def test_a_focal_length_without_a_size_is_for_the_picture_of_the_file(blender_scene):
    """The same camera with pictures of half the size beside them."""
    path, half = blender_scene / "transforms_train.json", blender_scene / "half"
    rewrite(path, lambda c: c.update(fl_x=8.0))
    half.mkdir()
    for picture in (blender_scene / "train").iterdir():
        with Image.open(picture) as image:
            image.resize((4, 3)).save(half / picture.name)
    views = [load_view(read_transforms(path, name)[0], background=torch.zeros(3)) for name in (None, "half")]
    assert [(view.camera.width, view.camera.fx) for view in views] == [(8, 8), (4, 4)]


def test_extension_may_be_given_and_dots_may_be_in_names(blender_scene):
    path = blender_scene / "transforms_train.json"
    (blender_scene / "train" / "r_1.png").rename(blender_scene / "train" / "r.1.png")
    rewrite(path, lambda c: c["frames"][0].update(file_path="train/r_0.png"))
    rewrite(path, lambda c: c["frames"][1].update(file_path="train/r.1"))
    frames = read_transforms(path)
    assert [frame.path.name for frame in frames] == ["r_0.png", "r.1.png", "r_2.png"]
    assert [frame.name for frame in frames] == ["train/r_0", "train/r.1", "train/r_2"]


def test_paths_may_have_been_written_on_windows(blender_scene):
    path = blender_scene / "transforms_train.json"
    expected = read_transforms(path)
    rewrite(path, lambda c: [frame.update(file_path=frame["file_path"].replace("/", "\\")) for frame in c["frames"]])
    assert "\\\\" in path.read_text()
    found = read_transforms(path)
    assert [(frame.name, frame.path) for frame in found] == [(frame.name, frame.path) for frame in expected]


def test_paths_may_be_absolute_and_without_the_extension_of_a_jpeg(blender_scene):
    path = blender_scene / "transforms_train.json"
    pictures = blender_scene / "train"
    (pictures / "r_1.png").rename(pictures / "r_1.JPG")
    (pictures / "r_2.png").rename(pictures / "r_2.jpg")
    rewrite(path, lambda c: c["frames"][0].update(file_path=str(pictures / "r_0")))
    rewrite(path, lambda c: c["frames"][1].update(file_path="train/r_1.JPG", mask_path=str(pictures / "r_0.png")))
    frames = read_transforms(path)
    assert [frame.path.name for frame in frames] == ["r_0.png", "r_1.JPG", "r_2.jpg"]
    assert [frame.name for frame in frames] == ["train/r_0", "train/r_1", "train/r_2"]
    assert frames[1].mask == pictures / "r_0.png"


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_radial_models_are_opencvs(blender_scene, model):
    path = blender_scene / "transforms_train.json"
    rewrite(path, lambda c: c.update(camera_model=model, k1=0.05))
    assert read_transforms(path)[0].distortion == (0.05, 0, 0, 0, 0)


def test_a_scene_without_a_photograph_is_refused_as_that(blender_scene):
    rewrite(blender_scene / "transforms_test.json", lambda c: c.update(frames=[]))
    options = SceneOptions(str(blender_scene), points="random:5")
    assert load_scene(options).test == ()
    rewrite(blender_scene / "transforms_train.json", lambda c: c.update(frames=[]))
    with pytest.raises(ValueError, match="no photograph"):
        load_scene(options)


def test_without_test_views_no_file_of_them_is_needed(blender_scene):
    (blender_scene / "transforms_test.json").unlink()
    options = SceneOptions(str(blender_scene), points="random:5", test="none")
    assert len(load_scene(options).train) == 3
    with pytest.raises(FileNotFoundError, match=r"transforms_test\.json"):
        load_scene(replace(options, test="auto"))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c: c.pop("frames"), "no entry 'frames'"),
        (lambda c: c.pop("camera_angle_x"), "no entry 'camera_angle_x'"),
        (lambda c: c.update(camera_angle_x=math.pi), "camera_angle_x must be"),
        (lambda c: c.update(frames=3), "valid transforms file"),
        (lambda c: c.update(applied_transform=3), "valid transforms file"),
        (lambda c: c["frames"].append(5), "valid transforms file"),
        (lambda c: c["frames"].append(c["frames"][0]), "lists an image twice"),
        (lambda c: c["frames"][0].update(file_path="../../etc/x"), "leads out"),
        (lambda c: c["frames"][0].update(file_path="..\\..\\etc\\x"), "leads out"),
        (lambda c: c["frames"][0].update(file_path="/etc/x"), "leads out"),
        (lambda c: c["frames"][0].update(mask_path="../mask.png"), "leads out"),
        (lambda c: c["frames"][0].update(mask_path=3), "valid transforms file"),
        (lambda c: c["frames"][0].update(transform_matrix=[[1, 0], [0, 1]]), "finite 4x4"),
        (lambda c: c["frames"][0].update(transform_matrix=np.diag([2, 2, 2, 1]).tolist()), "no rotation"),
        (lambda c: c["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "no rotation"),
        (lambda c: c["frames"][0].update(transform_matrix="eye"), "valid transforms file"),
    ],
)
def test_bad_files_are_refused_with_their_path(blender_scene, change, reason):
    path = blender_scene / "transforms_train.json"
    rewrite(path, change)
    with pytest.raises(ValueError, match=reason) as caught:
        read_transforms(path)
    assert str(path) in str(caught.value)


def test_missing_files(blender_scene):
    with pytest.raises(FileNotFoundError, match="no file"):
        read_transforms(blender_scene / "transforms_val.json")
    (blender_scene / "train" / "r_1.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"r_1\.png"):
        read_transforms(blender_scene / "transforms_train.json")
    (blender_scene / "transforms_test.json").write_text("{")
    with pytest.raises(ValueError, match="valid transforms file"):
        read_transforms(blender_scene / "transforms_test.json")


@pytest.mark.data
def test_blender_and_colmap_files_describe_the_same_cameras(data_root):
    root = data_root / "fountain"
    blender = {
        frame.path.stem: frame
        for kind in ("train", "test")
        for frame in read_transforms(root / "blender" / f"transforms_{kind}.json")
    }
    for frame in colmap_frames(read_colmap(root / "sparse" / "0"), root / "images"):
        twin = blender.pop(frame.path.stem)
        torch.testing.assert_close(twin.camera.world_to_camera, frame.camera.world_to_camera, atol=1e-6, rtol=0)
        assert (twin.camera.fx, twin.camera.cx) == (frame.camera.fx, frame.camera.cx)
    assert not blender
