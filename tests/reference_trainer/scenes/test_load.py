from __future__ import annotations

import dataclasses
import json
import math
import re

import numpy as np
import pytest
import torch
from PIL import Image

from reference_trainer.scenes import load_scene
from reference_trainer.scenes.colmap import COLMAP, colmap_frames, read_colmap
from reference_trainer.scenes.formats import find_reader
from reference_trainer.scenes.numpy_formats import LLFF
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.transforms import BLENDER
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import make_plan


@pytest.fixture
def photo_scene(tmp_path, colmap_text, save_image):
    """A COLMAP scene of three photographs in two sizes; its points come from b.png and c.png."""
    root = tmp_path / "garden"
    colmap_text(root / "sparse" / "0")
    rng = np.random.default_rng(0)
    for name in ("a b", "b", "c"):
        pixels = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        save_image(root / "images" / f"{name}.png", pixels)
        save_image(root / "images_4" / f"{name}.png", pixels[::4, ::4].copy())
    (root / "split.json").write_text(json.dumps({"train": ["b.png", "c.png"], "test": ["a b.png"]}))
    return root


def test_photographs_without_a_camera_are_named_also_in_folders_of_their_cameras(photo_scene, save_image):
    (photo_scene / "split.json").unlink()
    options = SceneOptions(photo_scene, images="images", points="random:5", test="none")
    assert "no camera" not in str(load_scene(options))
    (photo_scene / "images").rename(photo_scene / "moved")
    (photo_scene / "images").mkdir()
    (photo_scene / "moved").rename(photo_scene / "images/left")
    (listed := photo_scene / "sparse/0/images.txt").write_text(
        re.sub(r"^(\S+ (?:\S+ ){7}\d+) (.*png)$", r"\1 left/\2", listed.read_text(), flags=re.MULTILINE)
    )
    assert "no camera" not in str(load_scene(options))
    save_image(photo_scene / "images/left/new.png", np.zeros((48, 64, 3), np.uint8))
    assert "not used: new.png" in str(load_scene(options))


def test_cameras_in_coordinates_of_a_map_are_refused(photo_scene):
    """In single precision some would share a place: 5,000 kilometers in meters are known to half a meter."""
    names = ("a b.png", "b.png", "c.png")
    lines = [f"{i} 1 0 0 0 {-5e6 - i / 4} 0 4 {7 - 6 * (i > 0)} {name}\n\n" for i, name in enumerate(names)]
    (photo_scene / "sparse/0/images.txt").write_text("".join(lines))
    with pytest.raises(ValueError, match="from the origin"):
        load_scene(SceneOptions(photo_scene, points="random:5"))


@pytest.mark.parametrize(("scale", "share"), [(1.0, 0), (0.06, 0.25), (0.01, 1)])
def test_a_world_before_the_near_plane_is_named(photo_scene, scale, share):
    """Nothing nearer than 0.2 is rendered; a quarter of these points lie at 3, the others at 4 times the scale."""
    names = ("a b.png", "b.png", "c.png")
    lines = [f"{i} 1 0 0 0 {-scale * i / 4} 0 {4 * scale} 1 {name}\n\n" for i, name in enumerate(names)]
    points = [f"{i} {i * scale / 9} 0 {-scale * (i == 0)} 9 9 9 0.1 0 0 1 0 2 0\n" for i in range(4)]
    (photo_scene / "sparse/0/images.txt").write_text("".join(lines))
    (photo_scene / "sparse/0/points3D.txt").write_text("".join(points))
    options = SceneOptions(photo_scene, points="sparse/0", test="none")
    if share > 0.5:
        with pytest.raises(ValueError, match="100% of the"):
            load_scene(options)
        load_scene(options, trains=False)
    else:
        assert ("25% of the" in str(load_scene(options))) == (share > 0)


