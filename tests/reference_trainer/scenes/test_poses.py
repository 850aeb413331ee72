"""Cameras of photographs that have none, held against the cameras that took them."""

from __future__ import annotations

import copy
import json
import re
import shlex
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from camera_errors import camera_errors
from PIL import Image
from scipy.spatial.transform import Rotation

from reference_trainer import cli
from reference_trainer.cli import main
from reference_trainer.scenes import load_scene, poses
from reference_trainer.scenes.colmap import read_colmap
from reference_trainer.scenes.images import image_folder, image_size
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.poses import find_poses, left_out


@pytest.fixture
def noise(tmp_path):
    """Three photographs without anything in common, and without a scale at which they have corners."""
    for i in range(3):
        pixels = np.random.default_rng(i).integers(0, 256, (90, 120, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{i}.png")
    return tmp_path


@pytest.mark.slow
@pytest.mark.data
def test_three_photographs_of_a_portal(data_root, tmp_path, capsys):
    pycolmap = pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    portal, photos = data_root / "herz-jesu", tmp_path / "photos"
    names = json.loads((portal / "split_near.json").read_text())["train_3"]
    photos.mkdir()
    for name in names:
        shutil.copy(portal / "images" / name, photos)

    main(["poses", str(photos)])
    said, shown = capsys.readouterr()
    assert all(f"{stage}: 100%" in shown and "| 3/3 [" in shown for stage in ("features", "matching"))
    assert f"3 of 3 photographs registered: {', '.join(names)}" in said
    assert f"ca-reg train {photos}" in said

    loaded = load_scene(SceneOptions(photos))
    true = {view.name: view.camera for view in load_scene(SceneOptions(portal, test="none"), trains=False).train}
    rotation, center = camera_errors([view.camera for view in loaded.train], [true[view.name] for view in loaded.train])
    # What COLMAP found of all photographs is the truth here; one pixel is 0.17 degrees. Three photographs determine
    # the focal length poorly, and a wrong one turns the cameras.
    assert rotation < 1
    assert center < 0.02
    assert len(loaded.points.positions) > 1000
    assert loaded.points.seen_by == set(names)

    # pycolmap reads the same from the files; cameras and features have the size of the photographs again.
    model, theirs = read_colmap(photos / "sparse/0"), pycolmap.Reconstruction(photos / "sparse/0")
    assert {(camera.width, camera.height) for camera in theirs.cameras.values()} == {(384, 256)}
    theirs.update_point_3d_errors()
    assert theirs.compute_mean_reprojection_error() < 0.5
    for image in model.images:
        other = theirs.images[image.id]
        assert other.name == image.name
        assert other.cam_from_world().matrix() == pytest.approx(image.world_to_camera[:3], abs=1e-12)
    assert sorted(p.xyz.tolist() for p in theirs.points3D.values()) == sorted(model.points.positions.tolist())


@pytest.mark.slow
@pytest.mark.data
def test_photographs_of_304_pixels_that_are_far_apart(data_root, tmp_path):
    """At their own size only two of these three are placed."""
    pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    cape = data_root / "cape"
    scene = load_scene(SceneOptions(cape, split="split", points="random:100"), trains=False)
    photos, again = tmp_path / "photos", tmp_path / "again"
    photos.mkdir()
    for view in scene.train:
        Image.open(cape / "images" / Path(view.name).name).save(photos / f"{Path(view.name).stem}.png")
    names = [path.name for path in sorted(photos.iterdir())]
    assert find_poses(photos).registered == tuple(names)
    true = {Path(view.name).stem: view.camera for view in scene.train}
    found = {Path(view.name).stem: view.camera for view in load_scene(SceneOptions(photos), trains=False).train}
    rotation, center = camera_errors([*found.values()], [true[name] for name in found])
    assert rotation < 1
    assert center < 0.02

    # The same photographs give the same cameras, and another folder gets copies of them.
    before = (photos / "sparse").rename(tmp_path / "before") / "0"
    assert find_poses(photos, again).registered == tuple(names)
    for file in before.iterdir():
        assert file.read_bytes() == (again / "sparse/0" / file.name).read_bytes(), file.name
    assert [path.name for path in sorted((again / "images").iterdir())] == names
    assert [path.name for path in sorted(photos.iterdir())] == names


@pytest.mark.slow
def test_photographs_with_nothing_in_common(noise):
    pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    with pytest.raises(ValueError, match="none of the 3 photographs"):
        find_poses(noise)
    assert sorted(path.name for path in noise.iterdir()) == ["0.png", "1.png", "2.png"]


def test_an_unknown_camera_model_is_answered_with_those_that_there_are(noise):
    with pytest.raises(ValueError, match=r"camera model 'opencv'; .*SIMPLE_PINHOLE, .*, OPENCV,"):
        find_poses(noise, camera="opencv")


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_that_colmap_cannot_take(noise, seed, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["poses", str(noise), "--seed", str(seed)])
    assert stop.value.code == 2
    assert capsys.readouterr().err.endswith(f"got {seed}.\n")


def test_without_pycolmap(noise, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SystemExit) as stop:
        main(["poses", str(noise)])
    assert stop.value.code == 2
    assert "pycolmap: pip install 'ca_reg[colmap]'" in capsys.readouterr().err


def test_photographs_without_cameras_are_told_how_to_get_them(noise, capsys):
    photos = noise.rename(noise.with_name("my photos"))
    with pytest.raises(SystemExit):
        main(["train", "--path", str(photos), "--out", str(photos / "run")])
    said = re.search(r"the photographs in (.*) have no cameras yet: `(.*)` finds them", capsys.readouterr().err)
    assert said is not None
    assert (said[1], shlex.split(said[2])) == (str(photos), ["ca-reg", "poses", str(photos)])


def cut_off(path):
    """Write a JPEG that ends in the middle, as an interrupted copy does; its header is whole."""
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)).save(path, "JPEG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def reconstruction():
    """Stand for what COLMAP finds of the photographs of `noise`."""
    return SimpleNamespace(
        images={i: SimpleNamespace(name=f"{i}.png", has_pose=True, camera_id=0) for i in range(3)},
        cameras={0: SimpleNamespace(mean_focal_length=lambda: 50.0)},
        num_reg_images=lambda: 3,
        num_points3D=lambda: 3,
        compute_mean_reprojection_error=lambda: 0.5,
        write_binary=lambda folder: None,
        reg_image_ids=lambda: [],
        update_point_3d_errors=lambda: None,
    )


def test_a_photograph_of_another_format_is_not_passed_over_in_silence(noise, monkeypatch):
    (noise / "IMG_3.HEIC").write_bytes(b"ftypheic")
    (noise / "1.heic").write_bytes(b"ftypheic")  # 1.png is the same photograph, exported
    monkeypatch.setattr(poses, "reconstruct", lambda *_: reconstruction())
    said = str(find_poses(noise))
    assert "3 of 4 photographs registered" in said
    assert re.search(r"left out: IMG_3\.HEIC: .*JPEG", said)


def test_photographs_that_cannot_be_read_are_left_out_and_all_are_named(noise, tmp_path, monkeypatch):
    """`ca-reg run` does so with the same folder; one that is cut short COLMAP would take for what is left of it."""
    cut_off(noise / "3.jpg")
    (noise / "4.png").write_text("no picture")
    given = []
    monkeypatch.setattr(poses, "reconstruct", lambda photos, *_: given.extend(photos) or reconstruction())
    found = find_poses(noise, tmp_path / "scene")
    assert [path.name for path in given] == ["0.png", "1.png", "2.png"]
    assert (found.left_out, {*found.unread}) == ((), {"3.jpg", "4.png"})
    assert re.search(
        r"^3 of 5 photographs .*3\.jpg .*truncated.*4\.png ",
        str(found),
        re.DOTALL,
    )
    assert sorted(path.name for path in (tmp_path / "scene/images").iterdir()) == ["0.png", "1.png", "2.png"]


def test_what_was_left_out_is_kept_beside_the_model(noise, monkeypatch):
    placed = reconstruction()
    placed.images.pop(2)
    monkeypatch.setattr(poses, "reconstruct", lambda *_: placed)
    cut_off(noise / "3.jpg")
    said = str(find_poses(noise)).splitlines()
    assert said[2].startswith("left out: 2.png. ")
    assert left_out(noise) == said[2:]
    assert len(said) == 4
    assert left_out(noise / "elsewhere") == []


def test_photographs_beside_an_empty_folder_images_are_found(noise, monkeypatch):
    (noise / "images").mkdir()
    monkeypatch.setattr(poses, "reconstruct", lambda *_: reconstruction())
    assert find_poses(noise).registered == ("0.png", "1.png", "2.png")
    assert image_folder(noise, None) == noise  # where a training looks for them


def test_what_only_colmap_cannot_read_is_left_out_too(noise, monkeypatch):
    pycolmap = pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    Image.new("RGB", (40, 30)).save(noise / "3.webp")
    for step in ("extract_features", "match_exhaustive"):
        monkeypatch.setattr(pycolmap, step, lambda *_, **__: None)
    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", lambda *_: SimpleNamespace(solve=lambda: None))
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_, **__: {0: reconstruction()})
    said = str(find_poses(noise))
    assert "3 of 4 photographs registered" in said
    assert re.search(r"left out: .*3\.webp, .*JPEG", said)


