"""The commands about one run, from the training to pictures, and about a PLY in its place."""

import json
import re
import shlex
from pathlib import Path

import pytest
from commands import plain, refused

from reference_trainer.cli import main
from reference_trainer.evaluation import tables
from reference_trainer.model.ply import load_ply, save_ply
from reference_trainer.runs import measure as measure_module
from reference_trainer.runs import ply as ply_module
from reference_trainer.runs import run as run_module
from reference_trainer.scenes.options import OrbitOptions, SceneOptions
from reference_trainer.training.recipes import RECIPES, with_recipe
from reference_trainer.viewer.window import Viewer

SMALL = ["--downscale", "8", "--iterations", "3", "--monitor-every", "2"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "run"
    main(["train", "--out", str(out), "--dropout", "0.2", *SMALL])
    return out


@pytest.mark.parametrize("what", [[""], ["point_cloud.ply"], ["", "point_cloud_for_viewers.ply"]])
def test_a_run_or_a_ply_is_shown_until_ctrl_c(what, trained, capsys, monkeypatch):
    pytest.importorskip("viser")
    shown, show = [], Viewer.show

    def shows(viewer, model, views, name):
        show(viewer, model, views, name)
        shown.append(model.test_rendering(next(view for of in views.values() for view in of)).image)

    def ctrl_c(viewer):
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "show", shows)
    monkeypatch.setattr(Viewer, "update", ctrl_c)
    main(["view", *(str(trained / name) for name in what), "--port", "0"])
    assert re.search(r"http://127\.0\.0\.1:\d+, .*Ctrl-C", capsys.readouterr().out)
    assert [bool(image.std() > 0) for image in shown] == [True] * len(what)
    assert "1 model to show, or 2" in refused(["view", str(trained), str(trained)], capsys)