def test_colmap_scene(photo_scene):
    scene = load_scene(SceneOptions(photo_scene, points="sparse/0", undistort=False))
    assert "is left in" in str(scene)
    assert scene.name == "garden"
    assert [view.name for view in scene.train] == ["b.png", "c.png"]
    assert [view.name for view in scene.test] == ["a b.png"]
    assert scene.background.tolist() == [0, 0, 0]
    assert len(scene.points.positions) == 2
    b = scene.train[0]
    assert b.image.shape == (3, 48, 64)
    assert b.image.dtype == b.camera.world_to_camera.dtype == scene.points.positions.dtype == torch.float32
    assert b.alpha is None
    # The camera file of "a b.png" is for 32x24, the picture is 64x48.
    a = scene.test[0].camera
    assert (a.width, a.height, a.fx, a.cx, a.cy) == (64, 48, 80, 32, 24)


def test_image_folder_and_downscale(photo_scene):
    quarter = load_scene(SceneOptions(photo_scene, images="images_4", points="random:5")).train[0]
    assert quarter.image.shape == (3, 12, 16)
    assert quarter.camera.fx == pytest.approx(50.5 / 4)
    half = load_scene(SceneOptions(photo_scene, downscale=2, points="random:5")).train[0]
    assert half.image.shape == (3, 24, 32)
    assert half.camera.fx == pytest.approx(50.5 / 2)
    for file in (photo_scene / "images").iterdir():
        file.unlink()
    (photo_scene / "images").rmdir()
    assert load_scene(SceneOptions(photo_scene, points="random:5")).train[0].image.shape == (3, 12, 16)


@pytest.mark.parametrize("place", ["sparse", "."])
@pytest.mark.parametrize("format", ["auto", "colmap"])
def test_a_reconstruction_beside_its_usual_place(photo_scene, place, format):
    expected = load_scene(SceneOptions(photo_scene, points="random:5"))
    for file in (photo_scene / "sparse" / "0").iterdir():
        file.rename(photo_scene / place / file.name)
    (photo_scene / "sparse" / "0").rmdir()
    found = load_scene(SceneOptions(photo_scene, format=format, points="random:5"))
    assert [view.name for view in found.train] == [view.name for view in expected.train]
    assert torch.equal(found.test[0].camera.world_to_camera, expected.test[0].camera.world_to_camera)
    with pytest.raises(ValueError, match="have seen"):
        load_scene(SceneOptions(photo_scene, points=place, views=1, split="llff"))


def test_a_folder_of_pictures_that_is_not_there(photo_scene):
    with pytest.raises(FileNotFoundError, match=r"no folder .*images_8; .*\['images', 'images_4'\]"):
        load_scene(SceneOptions(photo_scene, images="images_8"))


def test_a_scene_says_what_a_user_checks_first(photo_scene, blender_scene):
    assert str(load_scene(SceneOptions(photo_scene, images="images_4", points="random:5"))).splitlines()[:3] == [
        f"photographs: {photo_scene / 'images_4'}, used at 16x12 pixels",
        "2 training views: b.png, c.png",
        "1 test view: a b.png",
    ]
    scene = load_scene(SceneOptions(blender_scene))
    about = str(scene).splitlines()[0]
    assert f"{blender_scene / 'test'}, {blender_scene / 'train'}" in about
    assert "8x6 pixels" in about
    many = dataclasses.replace(scene, train=scene.train * 5, test=())
    assert str(many).splitlines()[1:3] == [f"15 training views: {'train/r_0, train/r_1, train/r_2, ' * 3}train/r_0, "
                                          "train/r_1, ..., train/r_2", "0 test views"]  # fmt: skip


def test_points_that_saw_test_views_are_refused(photo_scene):
    (photo_scene / "split.json").write_text(json.dumps({"train": ["a b.png", "b.png"], "test": ["c.png"]}))
    with pytest.raises(ValueError, match=r"1 image .*: c\.png"):
        load_scene(SceneOptions(photo_scene, points="sparse/0"))
    assert load_scene(SceneOptions(photo_scene, points="sparse/0", allow_test_points=True)).points.seen_by == {
        "b.png",
        "c.png",
    }


def test_auto_points_come_from_training_views_or_are_random(photo_scene, colmap_binary):
    colmap_binary(photo_scene / "sparse_2views" / "0")
    cloud = load_scene(SceneOptions(photo_scene)).points
    assert cloud.source.endswith("sparse_2views/0")
    (photo_scene / "split.json").write_text(json.dumps({"train": ["a b.png", "b.png"], "test": ["c.png"]}))
    assert load_scene(SceneOptions(photo_scene, points="auto")).points.source == "random"


