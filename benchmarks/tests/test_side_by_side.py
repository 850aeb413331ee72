"""What the table of other trainers is made with: other seeds, times of steps, and rows of what is finished."""

import argparse
import json
import os
import random
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks import side_by_side
from benchmarks.timed import main
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions


def test_seeds_are_shifted_and_steps_are_timed(tmp_path, monkeypatch):
    script = """
        import json, pathlib, random, sys, time, torch
        random.seed(5)
        torch.manual_seed(1)
        x = torch.zeros(1, requires_grad=True)
        adam = torch.optim.Adam([x])
        for _ in range(3):
            x.sum().backward()
            adam.step()
            end = time.process_time() + 0.02
            while time.process_time() < end:
                pass
        pathlib.Path(sys.argv[1]).write_text(json.dumps([random.random(), torch.rand(1).item()]))
    """
    (tmp_path / "a_trainer.py").write_text(textwrap.dedent(script))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", [])
    with torch.random.fork_rng(devices=[]):
        state = random.getstate()
        main(str(tmp_path / "times.json"), "2", "a_trainer", str(tmp_path / "drawn.json"))
        random.setstate(state)
    drawn = json.loads((tmp_path / "drawn.json").read_text())
    assert drawn == [random.Random(7).random(), torch.rand(1, generator=torch.Generator().manual_seed(3)).item()]
    assert 0.04 <= json.loads((tmp_path / "times.json").read_text())["seconds"] < 5  # two steps after the first


def test_what_is_kept_is_not_measured_again(tmp_path, monkeypatch):
    asked = []

    def train(trainer, setting, seed, out, args):
        asked.append((trainer, setting, seed))
        return {"setting": side_by_side.named(trainer, setting), "seed": seed, "gaussians": 9}

    monkeypatch.setattr(side_by_side, "train", train)
    (tmp_path / "llff").mkdir()
    (tmp_path / "llff" / "poses_bounds.npy").touch()  # the scene for the repositories is written already
    options = ["", str(tmp_path / "rows.json"), "--scene", str(tmp_path), "--out", str(tmp_path)]
    options += ["--trainers", "AbsGS", "DropGaussian", "3DGS", "splatfacto-ca", "fsgs: FSGS", "--seeds"]
    for seeds in (["0"], ["0", "1"]):
        monkeypatch.setattr(sys, "argv", [*options, *seeds])
        side_by_side.main()
    runs = [("AbsGS", "plain"), ("AbsGS", "dropout"), ("AbsGS", "noise"), ("DropGaussian", "plain")]
    runs += [("DropGaussian", "noise"), ("3DGS", "plain"), ("3DGS", "dropout"), ("3DGS", "noise")]
    runs += [("splatfacto-ca", "dropout"), ("fsgs: FSGS", "plain")]
    assert asked == [(*run, seed) for seed in (0, 1) for run in runs]


@pytest.mark.data
def test_the_scene_of_the_repositories_has_the_training_views_and_the_points_alone(data_root, tmp_path, monkeypatch):
    monkeypatch.setattr(side_by_side, "train", lambda *_: {"setting": {}, "seed": 0})
    scene = ["--scene", str(data_root / "fern"), "--images", "images_16", "--split", "llff"]
    scene += ["--points", "sparse_3views/0"]
    command = ["", str(tmp_path / "rows.json"), *scene, "--out", str(tmp_path), "--trainers", "AbsGS", "--seeds", "0"]
    monkeypatch.setattr(sys, "argv", command)
    side_by_side.main()
    again = load_scene(SceneOptions(str(tmp_path / "llff"), split="llff", test="none"), trains=False)
    scene = load_scene(
        SceneOptions(str(data_root / "fern"), images="images_16", split="llff", points="sparse_3views/0")
    )
    assert len(again.train) == len(scene.train) == 3
    for written, view in zip(again.train, scene.train, strict=True):
        torch.testing.assert_close(written.camera.world_to_camera, view.camera.world_to_camera, rtol=0, atol=1e-5)
        torch.testing.assert_close(written.image, view.image, rtol=0, atol=0.5 / 255 + 1e-6)
    torch.testing.assert_close(again.points.positions, scene.points.positions)
    # Where gsplat and nerfstudio take every second photograph for a test, from the first on.
    both = load_scene(SceneOptions(str(tmp_path / "both"), test="none", allow_test_points=True), trains=False)
    cameras = torch.stack([view.camera.world_to_camera for view in both.train])
    for views, own in ((scene.test, cameras[::2]), (scene.train, cameras[1::2])):
        torch.testing.assert_close(own, torch.stack([view.camera.world_to_camera for view in views]), rtol=0, atol=1e-5)