def test_small_photographs_are_enlarged_with_their_cameras(tmp_path):
    """What EXIF data tell of the focal length is enlarged with them; a large photograph stays as it is."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    photos, exif = [tmp_path / "a.jpg", tmp_path / "b.jpg"], Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 18  # focal length on 35 mm film: half the width of 36 mm
    for photo, size in zip(photos, ((400, 300), (1700, 1200)), strict=True):
        Image.new("RGB", size).save(photo, exif=exif)
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    for photo in photos:
        pycolmap.import_images(
            database, tmp_path, camera_mode=pycolmap.CameraMode.SINGLE, image_names=[photo.name],
            options=pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE"),
        )  # fmt: skip
    sizes = poses.enlarge(photos, database, tmp_path / "larger")
    assert [*sizes.values()] == [(400, 300)]
    assert [image_size(tmp_path / "larger" / photo.name) for photo in photos] == [(800, 600), (1700, 1200)]
    opened = pycolmap.Database.open(database)
    cameras = [opened.read_camera(opened.read_image_with_name(photo.name).camera_id) for photo in photos]
    opened.close()
    assert [camera.has_prior_focal_length for camera in cameras] == [True, True]
    assert [camera.width for camera in cameras] == [800, 1700]
    for camera in cameras:  # of 35 mm film COLMAP takes the diagonal
        assert camera.mean_focal_length() == pytest.approx(18 / 43.27 * np.hypot(camera.width, camera.height), rel=0.01)


def test_the_last_adjustment_is_robust():
    """A tenth of the features are off by 5 pixels, the others by 0.2, and least squares follow the tenth."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=4, num_points3D=150, camera_params=[1280.0, 512.0, 384.0],
        camera_model_id=pycolmap.CameraModelId.SIMPLE_PINHOLE,
    )  # fmt: skip
    model, rng = pycolmap.synthesize_dataset(options), np.random.default_rng(0)

    def rotations(of):
        axes = [image.cam_from_world().rotation.matrix() for _, image in sorted(of.images.items())]
        return Rotation.from_matrix(axes) * Rotation.from_matrix(axes[0]).inv()

    true, adjusted = rotations(model), []
    for image in model.images.values():
        for feature in image.points2D:
            feature.xy += rng.normal(0, 5 if rng.random() < 0.1 else 0.2, 2)
    for adjust in (pycolmap.bundle_adjustment, lambda of: poses.adjust(of, refine_focal_length=True)):
        adjust(other := copy.deepcopy(model))
        adjusted.append((rotations(other) * true.inv()).magnitude().max())
    assert adjusted[1] < adjusted[0] / 3