def test_random_points_follow_the_seed(photo_scene):
    one, two, three = (
        load_scene(SceneOptions(photo_scene, points="random:7"), seed=seed).points.positions for seed in (0, 0, 1)
    )
    assert one.shape == (7, 3)
    assert torch.equal(one, two)
    assert not torch.equal(one, three)


def test_blender_scene_is_composited_before_resizing(blender_scene):
    scene = load_scene(SceneOptions(blender_scene, downscale=2))
    assert [view.name for view in scene.train] == ["train/r_0", "train/r_1", "train/r_2"]
    assert [view.name for view in scene.test] == ["test/r_0", "test/r_1"]
    assert scene.background.tolist() == [1, 1, 1]
    view = scene.train[0]
    assert (view.camera.width, view.camera.height) == (4, 3)
    assert view.camera.fx == pytest.approx(4)
    pixels = np.asarray(Image.open(blender_scene / "train" / "r_0.png")).astype(np.float32) / 255
    for background, base in (("white", 1.0), ("black", 0.0)):
        composed = pixels[..., :3] * pixels[..., 3:] + base * (1 - pixels[..., 3:])
        expected = np.stack(
            [np.asarray(Image.fromarray(composed[..., i]).resize((4, 3), Image.Resampling.BICUBIC)) for i in range(3)]
        )
        got = load_scene(SceneOptions(blender_scene, downscale=2, background=background)).train[0].image
        assert np.abs(got.numpy() - expected.clip(0, 1)).max() < 1e-6
    alpha = np.asarray(Image.fromarray(pixels[..., 3]).resize((4, 3), Image.Resampling.BICUBIC))
    assert np.abs(view.alpha.numpy() - alpha.clip(0, 1)).max() < 1e-6


def test_blender_random_points_fill_the_box(blender_scene):
    positions = load_scene(SceneOptions(blender_scene, points="random:2000")).points.positions
    assert positions.abs().max() <= 1.3
    assert positions.abs().amax(0).min() > 1.25


def test_llff_scene(photo_scene):
    rows = []
    for i in range(3):
        matrix = np.zeros((3, 5))
        matrix[:, :3] = np.stack([[0, 1, 0], [1, 0, 0], [0, 0, -1]], axis=1)  # down, right, back of a camera along +z
        matrix[:, 3] = [i, 0, 0]
        matrix[:, 4] = [480, 640, 500]
        rows.append([*matrix.ravel(), 2.0, 10.0])
    np.save(photo_scene / "poses_bounds.npy", np.array(rows))
    scene = load_scene(SceneOptions(photo_scene, format="llff", points="random:1000", split="split"))
    assert scene.train[0].camera.fx == pytest.approx(50)
    assert scene.train[1].camera.position.tolist() == [2, 0, 0]
    depth = scene.points.positions[:, 2]
    assert depth.min() >= 1.999
    assert depth.max() <= 10.001
    assert depth.max() > 8
    assert depth.min() < 2.2


def test_synthetic_scene_by_name():
    scene = load_scene(SceneOptions("synthetic", downscale=8, views=4))
    assert scene.name == "synthetic"
    assert len(scene.train) == 4
    assert scene.train[0].image.shape == (3, 15, 20)