@pytest.mark.parametrize("second", [None, "part.ply"])
def test_models_side_by_side_have_one_size(second, trained, tmp_path, monkeypatch):
    """Although tiny ones without a scene are enlarged, each to the same radius."""
    pytest.importorskip("viser")
    gaussians = ply_module.scaled(load_ply(trained / "point_cloud.ply").gaussians, 0.02)
    save_ply(gaussians, tmp_path / "tiny.ply")
    save_ply(gaussians[: len(gaussians) // 2], tmp_path / "part.ply")
    extents, whole = [], (gaussians.means[0] - gaussians.means[1]).norm()

    def shows(viewer, model, views, name):
        extents.append(((model.gaussians.means[0] - model.gaussians.means[1]).norm() / whole).item())

    monkeypatch.setattr(Viewer, "show", shows)
    monkeypatch.setattr(Viewer, "serve", lambda viewer: None)
    main(["view", str(tmp_path / "tiny.ply"), str(tmp_path / second if second else trained), "--port", "0"])
    assert extents[0] > 1
    assert extents[1] == pytest.approx(extents[0] * (1 if second else 50), rel=1e-4)


@pytest.mark.parametrize("arguments", [["garden"], ["--path", "garden"], ["garden", "--path", "garden"]])
def test_the_scene_of_a_training_may_be_given_either_way(arguments, monkeypatch, capsys, tmp_path):
    asked = []
    monkeypatch.setattr(run_module, "run_experiment", lambda scene, config, out, **rest: asked.append(scene))
    monkeypatch.setattr(tables, "summary", lambda results: "")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garden").mkdir()
    main(["train", *arguments, "--views", "5", "--out", "out"])
    assert asked == [SceneOptions("garden", views=5)]
    assert "got garden and fern" in refused(["train", "garden", "--path", "fern"], capsys)


def test_the_commands_that_a_training_ends_with_can_be_pasted(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(run_module, "run_experiment", lambda *arguments, **named: {})
    monkeypatch.setattr(tables, "summary", lambda results: "")
    out = str(tmp_path / "my run")
    main(["train", "--out", out])
    *_, page, curves = capsys.readouterr().out.strip().split(";")
    assert shlex.split(page)[-3:] == ["ca-reg", "report", out]
    assert shlex.split(curves)[-3:] == ["tensorboard", "--logdir", out]


def test_a_ply_is_known_by_its_name(monkeypatch, tmp_path):
    asked: list = []
    (tmp_path / "a.PLY").touch()
    monkeypatch.setattr(ply_module, "score_ply", lambda ply, *rest, **named: asked.append(str(ply)))
    main(["evaluate", str(tmp_path / "a.PLY")])
    assert asked == [str(tmp_path / "a.PLY")]


@pytest.mark.parametrize("engine", [pytest.param("torch", marks=pytest.mark.slow), "numba"])
def test_the_engine_is_chosen_said_and_noted(engine, trained, capsys, tmp_path, monkeypatch):
    if engine == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("CA_REG_ENGINE", "auto")  # which the option changes, for workers
    main(["evaluate", str(trained), "--samples", "2", "--engine", engine, "--out", str(tmp_path)])
    said = capsys.readouterr().out.splitlines()
    assert [line.startswith("Engine: ") for line in said].count(True) == 1
    noted = json.loads((tmp_path / "evaluation.json").read_text())["machine"]["engine"]
    assert f"Engine: {noted}" in said
    assert (noted == "torch") == (engine == "torch")


@pytest.mark.slow
def test_a_run_from_training_to_pictures(trained, capsys, tmp_path):
    assert (trained / "results.json").exists()
    results = json.loads((trained / "results.json").read_text())
    assert results["config"]["dropout"] == 0.2

    main(["evaluate", str(trained), "--samples", "3", "--out", str(tmp_path / "e")])
    assert "| mean test |" in capsys.readouterr().out
    evaluation = json.loads((tmp_path / "e" / "evaluation.json").read_text())
    assert evaluation["ca_settings"]["samples"] == 3
    assert evaluation["mean"]["test"]["psnr"] == results["mean"]["test"]["psnr"]

    main(["evaluate", str(trained / "point_cloud.ply"), "--scene", "synthetic", "--downscale", "8",
          "--out", str(tmp_path / "p")])  # fmt: skip
    of_ply = json.loads((tmp_path / "p" / "evaluation.json").read_text())
    assert of_ply["views"] == results["views"]

    main(["render", str(trained)])
    assert len(list((trained / "render_test").glob("*.png"))) == 3
    main(["render", str(trained), "--what", "flight", "--frames", "4", "--out", str(tmp_path / "flight")])
    assert len([*(tmp_path / "flight").glob("flight.*")]) == 1


@pytest.mark.parametrize(("given", "folder"), [("", "evaluation"), ("noise(0.8)", "evaluation_noise_0.8")])
def test_the_folder_of_an_evaluation(given, folder, trained, monkeypatch):
    asked: list = []
    monkeypatch.setattr(measure_module, "measure", lambda model, views, out, **named: asked.append(out))
    main(["evaluate", str(trained), *(["--regularizer", given] if given else [])])
    assert asked == [trained / folder]


@pytest.mark.slow
def test_a_run_is_evaluated_with_the_mean_of_its_noise(trained, capsys, tmp_path):
    main(["train", "--out", str(tmp_path / "run"), "--noise", "0.8", *SMALL])
    main(["evaluate", str(tmp_path / "run"), "--regularizer", "noise(0.8, scale=True)", "--samples", "2"])
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    found = json.loads((tmp_path / "run" / "evaluation_noise_0.8_scale=True" / "evaluation.json").read_text())
    assert found["mean"]["test"]["psnr"] != results["mean"]["test"]["psnr"]


@pytest.mark.parametrize("flag", ["--path", "--scene"])
def test_a_ply_on_a_scene_or_an_orbit(flag, monkeypatch, tmp_path):
    asked: list = []
    monkeypatch.setattr(ply_module, "score_ply", lambda *given, **named: asked.append((given, named)))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.ply").touch()
    (tmp_path / "garden").mkdir()
    main(["evaluate", "a.ply", flag, "garden", "--images", "images_8", "--views", "12", "--regularizer", "noise"])
    main(["evaluate", "a.ply", "--cameras", "3", "--size", "64", "--world", "z-up", "--arc", "90",
          "--background", "white", "--samples", "7", "--seed", "1", "--out", "o"])  # fmt: skip
    ((ply, scene, out), named), ((other, orbit, folder), others) = asked
    assert (str(ply), scene.path, scene.images, scene.views, out) == ("a.ply", "garden", "images_8", 12, None)
    assert named == {"regularizer": "noise", "samples": 5, "seed": 0, "device": "cpu", "perceptual": None,
                     "background": "auto", "trust": set()}  # fmt: skip
    assert (str(other), orbit, str(folder)) == ("a.ply", OrbitOptions(3, 64, "z-up", 90.0), "o")
    assert others == {"regularizer": None, "samples": 7, "seed": 1, "device": "cpu", "background": "white",
                      "perceptual": None, "trust": set()}  # fmt: skip


def test_an_orbit_and_a_baked_ply(trained, capsys, tmp_path):
    small = ["--cameras", "1", "--size", "24", "--samples", "2"]
    main(["bake", str(trained / "point_cloud.ply"), "--out", str(tmp_path / "baked.ply")])
    said = plain(capsys.readouterr().out)
    assert re.search(r"baked\.ply: .*after dropout\(0\.2\)", said)
    main(["evaluate", str(tmp_path / "baked.ply"), *small])
    out = capsys.readouterr().out
    assert re.search(r"0\.8 baked in, .*trained with: dropout\(0\.2\)", out)
    assert "| mean orbit |" in out
    ply = str(trained / "point_cloud.ply")
    main(["evaluate", ply, "--out", str(tmp_path / "p"), *small])
    one, other = (
        json.loads((tmp_path / folder / "evaluation.json").read_text()) for folder in ("baked_evaluation_orbit", "p")
    )
    assert one["mean"]["orbit"]["covered"] > 0
    for name in ("covered", "cv"):  # after three steps nothing is opaque enough for CA
        assert one["mean"]["orbit"][name] == pytest.approx(other["mean"]["orbit"][name], rel=1e-4)


def test_training_again_says_that_nothing_is_to_be_done(trained, capsys):
    main(["train", "--out", str(trained), "--dropout", "0.2", *SMALL])
    out = capsys.readouterr().out
    assert "complete, nothing to do" in out
    assert "| test |" in out


@pytest.mark.parametrize("recipe", [None, *RECIPES])
def test_options_override_the_recipe(recipe, monkeypatch, tmp_path):
    asked: dict = {}

    def fake(scene, config, out, **keywords):
        asked.update(scene=scene, config=config, out=out, **keywords)
        return {}

    monkeypatch.setattr(run_module, "run_experiment", fake)
    monkeypatch.setattr(tables, "summary", lambda results: "")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fern").mkdir()
    chosen = ["--recipe", recipe] if recipe else []
    main(["train", *chosen, "--iterations", "3000", "--densify-from", "70", "--noise", "0.8", "--path", "fern",
          "--images", "images_8", "--views", "5", "--out", "out"])  # fmt: skip
    given = {"iterations": 3_000, "densify_from": 70, "noise": 0.8}
    assert asked["config"] == with_recipe(recipe or "3dgs", **given)
    assert asked["scene"] == SceneOptions("fern", images="images_8", views=5)
    assert asked["out"] == Path("out")


def test_the_recipe_of_binocular_decays_opacities(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(run_module, "run_experiment", lambda scene, config, out, **rest: asked.append(config))
    monkeypatch.setattr(tables, "summary", lambda results: "")
    main(["train", "--iterations", "3", "--recipe=binocular", "--out", str(tmp_path)])
    assert (asked[0].opacity_decay, asked[0].iterations) == (0.995, 3)


def test_other_settings_in_the_same_folder(trained, capsys):
    text = refused(["train", "--out", str(trained), "--dropout", "0.3", *SMALL], capsys)
    assert "other settings (dropout: 0.2 -> 0.3)" in text


def test_what_would_be_lost_is_refused(trained, capsys, tmp_path):
    """The photographs, and files that are not from here."""
    (tmp_path / "plan.json").write_text("precious")
    (tmp_path / "test_0.png").write_text("a photograph")
    garden = str(tmp_path)
    assert "folder of the scene" in refused(["train", garden, "--out", garden], capsys)
    assert "is no plan of ca-reg" in refused(["plan", "--out", str(tmp_path / "plan.json")], capsys)
    assert "is a folder" in refused(["plan", "--out", garden], capsys)
    assert "holds plan.json" in refused(["train", "--out", garden, *SMALL], capsys)
    assert "which knows no cameras" in refused(["render", str(trained / "point_cloud.ply")], capsys)
    for other in (f"{garden}/x.spz", f"{garden}/x.splat"):
        assert "bake that" in refused(["clean", str(trained / "point_cloud.ply"), "--anyway", "--out", other], capsys)
    assert "end in .ply" in refused(["bake", str(trained / "point_cloud.ply"), "--out", f"{garden}/x.splat"], capsys)
    (tmp_path / "evaluation.json").write_text("{}")
    assert "holds evaluation.json" in refused(["evaluate", str(trained), "--out", garden], capsys)
    assert "holds test_0.png" in refused(["render", str(trained), "--what", "test", "--out", garden], capsys)
    assert (tmp_path / "test_0.png").read_text() == "a photograph"
    for what in ("auto", "train", "error"):
        text = refused(["render", str(trained), "--what", what, "--frames", "3", "--out", garden], capsys)
        assert f"--frames needs --what flight, got --what {what}." in text
    for _ in range(2):  # its own pictures may be written again
        main(["render", str(trained), "--what", "test"])


def test_nothing_is_written_to_the_photographs_or_over_other_files(trained, capsys, tmp_path):
    """By the commands that measure and render, wherever they may write."""
    garden, other, run = tmp_path / "garden", tmp_path / "other", tmp_path / "run"
    for folder in (garden / "images", other, run):
        folder.mkdir(parents=True)
    settings = json.loads((trained / "config.json").read_text())
    settings["scene"]["path"] = str(garden)
    (run / "config.json").write_text(json.dumps(settings))
    ply = str(trained / "point_cloud.ply")
    for command in (
        ["evaluate", str(run)], ["render", str(run)], ["evaluate", ply, "--scene", str(garden)],
        ["compare", str(garden), "--iterations", "1", "--seeds", "1"],
    ):  # fmt: skip
        assert "folder of the scene" in refused([*command, "--out", str(garden)], capsys)
    (other / "evaluation.md").write_text("precious")
    assert "holds evaluation.md" in refused(["evaluate", str(trained), "--out", str(other)], capsys)
    (other / "dynamics.png").write_text("precious")
    assert "holds dynamics.png" in refused(["compare", "--out", str(other), *SMALL], capsys)
    assert [path.name for path in garden.iterdir()] == ["images"]
    assert {path.read_text() for path in other.iterdir()} == {"precious"}


@pytest.mark.slow
def test_without_test_views_the_training_views_are_rendered(capsys, tmp_path):
    out = tmp_path / "all"
    main(["train", "--out", str(out), "--downscale", "8", "--test", "none", "--iterations", "1"])
    main(["render", str(out)])
    assert "--what flight" in capsys.readouterr().out
    assert len(list((out / "render_train").glob("*.png"))) == 3
    assert "test view: give --what train" in refused(["render", str(out), "--what", "test"], capsys)


@pytest.mark.slow
def test_own_code_is_trusted_where_the_command_line_names_it(capsys, tmp_path, monkeypatch):
    """What a training prints can be pasted; without --trust nothing of the run is imported."""
    (tmp_path / "own_drop.py").write_text(
        "from ca_reg import GaussianDropout\n\n\nclass Mine(GaussianDropout):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    out = tmp_path / "run"
    main(["train", "--out", str(out), "--regularizer", "own_drop:Mine(0.2)", *SMALL])
    page = shlex.split(capsys.readouterr().out.rpartition("a page: ")[2].partition(";")[0])
    assert page == ["ca-reg", "report", str(out), "--trust", "own_drop"]
    for command in (["report"], ["evaluate"], ["render"], ["evaluate", "--seed", "1"]):
        assert "say --trust own_drop" in refused([command[0], str(out), *command[1:]], capsys)
    ply = str(out / "point_cloud.ply")
    bake = ["bake", ply, "--out", str(tmp_path / "baked.ply")]
    study = ["study", "error-runtime", ply, "--max-samples", "16", "--seeds", "1", "--out", str(tmp_path / "study")]
    for command in (["evaluate", ply], bake, study):
        assert "say --trust own_drop" in refused(command, capsys)
    main([*bake, "--trust", "own_drop"])
    # Two steps of training cover nothing, which is found once the model is loaded.
    assert "no pixel of orbit" in refused([*study, "--trust", "own_drop"], capsys)
    main([*page[1:], "--views", "1"])
    main(["evaluate", str(out), "--regularizer", "own_drop:Mine(0.2)", "--samples", "2"])


@pytest.mark.slow
@pytest.mark.data
def test_a_capture_needs_no_word_of_explanation(data_root, tmp_path, monkeypatch, capsys):
    """The README's commands on the capture of a masked object."""
    monkeypatch.chdir(tmp_path)
    scene, quick = str(data_root / "cape"), ["--downscale", "4", "--monitor-every", "0"]
    best = ["--recipe", "sparse"]
    main(["plan", scene, *best])
    assert "3 training views" in capsys.readouterr().out
    main(["train", scene, *best, *quick, "--iterations", "30", "--out", "runs/mine"])
    main(["report", "runs/mine"])
    said = plain(capsys.readouterr().out)
    assert "exact CA (1e-3)" in said
    results = json.loads((tmp_path / "runs/mine/results.json").read_text())
    assert 5 < results["mean"]["test"]["psnr"] < 40
    assert results["mean"]["test"]["ca_exact_half"] > 0
    assert "<html" in (tmp_path / "runs/mine/report.html").read_text("utf-8")