def test_two_photographs_must_remain(noise, monkeypatch):
    monkeypatch.setattr(poses, "reconstruct", lambda *_: pytest.fail("COLMAP was started"))
    cut_off(noise / "0.png")
    (noise / "1.png").write_text("no picture")
    with pytest.raises(ValueError, match=r"1 photograph .*at least 2.*0\.png .*1\.png "):
        find_poses(noise)


def test_the_folder_of_the_photographs_becomes_that_of_a_scene(noise, monkeypatch):
    monkeypatch.setattr(poses, "reconstruct", lambda *_: reconstruction())
    images = noise.rename(noise.with_name("images"))
    before = {path.name: path.read_bytes() for path in images.iterdir()}
    assert find_poses(images, images.parent).folder == images.parent / "sparse" / "0"
    assert {path.name: path.read_bytes() for path in images.iterdir()} == before


def test_photographs_of_somebody_else_are_not_overwritten(noise, tmp_path, monkeypatch):
    (other := tmp_path / "other" / "images").mkdir(parents=True)
    (other / "1.png").write_bytes((noise / "0.png").read_bytes())
    monkeypatch.setattr(poses, "reconstruct", lambda *_: pytest.fail("COLMAP was started"))
    with pytest.raises(FileExistsError, match=r"holds another 1\.png"):
        find_poses(noise, other.parent)
    (noise / "sparse/0").mkdir(parents=True)
    (noise / "sparse/0/project.ini").touch()
    with pytest.raises(FileExistsError, match="but no cameras"):
        find_poses(noise)
    assert (other / "1.png").read_bytes() == (noise / "0.png").read_bytes()


