"""Folders as other programs leave them, made by their descriptions; and a format that this package does not know."""

from __future__ import annotations

import json
import shutil
import sys

import numpy as np
import pytest
import torch

from reference_trainer.cli import main
from reference_trainer.scenes import SceneFormat, formats, load_scene, register_format
from reference_trainer.scenes.formats import find_reader
from reference_trainer.scenes.numpy_formats import IDR, read_idr
from reference_trainer.scenes.options import SceneOptions

PICTURES = ("a b.png", "b.png", "c.png")


@pytest.fixture
def photographs(tmp_path, save_image):
    """Three photographs without cameras."""
    rng = np.random.default_rng(0)
    for name in PICTURES:
        save_image(tmp_path / "images" / name, rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    return tmp_path


TOY = '''
import torch
from reference_trainer.camera import Camera
from reference_trainer.scenes import Capture, Frame

def read(root, options):
    """Cameras in a row that look along z; the toy's own file has their number and focal length."""
    count, focal = map(int, (root / "toy.txt").read_text().split())
    frames = []
    for i, path in enumerate(sorted((root / "images").iterdir())[:count]):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -0.2 * i
        frames.append(Frame(path.name, path, Camera(pose, focal, focal, 32.0, 24.0, 64, 48), bounds=(2.0, 5.0)))
    return Capture(frames)
'''


@pytest.mark.parametrize("how", ["by name", "registered"])
def test_a_format_of_the_users_own_trains(photographs, tmp_path, monkeypatch, how):
    (photographs / "toy.txt").write_text("3 60")
    (tmp_path / "toy_scene.py").write_text(TOY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS))
    arguments = ["--format", "toy_scene:read"]
    if how == "registered":
        scope: dict = {}
        exec(TOY, scope)
        register_format(SceneFormat("toy", "toy.txt", lambda root: (root / "toy.txt").is_file(), scope["read"]))
        arguments = []
        assert find_reader(photographs, "auto") is scope["read"]
    main(["train", "--path", str(photographs), "--out", str(tmp_path / "run"), "--iterations", "2", "--downscale", "4",
          "--points", "random:50", "--monitor-every", "0", *arguments])  # fmt: skip
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert sorted(results["mean"]) == ["around", "between", "train"]
    assert sum(view["split"] == "train" for view in results["views"]) == 3


def test_a_format_that_is_not_there(photographs):
    with pytest.raises(ValueError, match="name a function"):
        load_scene(SceneOptions(photographs, format="toy_scenes:read"))
    with pytest.raises(ValueError, match=r"no cameras .*`ca-reg poses "):
        load_scene(SceneOptions(photographs))


@pytest.mark.parametrize("place", ["sparse/0", "sparse", ".", "sparse_3/0"])
def test_few_photographs_all_train_from_whatever_points_there_are(photographs, colmap_text, place):
    # VGGT writes sparse/ without 0 and without tracks, InstantSplat sparse_3/0.
    colmap_text(photographs / place)
    (photographs / place / "points3D.txt").write_text("10 0.5 -1.5 2.25 255 0 17 0.5\n11 -4 8 0.125 1 2 3 0.25\n")
    scene = load_scene(SceneOptions(photographs))
    assert [view.name for view in scene.train] == list(PICTURES)
    assert scene.test == ()
    assert scene.points.positions[:2].tolist() == [[0.5, -1.5, 2.25], [-4, 8, 0.125]]
    every = load_scene(SceneOptions(photographs, views=3))  # as many as there are: none is left to hold out
    assert ([view.name for view in every.train], every.test) == (list(PICTURES), ())
    held_out = load_scene(SceneOptions(photographs, views=2))
    assert (len(held_out.train), len(held_out.test)) == (2, 1)
    assert held_out.points.source == "random"
    assert "do not train" in str(held_out)
    assert len(load_scene(SceneOptions(photographs, views=2, test="none")).train) == 2


