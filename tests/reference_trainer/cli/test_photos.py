"""From photographs to a page with one command, and again from where it stopped."""

import json
import re
import shutil
import subprocess
import sys
import webbrowser
import zlib
from dataclasses import replace

import numpy as np
import pytest
from commands import refused
from PIL import Image
from scipy.spatial.transform import Rotation
from subprocesses import subprocess_environment

from reference_trainer.cli import main, photos
from reference_trainer.evaluation.pictures import save_png
from reference_trainer.render import engine
from reference_trainer.report import page as page_module
from reference_trainer.runs import warmup
from reference_trainer.runs.folder import read_run_settings
from reference_trainer.runs.run import load_run
from reference_trainer.scenes import photographs, poses, synthetic_scene
from reference_trainer.scenes.images import read_image
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.recipes import RECIPES

SCENE = synthetic_scene(width=40, height=30, points=150)


def write_cameras(scene, folder, points=150):
    """COLMAP's text files of the built-in scene, as COLMAP documents them; its points are repeated."""
    folder.mkdir(parents=True)
    camera = SCENE.train[0].camera
    lens = f"{camera.fx} {camera.fy} {camera.cx} {camera.cy}"
    (folder / "cameras.txt").write_text(f"1 PINHOLE {camera.width} {camera.height} {lens}\n")
    lines = []
    for number, view in enumerate(SCENE.train, 1):
        pose = view.camera.world_to_camera.double().numpy()
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines += [" ".join(map(str, [number, w, x, y, z, *pose[:3, 3], 1, f"{view.name}.png"])), ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    places = SCENE.points.positions.tolist()
    lines = [" ".join(map(str, [i + 1, *places[i % len(places)], 9, 9, 9, 0.5, 1, 0])) for i in range(points)]
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def garden(tmp_path, monkeypatch):
    """Three photographs without cameras, which a stand-in for COLMAP finds; two or three steps; no calibration."""

    def find(scene, **rest):
        assert sorted(path.stem for path in (scene / "images").iterdir()) == [f"train_{i}" for i in range(3)]
        write_cameras(scene, scene / "sparse" / "0")
        return "3 of 3 photographs registered"

    for view in SCENE.train:
        save_png(tmp_path / "garden" / f"{view.name}.png", view.image)
    monkeypatch.setattr(poses, "find_poses", find)
    monkeypatch.setattr(warmup, "step_seconds", lambda *size: 0.5)
    monkeypatch.setattr(photos, "PRESETS", {"quick": (2, 600), "default": (3, 1200), "quality": (4, 1200)})
    monkeypatch.chdir(tmp_path)
    return tmp_path / "garden"


def seen(folder):
    """What is there, and when it was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_three_photographs_become_a_page(garden, tmp_path, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setenv("DISPLAY", ":0")
    before = seen(garden)
    (garden / "IMG_4.CR2").write_bytes(b"raw")
    main(["run", "garden"])
    said, warned = capsys.readouterr()
    out = tmp_path / "runs" / "garden"
    assert "IMG_4.CR2" in warned
    assert "3 of 3 photographs registered" in said
    assert (
        said.index("will take about") < said.index("registered") < said.index("| train |") < said.index("report.html")
    )
    assert len(re.findall("^initial points", said, re.M)) == 1
    assert {path: at for path, at in seen(garden).items() if path.suffix == ".png"} == before
    page = (out / "report.html").read_text()
    assert opened == [(out / "report.html").as_uri()]
    assert "garden" in re.search("<title>(.*)</title>", page)[1]
    verdict = re.search(r'"verdict": "([^"]*)"', page)[1]
    assert "around the training views" in verdict
    assert "test view" not in verdict
    settings = json.loads((out / "config.json").read_text())["config"]
    assert (settings["dropout"], settings["opacity_decay"], settings["iterations"]) == (0.2, 0.995, 3)
    assert read_image(out / "views/train/train_0.png")[0].shape == (3, 30, 40)
    curves = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator").EventAccumulator(str(out))
    assert curves.Reload().Tags()["images"]  # as docs/view.md says of runs/mine

    # What is finished stays, and nothing is written again.
    finished = seen(out)
    main(["run", "garden", "--no-open"])
    assert len(opened) == 1
    assert seen(out) == finished

    # One step and those after it again.
    main(["run", "garden", "--from", "evaluate"])
    changed = {path.relative_to(out).parts[0] for path, at in seen(out).items() if finished.get(path) != at}
    assert {"results.json", "views", "report.html"} <= changed
    assert not changed & {"scene", "photographs.json"}

    # Other settings or photographs are named, unless they are asked for.
    assert "iterations: 3 -> 2" in (text := refused(["run", "garden", "--quick"], capsys))
    assert "--from train" in text
    there = seen(out)
    refused(["run", "garden", "--quick", "--from", "evaluate"], capsys)
    assert seen(out) == there
    (garden / "train_2.png").unlink()
    assert "cameras, see train_2.png" in refused(["run", "garden"], capsys)
    shutil.copy(garden / "train_1.png", garden / "train_2.png")  # maybe of as many bytes
    assert "cameras, see train_2.png" in refused(["run", "garden"], capsys)
    shutil.copy(out / "scene/garden/images/train_2.png", garden)
    main(["run", "garden", "--quick", "--from", "train", "--no-open"])
    assert json.loads((out / "config.json").read_text())["config"]["iterations"] == 2


@pytest.mark.slow
def test_an_interrupted_run_goes_on(garden, tmp_path, monkeypatch, capsys):
    with Image.open(garden / "train_2.png") as last:
        last.save(garden / "train_2.webp", lossless=True)  # which has to be made anew
    (garden / "train_2.png").unlink()

    def stop(*arguments, **named):
        raise KeyboardInterrupt

    out = tmp_path / "out"
    for module, function in ((photographs, "_save"), (poses, "find_poses"), (page_module, "write_report")):
        with monkeypatch.context() as patched:
            patched.setattr(module, function, stop)
            with pytest.raises(SystemExit) as ended:
                main(["run", "garden", "--out", "out", "--no-open"])
        assert ended.value.code == 130
    trained = seen(out)
    main(["run", "garden", "--out", "out", "--no-open"])
    new = {path.name for path, at in seen(out).items() if trained.get(path) != at}
    assert new == {"report.html"}

    # The photographs may have moved meanwhile.
    finished = seen(out)
    garden.rename(tmp_path / "yard")
    main(["run", "yard", "--out", "out", "--no-open"])
    assert seen(out) == finished


@pytest.mark.slow
def test_a_run_that_is_moved_takes_its_photographs_along(garden, tmp_path, capsys):
    main(["run", "garden", "--out", "out", "--no-open"])
    moved = (tmp_path / "out").rename(tmp_path / "on another disk")
    main(["render", "on another disk", "--what", "train"])
    assert len([*(moved / "render_train").glob("*.png")]) == 3
    (moved / "report.html").unlink()
    main(["run", "garden", "--out", "on another disk", "--no-open"])
    assert (moved / "report.html").is_file()

    # A copy does not need the original, which may have changed.
    shutil.copytree(moved, tmp_path / "copy")
    shutil.rmtree(moved / "scene")
    assert load_run(tmp_path / "copy").scene.train[0].name.startswith("train_0")
    assert "which is not there anymore" in refused(["render", "on another disk", "--what", "train"], capsys)


@pytest.mark.slow
def test_models_of_several_kinds_become_one(garden, tmp_path, capsys, monkeypatch):
    """What is finished stays where it is moved to, and another number of models is refused before anything is done."""
    short = replace(RECIPES["distilled"], config=replace(RECIPES["distilled"].config, iterations=5))
    monkeypatch.setitem(RECIPES, "distilled", short)
    command = ["run", "garden", "--out", "out", "--no-open"]
    main([*command, "--members", "3", "--quick"])
    out = tmp_path / "out"
    members = [load_run(out / "members" / str(seed)) for seed in range(3)]
    assert [member.config.seed for member in members] == [0, 1, 2]
    assert [member.config.iterations for member in members] == [2, 1, 1]
    assert [member.config.means_rate for member in members] == [1.6e-4, 4e-5, 1.6e-4]
    assert ["warp" in member.config.loss for member in members] == [False, False, True]
    assert not members[0].gaussians.means.equal(members[1].gaussians.means)
    options, config = read_run_settings(out / "config.json")
    (_, term) = LOSSES.make(config.loss)
    assert term.members == tuple(str(out / "members" / str(seed) / "point_cloud.ply") for seed in range(3))
    assert (options.init, config.dropout) == (term.members[0], 0.2)
    finished = load_run(out)
    assert finished.step == 5
    assert not finished.gaussians.means.equal(members[0].gaussians.means)

    before = seen(out)
    for wrong in (["--members", "2", "--quick"], ["--members", "3"], ["--quick"]):
        assert "--from train" in refused([*command, *wrong], capsys), wrong
    assert seen(out) == before
    moved = out.rename(tmp_path / "moved")
    before = seen(moved)
    main(["run", "garden", "--out", "moved", "--no-open", "--members", "3", "--quick"])
    assert seen(moved) == before
    assert load_run(moved).step == 5
    main(["run", "garden", "--out", "moved", "--no-open", "--quick", "--from", "train"])
    assert not (moved / "members").exists()
    assert "one model" in refused(["run", "garden", "--out", "moved", "--members", "2", "--quick"], capsys)


@pytest.mark.parametrize(("cores", "minutes"), [(1, "1 h 38 min"), (2, "1 h 5 min"), (3, "52 min"), (8, "52 min")])
def test_models_that_are_made_into_one_train_side_by_side(stopped, capsys, monkeypatch, cores, minutes):
    """Of 2,000 and 1,000 steps and 1,000 with the warp, then the last training: at half a second, doubled."""
    monkeypatch.setattr(photos, "PRESETS", {"default": (2_000, 1_200)})
    monkeypatch.setattr(photos, "processors", lambda: cores)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    stopped("garden", "--members", "3")
    assert f"training {minutes}, " in capsys.readouterr().out


def test_a_model_that_cannot_be_trained_is_named(garden, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(photos.RenderOptions, "begin", lambda *_, **__: None)
    write_cameras(SCENE, garden / "sparse" / "0", 150)
    for number in "01":
        (foreign := tmp_path / "out/members" / number / "results.json").parent.mkdir(parents=True)
        foreign.write_text("{}")
    files = [*garden.glob("*.png"), garden / "sparse/0/cameras.txt", garden / "sparse/0/images.txt"]
    sums = {path.relative_to(garden).as_posix(): zlib.crc32(path.read_bytes()) for path in files}
    (tmp_path / "out" / photos.MARK).write_text(json.dumps({"frames": 16, "files": sums}))
    said = refused(["run", "garden", "--out", "out", "--members", "2"], capsys)
    assert "model 1 failed" in said
    assert "members/0 holds results.json, but nothing says" in said


@pytest.mark.slow
@pytest.mark.parametrize("points", [150, 10_000])
def test_photographs_with_cameras_stay_where_they_are(garden, tmp_path, monkeypatch, capsys, points):
    monkeypatch.setattr(poses, "find_poses", None)  # nobody calls it
    write_cameras(SCENE, garden / "sparse" / "0", points)
    before = seen(garden)
    main(["run", "garden", "--out", "out", "--quick", "--no-open"])
    forecast = re.search(r"will take about .* now: (.*)\.\n", capsys.readouterr().out)[1]
    assert ("points" in forecast) == (points == 150), forecast  # of enough measured points no more are made
    assert seen(garden) == before
    assert not (tmp_path / "out" / "scene").exists()
    with Image.open(tmp_path / "out/views/train/train_0.png") as view:  # 600 pixels of 40 x 30
        assert view.size == (28, 21)
    assert np.isfinite(json.loads((tmp_path / "out" / "results.json").read_text())["mean"]["train"]["psnr"])

    # Another photograph has no camera; other cameras are another scene.
    save_png(garden / "train_9.png", SCENE.test[0].image)
    assert "see train_9.png" in refused(["run", "garden", "--out", "out", "--quick"], capsys)
    main(["plan", "garden"])
    assert "not used: train_9.png" in capsys.readouterr().out
    (garden / "train_9.png").unlink()
    (cameras := garden / "sparse/0/images.txt").write_text(cameras.read_text().replace("1 ", "1  ", 1))
    assert "see sparse/0/images.txt" in refused(["run", "garden", "--out", "out", "--quick"], capsys)


@pytest.mark.slow
def test_cameras_are_found_by_a_new_process(garden):
    """Which has imported nothing that knows the formats."""
    write_cameras(SCENE, garden / "sparse" / "0")
    done = subprocess.run(
        [sys.executable, "-m", "reference_trainer.cli", "run", "garden", "--out", "out", "--points", "nowhere"],
        env=subprocess_environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, "nowhere" in done.stderr) == (2, True)
    assert "photographs with cameras: garden" in done.stdout


@pytest.mark.parametrize(
    ("name", "content"),
    [("point_cloud.ply", "ply"), ("report.html", "<p>mine"), ("scene", None), ("views", None), ("members", None)]
    + [
        ("photographs.json", text)
        for text in ('{"a": 1}', '{"files": 3}', '{"frames": 2, "files": []}', "[]", "null", "")
    ],
)
def test_nothing_of_somebody_else_is_overwritten(garden, tmp_path, capsys, name, content):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).mkdir() if content is None else (tmp_path / "out" / name).write_text(content)
    before = seen(tmp_path)
    assert name in refused(["run", "garden", "--out", "out"], capsys)
    assert name in refused(["run", "garden", "--out", "out", "--from", "photographs"], capsys)
    for out in ("garden", "."):
        assert "another --out" in refused(["run", "garden", "--out", out], capsys)
    assert seen(tmp_path) == before


def test_what_cannot_work_is_refused_at_once(garden, capsys, monkeypatch):
    (garden.parent / "one").mkdir()
    shutil.copy(garden / "train_0.png", garden.parent / "one")
    monkeypatch.setattr(photos, "find_spec", lambda name: name)
    assert "holds 1 photograph that" in refused(["run", "one"], capsys)
    with monkeypatch.context() as patched:
        patched.setattr(photos, "find_spec", lambda name: None)
        assert "ca_reg[colmap]" in refused(["run", "garden"], capsys)
    assert "no nowhere" in refused(["run", "nowhere"], capsys)
    assert "--quality" in refused(["run", "garden", "--quick", "--quality"], capsys)


@pytest.fixture
def stopped(garden, monkeypatch):
    """Runs end where COLMAP would begin, and return by name the pictures that it would be given."""
    given = []

    def stop(scene, **rest):
        given[:] = [[path.name for path in sorted((scene / "images").iterdir())]]
        raise RuntimeError("here COLMAP begins")

    def run(*arguments):
        with pytest.raises(SystemExit):
            main(["run", *arguments])
        return given.pop() if given else None

    monkeypatch.setattr(photos, "find_spec", lambda name: name)
    monkeypatch.setattr(photos.RenderOptions, "begin", lambda *_, **__: None)
    monkeypatch.setattr(poses, "find_poses", stop)
    return run


@pytest.fixture
def clip(tmp_path, monkeypatch):
    """A video of twenty pictures, or as many as are left in the list; after those comes Ctrl-C, if it says so."""
    pictures = [Image.new("RGB", (40, 30), (number, 0, 0)) for number in range(20)]

    def frames(path, count):
        for number in range(min(count, len(pictures))):
            if pictures[number] is None:
                raise KeyboardInterrupt
            yield pictures[number]

    (tmp_path / "clip.mp4").write_bytes(b"fake")
    monkeypatch.setattr(photographs, "_check_video", lambda path: None)
    monkeypatch.setattr(photographs, "sharpest_frames", frames)
    return pictures


def test_of_an_interrupted_collection_nothing_is_left(stopped, clip, tmp_path):
    clip[10], whole = None, clip[10]
    assert stopped("clip.mp4") is None
    out = tmp_path / "runs/clip"
    assert [path.name for path in out.rglob("*")] == [".lock"]
    (out / ".photographs.part").mkdir()  # of one that was killed
    (out / ".photographs.part" / "clip_0009.jpg").touch()
    clip[10] = whole
    assert stopped("clip.mp4", "--frames", "4") == [f"clip_000{i}.jpg" for i in range(4)]
    assert sorted(path.name for path in out.iterdir()) == [".lock", "photographs.json", "scene"]


def test_another_number_of_frames_matters_to_videos_alone(stopped, clip, capsys):
    assert len(stopped("clip.mp4")) == 16
    assert "see --frames" in refused(["run", "clip.mp4", "--frames", "4"], capsys)
    assert len(stopped("clip.mp4", "--frames", "4", "--from", "photographs")) == 4
    assert len(stopped("garden")) == len(stopped("garden", "--frames", "4")) == 3


def test_a_video_with_one_picture_is_refused_and_claims_no_folder(stopped, clip, tmp_path, capsys):
    del clip[1:]
    for _ in range(2):
        assert "clip.mp4 gave 1 picture; it takes at least 2" in refused(["run", "clip.mp4"], capsys)
        assert not (tmp_path / "runs/clip/photographs.json").exists()


def test_equal_photographs_and_other_folders_are_named(stopped, garden, tmp_path, capsys):
    shutil.copy(garden / "train_0.png", garden / "train_3.png")
    shutil.copytree(garden, garden / "DCIM" / "100")
    assert stopped("garden") == ["train_0.png", "train_1.png", "train_2.png"]
    said = capsys.readouterr().err
    assert "left out: train_3.png is the same file as train_0.png" in said
    assert "left out: photographs or videos in garden/DCIM/100 are not read (4): move them to garden, or give" in said
    (tmp_path / "card").mkdir()
    shutil.copytree(garden / "DCIM", tmp_path / "card" / "DCIM")
    said = refused(["run", "card"], capsys)
    assert "in card/DCIM/100 are not read" in said
    assert "card holds no photographs that can be read" in said


@pytest.mark.parametrize("sign", ["sparse/0", "notes.npz"])
def test_what_is_taken_for_cameras_and_is_none_is_no_dead_end(stopped, garden, tmp_path, capsys, sign):
    wrong = garden / sign
    wrong.mkdir(parents=True) if sign == "sparse/0" else np.savez(wrong, notes=np.zeros(3))
    assert sign.partition("/")[0] in refused(["run", "garden"], capsys)
    assert not (tmp_path / "runs").exists()
    shutil.rmtree(garden / "sparse") if sign == "sparse/0" else wrong.unlink()
    for _ in range(2):
        assert len(stopped("garden")) == 3
        shutil.rmtree(tmp_path / "runs/garden/scene/garden/images")


def test_wrong_options_are_refused_with_everything_in_place(stopped, garden, tmp_path, capsys, monkeypatch):
    assert stopped("garden") is not None
    (out := tmp_path / "runs/garden").joinpath("checkpoint.pt").write_bytes(b"an hour of training")
    (out / "results.json").write_text("{}")
    before = seen(out)
    monkeypatch.setattr(engine, "_compiled_engine", lambda name: None)
    for step in ("photographs", "poses", "train"):
        again = ["run", "garden", "--from", step]
        for points in ("random:many", "random:0", "nowhere.ply", "../elsewhere"):
            if step != "photographs" or points.startswith("random"):
                assert points in refused([*again, "--points", points], capsys)
        assert "the engine triton" in refused([*again, "--engine", "triton"], capsys)
        assert seen(out) == before
    assert stopped("garden", "--from", "train") is not None
    assert seen(out).keys() == {path for path in before if path.name not in ("checkpoint.pt", "results.json")}


def test_a_folder_that_cannot_be_written_to_is_answered_with_the_option(garden, capsys, monkeypatch):
    monkeypatch.setattr(photos.os, "access", lambda place, mode: False)
    assert "runs/garden cannot be written to" in (said := refused(["run", "garden"], capsys))
    assert "another --out" in said
    (garden.parent / "file").touch()
    assert "another --out" in refused(["run", "garden", "--out", "file/x"], capsys)


def test_one_large_photograph_does_not_shrink_the_others_to_nothing(stopped, garden, capsys):
    with Image.open(garden / "train_0.png") as small:
        small.resize((400, 300)).save(garden / "train_1.png")
    stopped("garden")
    assert "most photographs train at 40x30, but train_1.png at 400x300." in capsys.readouterr().out


@pytest.mark.slow
def test_photographs_that_were_not_placed_are_named_again_and_on_the_page(garden, tmp_path, capsys, monkeypatch):
    find, said = poses.find_poses, "left out: train_9.png. They share too little with the others"

    def find_two(scene, **rest):
        find(scene, **rest)
        (scene / "sparse/0/left_out.txt").write_text(said)
        return f"3 of 4 photographs registered\n{said}"

    monkeypatch.setattr(poses, "find_poses", find_two)
    for times in (1, 1):
        main(["run", "garden", "--no-open"])
        assert capsys.readouterr().out.count(said) == times
    assert said in (tmp_path / "runs/garden/report.html").read_text()


def test_folders_with_a_dot_in_their_names_are_not_one(tmp_path):
    (tmp_path / "walk.1").mkdir()
    (tmp_path / "walk.mp4").touch()
    names = [photos.Run(tmp_path / name).folder.name for name in ("walk.1", "walk.mp4")]
    assert names == ["walk.1", "walk"]


def test_photographs_that_changed_are_refused_before_anything_is_deleted(garden, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(photos, "find_spec", lambda name: name)
    (tmp_path / "out").mkdir()
    about = {"frames": 16, "files": {"train_0.png": 1}}
    (tmp_path / "out" / "photographs.json").write_text(json.dumps(about))
    (tmp_path / "out" / "checkpoint.pt").write_bytes(b"an hour of training")
    for step in ("poses", "train"):
        assert "other photographs" in refused(["run", "garden", "--out", "out", "--from", step], capsys)
        assert (tmp_path / "out" / "checkpoint.pt").exists()


@pytest.mark.slow
def test_a_folder_with_one_video_is_enough(tmp_path, capsys, monkeypatch):
    av = pytest.importorskip("av", reason="needs ca_reg[photos]")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk").mkdir()
    with av.open("walk/clip.mp4", "w") as file:
        stream = file.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in range(0, 200, 25):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")))
        file.mux(stream.encode(None))
    monkeypatch.setattr(photos, "find_spec", lambda name: name)
    monkeypatch.setattr(warmup, "step_seconds", lambda *size: 0.5)
    monkeypatch.setattr(
        poses, "find_poses", lambda scene, **rest: pytest.fail(str(sorted((scene / "images").iterdir())))
    )
    with pytest.raises(pytest.fail.Exception, match=r"clip_0000\.jpg.*clip_0002\.jpg"):
        main(["run", "walk", "--frames", "3"])
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    assert "it takes at least 2" in refused(["run", "broken.mp4"], capsys)
    assert not (tmp_path / "runs/broken").exists()


@pytest.mark.slow
@pytest.mark.data
def test_three_real_photographs_from_nothing_to_the_page(data_root, tmp_path, capsys, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs ca_reg[colmap]")
    monkeypatch.setattr(photos, "PRESETS", {"quick": (300, 20_000)})
    (tmp_path / "portal").mkdir()
    for name in json.loads((data_root / "herz-jesu/split_near.json").read_text())["train_3"]:
        shutil.copy(data_root / "herz-jesu/images" / name, tmp_path / "portal")
    main(["run", str(tmp_path / "portal"), "--out", str(tmp_path / "out"), "--quick", "--no-open"])
    said = capsys.readouterr().out
    assert "3 of 3 photographs registered" in said
    assert re.search(
        r"will take about \d+ (s|min) on this machine as it is now: poses \d+ s, points \d+ s, training \d+ s", said
    )
    assert (tmp_path / "out/report.html").stat().st_size > 1e5  # with pictures and model
    results = json.loads((tmp_path / "out/results.json").read_text())
    assert set(results["mean"]) == {"train", "between", "around"}
    assert results["mean"]["train"]["psnr"] > 18  # one color has 15