def test_detect_format(photo_scene, blender_scene, tmp_path):
    assert find_reader(photo_scene, "auto") is COLMAP.read
    assert find_reader(blender_scene, "auto") is BLENDER.read
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    with pytest.raises(ValueError, match=r"none of transforms_train\.json.*notes\.txt"):
        find_reader(tmp_path / "other", "auto")
    (tmp_path / "other" / "poses_bounds.npy").touch()
    assert find_reader(tmp_path / "other", "auto") is LLFF.read
    with pytest.raises(FileNotFoundError, match="say 'synthetic'"):
        find_reader(tmp_path / "none", "auto")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"format": "nerf"}, "format must be"),
        ({"background": "green"}, "background must be"),
        ({"downscale": 0.5}, "downscale must be"),
        ({"downscale": math.nan}, "downscale .*finite number of at least 1, got nan"),
        ({"views": 0}, "views must be"),
        ({"views": 5}, "set of 5 views"),
        ({"split": "other"}, r"no split 'other'; choose auto, llff, dtu or a JSON file of the scene: \['split'\]"),
        ({"images": "pictures"}, "no folder"),
        ({"points": "sparse/1"}, r"choose auto, random, a \.ply or one of \['sparse/0'\]"),
        ({"points": "sparse"}, r"no COLMAP model in .*sparse; choose .* one of \['sparse/0'\]"),
        ({"points": "../sparse/0"}, "leads out"),
        ({"points": "random:many"}, "random:<count>"),
        ({"points": "cloud.ply"}, "no point cloud"),
    ],
)
def test_options_that_make_no_sense(photo_scene, options, reason):
    with pytest.raises((ValueError, FileNotFoundError), match=reason):
        load_scene(SceneOptions(photo_scene, **{"points": "sparse/0"} | options))


def test_options_without_use_are_refused(blender_scene):
    with pytest.raises(ValueError, match=r"no use for \{'images': 'x'\}"):
        load_scene(SceneOptions(blender_scene, images="x"))
    with pytest.raises(ValueError, match=r"no use for \{'split': 'llff'\}"):
        load_scene(SceneOptions("synthetic", split="llff"))


def test_pictures_of_another_shape_are_refused(photo_scene, save_image):
    for name in ("a b", "b", "c"):
        save_image(photo_scene / "images_3" / f"{name}.png", np.zeros((40, 40, 3), np.uint8))
    with pytest.raises(ValueError, match=r"40x40 .*64x48"):
        load_scene(SceneOptions(photo_scene, images="images_3", points="sparse/0"))


def test_photographs_that_cannot_be_read_are_named(photo_scene):
    """`plan` prints the notes, and loads what `train` would."""
    (photo_scene / "images" / "d.heic").write_bytes(b"ftypheic")
    assert any("not read: d.heic" in note for note in load_scene(SceneOptions(photo_scene, points="random:5")).notes)
    cut = photo_scene / "images" / "b.png"
    Image.open(cut).save(cut, "JPEG")
    cut.write_bytes(cut.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"b\.png .*readable"):
        load_scene(SceneOptions(photo_scene, points="random:5"))


@pytest.mark.data
def test_fern(data_root):
    scene = load_scene(SceneOptions(data_root / "fern", images="images_16"))
    assert [view.name for view in scene.train] == ["image001.png", "image010.png", "image019.png"]
    assert [view.name for view in scene.test] == ["image000.png", "image008.png", "image016.png"]
    camera = scene.train[0].camera
    assert scene.train[0].image.shape == (3, camera.height, camera.width) == (3, 189, 252)
    assert scene.points.source.endswith("sparse_3views_dense/0")
    assert len(scene.points.positions) == 15_000
    with pytest.raises(ValueError, match="the training split"):
        load_scene(SceneOptions(data_root / "fern", images="images_16", points="sparse/0"))
    by_rule = load_scene(SceneOptions(data_root / "fern", images="images_16", split="llff", format="llff"))
    assert [view.name for view in by_rule.train] == [view.name for view in scene.train]


@pytest.mark.data
@pytest.mark.parametrize(
    ("scene", "split", "train", "points"),
    [
        ("fountain", "auto", ["0001.jpg", "0005.jpg", "0010.jpg"], "sparse_3views/0"),
        ("fountain", "split_near", ["0001.jpg", "0003.jpg", "0005.jpg"], "sparse_3near/0"),
        ("herz-jesu", "auto", ["0001.jpg", "0004.jpg", "0007.jpg"], "sparse_3views/0"),
        ("herz-jesu", "split_near", ["0002.jpg", "0004.jpg", "0006.jpg"], "sparse_3near/0"),
        ("sceaux", "auto", ["7102.jpg", "7104.jpg", "7106.jpg"], "sparse_3views_dense/0"),
        ("cape", "auto", ["5923.jpg", "5929.jpg", "5934.jpg"], "sparse_3views_dense/0"),
    ],
)
def test_splits_find_their_own_points(data_root, scene, split, train, points):
    images = "images_2" if (data_root / scene / "images_2").is_dir() else None
    loaded = load_scene(SceneOptions(data_root / scene, images=images, split=split), trains=False)
    assert [view.name for view in loaded.train] == train
    assert loaded.points.source.endswith(points)