@pytest.mark.parametrize(
    ("kind", "values", "colors"),
    [
        ("uchar", (255, 0, 51), (1.0, 0.0, 0.2)),
        ("float", (1.0, 0.0, 0.2), (1.0, 0.0, 0.2)),
        ("float", (255.0, 0.0, 51.0), (1.0, 0.0, 0.2)),
        ("f_dc", (0.5 / 0.28209479177387814, 0.0, -9.0), (1.0, 0.5, 0.0)),
        ("none", (), (0.5, 0.5, 0.5)),
    ],
)
def test_instantsplat_and_the_colors_of_point_clouds(photographs, colmap_text, kind, values, colors):
    folder = photographs / "sparse_3" / "0"
    colmap_text(folder)
    (folder / "points3D.txt").unlink()
    names = ["f_dc_0", "f_dc_1", "f_dc_2"] if kind == "f_dc" else ["red", "green", "blue"][: len(values)]
    kinds = {"x": "float", "y": "float", "z": "float"} | dict.fromkeys(names, "uchar" if kind == "uchar" else "float")
    head = "".join(f"property {each} {name}\n" for name, each in kinds.items())
    row = " ".join(map(str, (1, 2, 3, *values)))
    (folder / "points3D.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{head}end_header\n{row}\n{row}\n")
    points = load_scene(SceneOptions(photographs)).points
    assert points.seen_by == set(PICTURES)
    assert points.positions[:2].tolist() == [[1, 2, 3]] * 2
    torch.testing.assert_close(points.colors[:2], torch.tensor([colors] * 2))


APPLIED = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2]])  # nerfstudio's, moved


@pytest.fixture
def nerfstudio(photographs):
    """Cameras at (i, 0, 0) looking along +z of the COLMAP world, written as nerfstudio writes them."""
    frames = []
    for i, name in enumerate(PICTURES):
        original = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
        original[0, 3] = i
        saved = np.vstack([APPLIED, [0, 0, 0, 1]]) @ original
        frames.append({"file_path": f"images/{name}", "transform_matrix": saved.tolist()})
    frames[1] |= {"fl_x": 60.0, "k1": 0.0}
    content = {
        "camera_model": "OPENCV", "fl_x": 50.0, "fl_y": 51.0, "cx": 33.0, "cy": 23.0, "w": 64, "h": 48, "k1": 0.1,
        "k2": 0.01, "p1": 0.001, "p2": 0.002, "applied_transform": APPLIED.tolist(), "ply_file_path": "sparse_pc.ply",
        "frames": frames[::-1],
    }  # fmt: skip
    x, y, z = APPLIED[:, :3] @ [1, 2, 3] + APPLIED[:, 3]
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    properties += "".join(f"property uint8 {name}\n" for name in ("red", "green", "blue"))
    (photographs / "sparse_pc.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n" + f"{x} {y} {z} 255 0 0\n" * 2
    )
    (photographs / "transforms.json").write_text(json.dumps(content))
    return photographs