def test_every_command_line_is_complete():
    names = {"scene": "s", "images": "i", "out": "o", "forks": "f", "both": "b", "fork_scene": "l", "seed": 7}
    for trainer, command in side_by_side.TRAINERS.items():
        told = command.format(**names, **side_by_side.steps(300), option="--dropout 0.2").split()
        own = trainer in ("splatfacto-ca", "Co-Adaptation-of-3DGS --dropout_factor 0.2")
        assert (told.count("--dropout"), told.count("--seed"), told[told.index("--seed") + 1]) == (1 - own, 1, "7")
        assert "300" in told
        assert own == (side_by_side.named(trainer, "dropout") == {"recipe": trainer})
    assert len({side_by_side.TRAINERS[name] for name in side_by_side.TRAINERS}) == len(side_by_side.TRAINERS)


def test_depth_of_a_network_that_is_downloaded_is_that_of_files(tmp_path, monkeypatch):
    (tmp_path / "depth").mkdir()
    for number in (2, 1):
        Image.fromarray(np.full((2, 3), number, np.uint8)).save(tmp_path / "depth" / f"{number}.png")
    script = """
        import pathlib, sys, torch
        network = torch.hub.load("someone/MiDaS", "DPT")
        depths = [network(torch.zeros(1, 3, 2, 3)) for _ in range(3)]
        assert all(depth.shape == (1, 2, 3) for depth in depths)
        pathlib.Path(sys.argv[1]).write_text(str([depth.mean().item() for depth in depths]))
    """
    (tmp_path / "a_loader.py").write_text(textwrap.dedent(script))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", [])
    main(str(tmp_path / "times.json"), "0", "a_loader", str(tmp_path / "seen"), "-s", str(tmp_path))
    assert (tmp_path / "seen").read_text() == "[1.0, 2.0, 1.0]"


def test_another_interpreter_may_evaluate(tmp_path, monkeypatch):
    called = []

    def run(command, env, **_):
        called.append((command[0], *command[4:6]))
        assert (Path(env["PYTHONPATH"].split(os.pathsep)[0]) / "reference_trainer/cli").is_dir()  # this checkout's
        if command[0] == "evaluating":
            (tmp_path / "evaluation").mkdir()
            test = dict.fromkeys(("psnr", "ssim", "ca", "ca_exact_half"), 1.0)
            found = {"mean": {"test": test}, "gaussians": 7}
            (tmp_path / "evaluation" / "evaluation.json").write_text(json.dumps(found))
        (tmp_path / "times.json").write_text(json.dumps({"seconds": 4.0}))
        (tmp_path / "export").mkdir(exist_ok=True)
        (tmp_path / "export" / "splat.ply").touch()

    monkeypatch.setattr(side_by_side.subprocess, "run", run)
    given = {"scene": "fern", "images": "images", "both": "both", "iterations": 5, "evaluator": "evaluating"}
    given |= {"split": "auto", "downscale": None}
    row = side_by_side.train("splatfacto-ca", "dropout", 2, tmp_path, argparse.Namespace(**given))
    assert called == [
        (sys.executable, "ca_reg.integrations.run", "--cpu"),
        ("evaluating", "reference_trainer.cli", "evaluate"),
    ]
    assert (row["setting"], row["seed"], row["gaussians"], row["pace"]) == ({"recipe": "splatfacto-ca"}, 2, 7, 1.0)