def test_poses_ends_with_the_best_setting_known(noise, monkeypatch, capsys):
    """A command to paste: that of a training with dropout and opacity decay, which `train` understands."""
    monkeypatch.setattr(poses, "reconstruct", lambda *_: reconstruction())
    main(["poses", str(noise)])
    *_, last = capsys.readouterr().out.splitlines()
    program, *arguments = shlex.split(last)
    assert program == "ca-reg"
    command = cli.parse_command(arguments)
    assert (command.folder, command.config.dropout, command.config.opacity_decay) == (str(noise), 0.2, 0.995)


def test_too_few_photographs_and_cameras_that_are_there(noise, colmap_text):
    (noise / "0.png").unlink()
    (noise / "1.png").unlink()
    with pytest.raises(ValueError, match=r"1 photograph, .*at least 2"):
        find_poses(noise)
    Image.new("RGB", (8, 6)).save(noise / "b.png")
    colmap_text(noise / "sparse" / "0")
    with pytest.raises(FileExistsError, match=r"cameras already, .*sparse/0: "):
        find_poses(noise)


def test_a_model_is_written_whole_or_not_at_all(noise, tmp_path, monkeypatch):
    fails, folder = True, tmp_path / "scene" / "sparse" / "0"

    def write_binary(part: Path) -> None:
        (part / "cameras.bin").write_bytes(b"half")
        if fails:
            raise OSError(28, "No space left on device")
        (part / "images.bin").write_bytes(b"all")

    monkeypatch.setattr(
        poses, "reconstruct", lambda *_: SimpleNamespace(**{**vars(reconstruction()), "write_binary": write_binary})
    )
    with pytest.raises(OSError, match="No space left"):
        find_poses(noise, tmp_path / "scene")
    assert not any(folder.parent.iterdir())
    killed = folder.with_name(".0.part")  # of a process that had no time to clean up
    killed.mkdir()
    (killed / "points3D.bin").write_bytes(b"old")
    fails = False
    find_poses(noise, tmp_path / "scene")
    assert {path.name for path in folder.iterdir()} == {"cameras.bin", "images.bin"}
    assert not killed.exists()


def test_a_scene_named_in_two_ways_is_not_copied_onto_itself(noise, monkeypatch):
    (noise / "images").mkdir()
    for photo in noise.glob("*.png"):
        photo.rename(noise / "images" / photo.name)
    found = SimpleNamespace(
        images={0: SimpleNamespace(name="1.png", has_pose=True)},
        cameras={0: SimpleNamespace(mean_focal_length=lambda: 50.0)},
        num_points3D=lambda: 3,
        compute_mean_reprojection_error=lambda: 0.5,
        write_binary=lambda folder: None,
        reg_image_ids=lambda: [],
        update_point_3d_errors=lambda: None,
    )
    monkeypatch.setattr(poses, "reconstruct", lambda *arguments: found)
    monkeypatch.chdir(noise.parent)
    assert find_poses(noise.name, noise).registered == ("1.png",)
    assert sorted(path.name for path in noise.iterdir()) == ["images", "sparse"]