def test_nerfstudio(nerfstudio):
    scene = load_scene(SceneOptions(nerfstudio, undistort=False))
    assert [view.name for view in scene.train] == ["images/a b", "images/b", "images/c"]
    assert [view.camera.position.tolist() for view in scene.train] == [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    assert scene.train[2].camera.forward.tolist() == [0, 0, 1]
    assert [view.camera.fx for view in scene.train] == [50, 60, 50]
    torch.testing.assert_close(scene.points.positions, torch.tensor([[1.0, 2, 3]] * 2))
    named = load_scene(
        SceneOptions(nerfstudio, points="./sparse_pc.ply")
    ).points  # in the world of the cameras, not of the file
    torch.testing.assert_close(named.positions, scene.points.positions)
    straight = load_scene(SceneOptions(nerfstudio))
    assert "lens distortion, up to" in str(straight)
    assert straight.train[0].camera.fx > 50
    assert not torch.equal(straight.train[0].image, scene.train[0].image)
    assert straight.train[0].camera.cx == 33


def test_points_that_are_not_there_are_no_obstacle_to_others(nerfstudio):
    (nerfstudio / "sparse_pc.ply").unlink()
    with pytest.raises(FileNotFoundError, match=r"transforms\.json .*sparse_pc\.ply, .*--points random"):
        load_scene(SceneOptions(nerfstudio))
    read = find_reader(nerfstudio, "auto")
    assert read(nerfstudio, SceneOptions(nerfstudio, points="random")).points is None


def _change(path, **entries):
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def test_the_lists_of_nerfstudio_split_its_scene(nerfstudio):
    path = nerfstudio / "transforms.json"
    _change(path, train_filenames=["images/c.png", "./images/a b.png"], val_filenames=["images/b.png"])
    with pytest.raises(ValueError, match=r"sparse_pc\.ply .*1 image .*: images/b\."):
        load_scene(SceneOptions(nerfstudio, points="sparse_pc.ply"))
    options = {"points": "sparse_pc.ply", "allow_test_points": True}
    scene = load_scene(SceneOptions(nerfstudio, **options))
    assert [view.name for view in scene.train] == ["images/a b", "images/c"]
    assert [view.name for view in scene.test] == ["images/b"]
    assert [view.name for view in load_scene(SceneOptions(nerfstudio, views=1, **options)).train] == ["images/a b"]
    assert len(load_scene(SceneOptions(nerfstudio, test="none")).train) == 3
    _change(path, test_filenames=["images/c.png"])
    with pytest.raises(ValueError, match=r"transforms\.json uses \['images/c'\] both .* --test none"):
        load_scene(SceneOptions(nerfstudio))
    (nerfstudio / "split.json").write_text('{"train": ["a b", "b"], "test": ["c"]}')  # one's own file counts first
    assert [view.name for view in load_scene(SceneOptions(nerfstudio, **options)).test] == ["images/c"]


def test_pictures_of_one_name_in_two_folders_are_told_apart(nerfstudio):
    path = nerfstudio / "transforms.json"
    content = json.loads(path.read_text())
    places = [f"images/{folder}/1.{number}.png" for folder, number in (("left", 0), ("left", 1), ("right", 0))]
    for frame, name, place in zip(content["frames"], PICTURES[::-1], places, strict=True):
        (nerfstudio / place).parent.mkdir(exist_ok=True)
        (nerfstudio / "images" / name).rename(nerfstudio / place)
        frame["file_path"] = place
    _change(path, **content | {"train_filenames": places[:2], "test_filenames": places[2:]})
    scene = load_scene(SceneOptions(nerfstudio, points="sparse_pc.ply", allow_test_points=True))
    assert [view.name for view in scene.train] == ["images/left/1.0", "images/left/1.1"]
    assert [view.name for view in scene.test] == ["images/right/1.0"]


def test_masks_of_nerfstudio(nerfstudio, save_image):
    """White on the left half, in the order of the file, which is not that of the scene."""
    path = nerfstudio / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][0]["mask_path"] = "masks\\c.png"
    _change(path, frames=content["frames"])
    with pytest.raises(FileNotFoundError, match=r"masks/c\.png"):
        load_scene(SceneOptions(nerfstudio))
    for white in (1, 255):
        save_image(nerfstudio / "masks" / "c.png", np.repeat(np.uint8([[white, 0]]), 32, axis=1).repeat(48, axis=0))
        scene = load_scene(SceneOptions(nerfstudio, undistort=False), trains=False)
        assert [view.mask is None for view in scene.train] == [True, True, False]
        assert scene.train[2].mask.equal((torch.arange(64) < 32).float().expand(48, 64))
        assert "what is white" in str(scene)
    save_image(nerfstudio / "masks" / "c.png", np.zeros((48, 48), np.uint8))  # of another crop
    with pytest.raises(ValueError, match=r"c\.png is 48x48, .*64x48"):
        load_scene(SceneOptions(nerfstudio, undistort=False))


@pytest.mark.parametrize(
    "change", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}, {"k4": 0.1}, {"applied_transform": [[0]]}]
)
def test_what_no_pinhole_stands_for_is_refused(nerfstudio, change):
    _change(nerfstudio / "transforms.json", **change)
    with pytest.raises(ValueError, match=r"transforms\.json"):
        load_scene(SceneOptions(nerfstudio))


def test_all_missing_pictures_are_counted(nerfstudio):
    for name in PICTURES[:2]:
        (nerfstudio / "images" / name).unlink()
    with pytest.raises(FileNotFoundError, match=r"2 images .*not there"):
        load_scene(SceneOptions(nerfstudio))


def test_no_folder_of_pictures(nerfstudio, colmap_text):
    (nerfstudio / "transforms.json").unlink()
    colmap_text(nerfstudio / "sparse")
    (nerfstudio / "images").rename(nerfstudio / "photos")
    with pytest.raises(FileNotFoundError, match=r"\['photos'\]: .*--images"):
        load_scene(SceneOptions(nerfstudio))
    assert len(load_scene(SceneOptions(nerfstudio, images="photos")).train) == 3