@pytest.mark.data
@pytest.mark.parametrize("name", ["sceaux", "cape"])
def test_a_scene_goes_through_plan_without_a_word_of_explanation(data_root, name):
    scene = load_scene(SceneOptions(data_root / name))
    assert len(scene.points.positions) == 10_000
    assert make_plan(scene, TrainConfig(dropout=0.2)).rows()
    masks = [view.mask for view in (*scene.train, *scene.test)]
    if name == "sceaux":
        assert [view.name for view in scene.test] == [f"{i}.jpg" for i in (7101, 7103, 7105, 7108)]
        assert masks == [None] * 7
    else:
        assert len(scene.test) == 8
        assert all(0.01 < float(mask.mean()) < 0.9 for mask in masks)
        assert any("what is white" in note for note in scene.notes)


@pytest.fixture
def cape(data_root, tmp_path):
    """The cape as transforms.json says it, whose names are paths without extension."""
    source, root = data_root / "cape", tmp_path / "cape"
    root.mkdir()
    for name in ("images", "split.json", "sparse", "sparse_3views_dense"):
        (root / name).symlink_to(source / name)
    entries = []
    for frame in colmap_frames(read_colmap(source / "sparse" / "0"), source / "images"):
        pose, camera = np.linalg.inv(frame.camera.world_to_camera.numpy()), frame.camera
        pose[:, 1:3] *= -1  # OpenCV's axes to OpenGL's
        entries.append(
            {"file_path": f"images/{frame.name}", "transform_matrix": pose.tolist(), "fl_x": camera.fx,
             "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height}
        )  # fmt: skip
    (root / "transforms.json").write_text(json.dumps({"frames": entries}))
    return root


@pytest.mark.data
def test_the_honest_points_of_a_scene_are_honest_in_every_format(cape):
    scene = load_scene(SceneOptions(cape, format="transforms"))
    assert [view.name for view in scene.train] == ["images/5923", "images/5929", "images/5934"]
    assert scene.points.source.endswith("sparse_3views_dense/0")
    assert len(scene.points.positions) == 10_000
    with pytest.raises(ValueError, match="the training split"):
        load_scene(SceneOptions(cape, format="transforms", points="sparse/0"))


@pytest.mark.data
def test_points_have_the_colors_of_the_pictures(data_root):
    """Independent of any file but the photographs: projected points fall on pixels of their own color."""
    scene = load_scene(SceneOptions(data_root / "fern", images="images_16"))
    view = scene.train[1]
    camera, points = view.camera, scene.points
    x, y, z = (points.positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
    grid = torch.stack(
        [2 * (camera.fx * x / z + camera.cx) / 252 - 1, 2 * (camera.fy * y / z + camera.cy) / 189 - 1], 1
    )
    inside = (grid.abs() < 1).all(1)
    assert inside.float().mean() > 0.9
    sampled = torch.nn.functional.grid_sample(view.image[None], grid[None, None, inside], align_corners=False)[
        0, :, 0
    ].T
    error = (sampled - points.colors[inside]).abs().mean()
    shuffled = (sampled - points.colors[inside].flip(0)).abs().mean()
    assert error < 0.5 * shuffled


@pytest.mark.data
def test_lego(data_root):
    scene = load_scene(SceneOptions(data_root / "lego", downscale=4))
    assert [view.name for view in scene.train] == [f"train/r_{i}" for i in (2, 16, 26, 55, 73, 76, 86, 93)]
    assert [view.name for view in scene.test] == [f"test/r_{i}" for i in range(0, 200, 8)]
    view = scene.train[0]
    assert view.image[:, view.alpha == 0].min() > 0.99
    assert scene.points.source == "dense stereo"  # the scene brings no points
    assert (scene.points.positions.abs() < 1.3).all(1).float().mean() > 0.95  # where its author put the object