@pytest.mark.parametrize("subset", [False, True])
def test_idr(photographs, save_image, subset):
    rng = np.random.default_rng(1)
    arrays, expected = {}, {}
    shutil.rmtree(photographs / "images")
    for i in range(3):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.linalg.det(rotation)
        translation, sign = np.array([0.1, 0.2, 5.0 + i]), rng.choice([-1.0, 1.0])
        intrinsics = np.array([[60.0, 0, 30.5], [0, 62.0, 25.0], [0, 0, 1]])
        arrays[f"world_mat_{i}"] = np.eye(4)
        arrays[f"world_mat_{i}"][:3] = 7.0 * sign * intrinsics @ np.column_stack([rotation, translation])
        arrays[f"scale_mat_{i}"] = np.diag([2.0, 2.0, 2.0, 1.0])
        expected[f"{i:06}.png"] = rotation, translation
        if not (subset and i == 1):
            save_image(photographs / "image" / f"{i:06}.png", rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
            save_image(photographs / "mask" / f"{i:03}.png", np.full((48, 64), 255 * (i == 2), np.uint8))
    np.savez_compressed(photographs / "cameras_sphere.npz", **arrays)
    assert find_reader(photographs, "auto") is IDR.read
    frames = read_idr(photographs / "cameras_sphere.npz", photographs / "image")
    assert [frame.name for frame in frames] == [name for name in expected if not (subset and "1" in name)]
    for frame in frames:
        rotation, translation = expected[frame.name]
        assert np.allclose(frame.camera.world_to_camera[:3, :3], rotation, atol=1e-9)
        assert np.allclose(frame.camera.world_to_camera[:3, 3], translation, atol=1e-9)
        camera = frame.camera
        assert np.allclose([camera.fx, camera.fy, camera.cx, camera.cy], [60, 62, 30.5, 25])
        assert frame.bounds == pytest.approx((translation[2] - 2, translation[2] + 2))
    scene = load_scene(SceneOptions(photographs))
    assert [float(view.mask.mean()) for view in scene.train] == ([0, 1] if subset else [0, 0, 1])
    assert scene.test == ()


@pytest.mark.parametrize("bad", [b"", b"PK\x03\x04", b"not a zip"])
def test_bad_npz(photographs, bad):
    (photographs / "cameras_sphere.npz").write_bytes(bad)
    with pytest.raises(ValueError, match=r"cameras_sphere\.npz is not"):
        load_scene(SceneOptions(photographs))


@pytest.mark.parametrize("sphere", [np.eye(4)[0], np.eye(3), np.array(1.0)], ids=["a row", "3x3", "a number"])
def test_a_sphere_that_is_no_matrix_is_refused(photographs, sphere):
    arrays = {f"{kind}_mat_{i}": x for i in range(3) for kind, x in (("world", np.eye(4)), ("scale", sphere))}
    np.savez(photographs / "cameras_sphere.npz", **arrays)
    with pytest.raises(ValueError, match=r"scale_mat_0 .*\(4, 4\)"):
        load_scene(SceneOptions(photographs))


def test_large_photographs_are_reduced_and_it_is_said(photographs, colmap_text, save_image):
    colmap_text(photographs / "sparse")
    for name in PICTURES:
        save_image(photographs / "images" / name, np.zeros((900, 1200, 3), np.uint8))
    scene = load_scene(SceneOptions(photographs, points="random:5"))
    assert 490_000 < scene.pixels < 510_000
    assert "1200x900 are made smaller by 1.47" in str(scene)
    assert load_scene(SceneOptions(photographs, points="random:5", downscale=1)).pixels == 1_080_000
    for name in PICTURES:
        save_image(photographs / "images_2" / name, np.zeros((450, 600, 3), np.uint8))
    beside = load_scene(SceneOptions(photographs, points="random:5"))
    assert (beside.pixels, beside.source) == (270_000, str(photographs / "images_2"))


def test_nothing_held_out_of_any_format(blender_scene):
    assert load_scene(SceneOptions("synthetic", downscale=8, test="none")).test == ()
    scene = load_scene(SceneOptions(blender_scene, test="none"))
    assert (len(scene.train), scene.test) == (3, ())
    with pytest.raises(ValueError, match=r"test must .*auto"):
        load_scene(SceneOptions(blender_scene, test="some"))


@pytest.mark.data
@pytest.mark.parametrize("scan", ["dtu-scan65", "dtu-scan24"])
def test_dtu(data_root, scan):
    scene = load_scene(SceneOptions(data_root / scan, downscale=4))
    assert [view.name for view in scene.train] == ["000022.png", "000025.png", "000028.png"]
    by_rule = load_scene(SceneOptions(data_root / scan, downscale=4, split="dtu", points="random:10"))
    assert [view.name for view in by_rule.test] == [view.name for view in scene.test]
    colmap = load_scene(SceneOptions(data_root / scan, downscale=4, format="colmap", images="image"))
    for one, other in zip(scene.test, colmap.test, strict=True):
        torch.testing.assert_close(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-3, rtol=1e-5)
        assert one.camera.fx == pytest.approx(other.camera.fx, abs=1e-2)
    if scan == "dtu-scan65":  # the object's points lie on its mask
        camera, mask = by_rule.train[0].camera, by_rule.train[0].mask
        x, y, z = (scene.points.positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
        column, row = ((camera.fx * x / z + camera.cx).long(), (camera.fy * y / z + camera.cy).long())
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        assert mask[row[inside], column[inside]].mean() > 1.3 * mask.mean()
    else:
        assert scene.train[0].mask is None
