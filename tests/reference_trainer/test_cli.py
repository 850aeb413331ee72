import json
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import ca_reg
from reference_trainer import cli
from reference_trainer.cli import main
from reference_trainer.evaluation import tables
from reference_trainer.runs import compare as compare_module
from reference_trainer.runs import measure as measure_module
from reference_trainer.runs import run as run_module
from reference_trainer.runs import score_ply as score_module
from reference_trainer.runs.compare_report import Comparison
from reference_trainer.runs.engines import choice as choice_module
from reference_trainer.runs.engines.engine import Failure
from reference_trainer.runs.engines.processes import Processes
from reference_trainer.scenes.options import OrbitOptions, SceneOptions
from reference_trainer.studies import error_runtime as error_runtime_module
from reference_trainer.studies import gaussian_shares as shares_module
from reference_trainer.studies import study as study_module
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES, with_recipe
from reference_trainer.viewer.window import Viewer

SMALL = ["--downscale", "8", "--iterations", "3", "--monitor-every", "2"]


def plain(text: str) -> str:
    """Strip colors and boxes, and join the lines."""
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text).split())


def refused(arguments: list[str], capsys) -> str:
    """Run a command that must fail with exit code 2, and return what it says."""
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    return plain(capsys.readouterr().err)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "run"
    main(["train", "--out", str(out), "--dropout", "0.2", *SMALL])
    return out


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ([], ["demo", "train", "evaluate", "bake", "render", "compare", "warmup"]),
        (["demo"], ["--iterations", "--seeds", "--jobs", "--out"]),
        (["warmup"], ["--engine", "{None,auto,torch,loops}"]),
        (
            ["train"],
            [
                "--engine",
                "--out",
                "--path",
                "--views",
                "--recipe",
                "--dropout",
                "--noise",
                "--opacity-decay",
                "--monitor-pictures",
                "--viewer",
                "--device",
            ],
        ),
        (["evaluate"], ["--path", "--scene", "--regularizer", "--samples", "--lpips"]),
        (["evaluate"], ["--cameras", "--size", "--world", "--arc", "--background"]),
        (["bake"], ["PATH", "--regularizer", "--out"]),
        (["view"], ["PATH", "--scene", "--arc", "--regularizer", "--port", "--device"]),
        (["render"], ["--what", "--frames", "{test,train,flight}"]),
        (
            ["compare"],
            [
                "--strategies",
                "--seeds",
                "--jobs",
                "--iterations",
                "--executor",
                "--engine",
                "--address",
                "--path",
            ],
        ),
    ],
)
def test_help(command, options, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([*command, "--help"])
    assert exit_.value.code == 0
    text = plain(capsys.readouterr().out)
    assert "usage: ca-reg" in text
    for option in options:
        assert option in text


def test_the_list_of_commands_says_what_each_does(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert len(re.findall(r"• \w+ +\w[^•\n]*\.[ │]*\n", text)) == text.count("•") > 12  # one sentence, one line
    assert "Train the built-in scene" in text
    assert "Finished runs are kept" not in text  # which the help of the command says


def test_version_says_what_a_bug_report_needs(capsys):
    main(["version"])
    lines = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    assert (lines["ca_reg"], lines["torch"]) == (ca_reg.__version__, str(torch.__version__))


def test_help_and_mistakes_need_no_torch():
    code = """if True:
        import contextlib, io, sys
        from reference_trainer.cli import main
        commands = ("demo", "plan", "train", "evaluate", "bake", "render", "view", "compare", "study", "warmup")
        for words in ([], *(command.split() for command in commands), ["train", "--nonsense"]):
            with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
                main([*words, "--help"])
        assert "torch" not in sys.modules and "numpy" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("command", ["evaluate x", "render", "train", "compare", "study attribution x"])
def test_a_card_that_is_not_there(command, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    text = refused([*command.split(), "--device", "cuda"], capsys)
    assert re.fullmatch(r"ca-reg: --device cuda: PyTorch \S+ finds 0 CUDA devices; take cpu.", text)


@pytest.mark.parametrize("command", ["view runs/none", "train --viewer"])
def test_without_viser(command, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert refused(command.split(), capsys) == "ca-reg: the viewer needs viser: pip install 'ca_reg[viewer]'."


@pytest.mark.parametrize("what", ["", "point_cloud.ply"])
def test_a_run_or_a_ply_is_shown_until_ctrl_c(what, trained, capsys, monkeypatch):
    pytest.importorskip("viser")
    shown = []

    def draw(viewer):
        shown.append(viewer._subject.draw(viewer._look, viewer._subject._views[0].camera)[0])
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "draw", draw)
    main(["view", str(trained / what), "--port", "0"])
    assert re.search(r"The viewer is at http://127\.0\.0\.1:\d+, .*; Ctrl-C ends it\.", capsys.readouterr().out)
    assert shown[0].std() > 0


def test_a_port_that_is_not_free(capsys):
    pytest.importorskip("viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        text = refused(["train", "--viewer", str(port)], capsys)
    assert text.startswith(f"ca-reg: port {port} cannot be used for the viewer (")
    assert text.endswith("in use): give another one.")
    assert "from 0 to 65535, got 65536" in refused(["view", "runs/none", "--port", "65536"], capsys)


@pytest.mark.parametrize(
    ("device", "message"),
    [("gpu", "must be cpu, cuda or the number of a card as in cuda:1, got 'gpu'"), ("meta", "cannot compute there"),
     ("cuda:7", "finds 2 CUDA devices"), ("", "must be cpu, cuda")],
)  # fmt: skip
def test_a_device_that_is_none(device, message, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    text = refused(["render", "--device", device], capsys)
    assert message in text
    assert len(text) < 200


def test_a_cluster_may_have_the_card(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(choice_module, "choose_engine", lambda *a, **k: Processes(1))
    monkeypatch.setattr(compare_module, "compare", lambda *a: {tmp_path: Comparison({}, {})})
    main(["compare", "--out", str(tmp_path), "--device", "cuda", "--address", "head:6379"])


@pytest.mark.parametrize("arguments", [["garden"], ["--path", "garden"], ["garden", "--path", "garden"]])
def test_the_scene_of_a_training_may_be_given_either_way(arguments, monkeypatch, capsys, tmp_path):
    asked = []
    monkeypatch.setattr(run_module, "run_experiment", lambda scene, config, out, **rest: asked.append(scene))
    monkeypatch.setattr(tables, "summary", lambda results: "")
    main(["train", *arguments, "--views", "5", "--out", str(tmp_path)])
    assert asked == [SceneOptions("garden", views=5)]
    assert "not both: got garden and fern" in refused(["train", "garden", "--path", "fern"], capsys)


def test_a_ply_is_known_by_its_name(monkeypatch):
    asked: list = []
    monkeypatch.setattr(score_module, "score_ply", lambda ply, *rest, **named: asked.append(str(ply)))
    main(["evaluate", "somewhere/a.PLY"])
    assert asked == ["somewhere/a.PLY"]


@pytest.mark.parametrize("engine", ["torch", "loops"])
def test_the_engine_is_chosen_said_and_noted(engine, trained, capsys, tmp_path, monkeypatch):
    if engine == "loops":
        pytest.importorskip("numba")
    monkeypatch.setenv("CA_REG_ENGINE", "auto")  # which the option changes, for workers
    main(["evaluate", str(trained), "--samples", "2", "--engine", engine, "--out", str(tmp_path)])
    said = capsys.readouterr().out.splitlines()
    assert [line.startswith(f"Engine: {engine}") for line in said].count(True) == 1
    noted = json.loads((tmp_path / "evaluation.json").read_text())["machine"]["engine"]
    assert f"Engine: {noted}" in said


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
    assert (tmp_path / "flight" / "flight.gif").exists()


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
def test_a_ply_on_a_scene_or_an_orbit(flag, monkeypatch):
    asked: list = []
    monkeypatch.setattr(score_module, "score_ply", lambda *given, **named: asked.append((given, named)))
    main(
        [
            "evaluate",
            "a.ply",
            flag,
            "garden",
            "--images",
            "images_8",
            "--views",
            "12",
            "--regularizer",
            "noise",
        ]
    )
    main(["evaluate", "a.ply", "--cameras", "3", "--size", "64", "--world", "z-up", "--arc", "90",
          "--background", "white", "--samples", "7", "--seed", "1", "--out", "o"])  # fmt: skip
    ((ply, scene, out), named), ((other, orbit, folder), others) = asked
    assert (str(ply), scene.path, scene.images, scene.views, out) == ("a.ply", "garden", "images_8", 12, None)
    assert named == {"regularizer": "noise", "samples": 5, "seed": 0, "device": "cpu", "perceptual": None,
                     "background": "auto"}  # fmt: skip
    assert (str(other), orbit, str(folder)) == ("a.ply", OrbitOptions(3, 64, "z-up", 90.0), "o")
    assert others == {"regularizer": None, "samples": 7, "seed": 1, "device": "cpu", "background": "white",
                      "perceptual": None}  # fmt: skip


def test_an_orbit_and_a_baked_ply(trained, capsys, tmp_path):
    small = ["--cameras", "1", "--size", "24", "--samples", "2"]
    main(["bake", str(trained / "point_cloud.ply"), "--out", str(tmp_path / "baked.ply")])
    said = plain(capsys.readouterr().out)
    assert "baked.ply: opacities are those of the test after dropout(0.2), and marked so" in said
    main(["evaluate", str(tmp_path / "baked.ply"), *small])
    out = capsys.readouterr().out
    assert "0.8 baked in, taken out for CA; trained with: dropout(0.2)" in out
    assert "| mean orbit |" in out
    ply = str(trained / "point_cloud.ply")
    main(["evaluate", ply, "--out", str(tmp_path / "p"), *small])
    one, other = (
        json.loads((tmp_path / folder / "evaluation.json").read_text()) for folder in ("baked_evaluation", "p")
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
    chosen = ["--recipe", recipe] if recipe else []
    main(["train", *chosen, "--iterations", "3000", "--densify-from", "70", "--noise", "0.8", "--path", "fern",
          "--images", "images_8", "--views", "5", "--out", str(tmp_path)])  # fmt: skip
    given = {"iterations": 3_000, "densify_from": 70, "noise": 0.8}
    expected = with_recipe(recipe, **given) if recipe else TrainConfig(**given)  # at which nothing scales
    assert asked["config"] == expected
    assert asked["scene"] == SceneOptions("fern", images="images_8", views=5)
    assert asked["out"] == tmp_path


def test_recipes_are_listed(capsys):
    main(["recipes"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == list(RECIPES)
    assert all("Needs" in line and "Differs" in line for line in lines)


def test_the_recipe_of_binocular_decays_opacities(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(run_module, "run_experiment", lambda scene, config, out, **rest: asked.append(config))
    monkeypatch.setattr(tables, "summary", lambda results: "")
    main(["train", "--iterations", "3", "--recipe=binocular", "--out", str(tmp_path)])
    assert (asked[0].opacity_decay, asked[0].iterations) == (0.995, 3)


@pytest.mark.parametrize(
    ("given", "rates"),
    [([], {"baseline": (0.0, 0.0), "dropout": (0.2, 0.0), "noise": (0.0, 0.8), "both": (0.2, 0.8)}),
     (["--strategies", "baseline", "both", "--dropout", "0.3", "--noise", "0.1"],
      {"baseline": (0.0, 0.0), "both": (0.3, 0.1)})],
)  # fmt: skip
def test_what_is_compared(given, rates, monkeypatch, tmp_path):
    asked: dict = {}

    def fake(scenes, configs, seeds, running):
        asked.update(scenes=scenes, configs=configs, seeds=list(seeds), running=running)
        return {}

    monkeypatch.setattr(compare_module, "compare", fake)
    main(["compare", "--out", str(tmp_path), "--seeds", "2", "--jobs", "3", "--iterations", "7", *given])
    assert {name: (config.dropout, config.noise) for name, config in asked["configs"].items()} == rates
    assert {config.iterations for config in asked["configs"].values()} == {7}
    assert (asked["seeds"], asked["running"].engine.jobs) == ([0, 1], 3)
    assert asked["scenes"] == {tmp_path: SceneOptions()}


def test_several_scenes_and_how_they_are_run(monkeypatch, tmp_path):
    asked: dict = {}

    def fake(scenes, configs, seeds, running):
        asked.update(scenes=scenes, running=running)
        return {tmp_path / "fern": Comparison({}, {"baseline, seed 0": Failure("ValueError: no", "")})}

    monkeypatch.setattr(compare_module, "compare", fake)
    with pytest.raises(SystemExit) as exit_:
        main(["compare", "--out", str(tmp_path), "--path", "data/fern", "synthetic", "--downscale", "2",
              "--executor", "processes", "--retries", "1", "--checkpoint-every", "50"])  # fmt: skip
    assert exit_.value.code == 1  # a run failed
    assert asked["scenes"] == {
        tmp_path / "fern": SceneOptions("data/fern", downscale=2.0),
        tmp_path / "synthetic": SceneOptions("synthetic", downscale=2.0),
    }
    assert (asked["running"].retries, asked["running"].checkpoint_every) == (1, 50)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["attribution", "r"], ("r", None, {"split": "test", "drop_rate": 0.5})),
        (["attribution", "r", "--out", "o", "--split", "train", "--drop-rate", "0.3"],
         ("r", "o", {"split": "train", "drop_rate": 0.3})),
    ],
)  # fmt: skip
def test_attribution(arguments, expected, monkeypatch):
    asked = []

    def fake(run, out, **keywords):
        asked.append((str(run), out and str(out), keywords))

    monkeypatch.setattr(shares_module, "study_attribution", fake)
    main(["study", *arguments])
    source, out, keywords = expected
    assert asked == [(source, out, {**keywords, "device": "cpu"})]


def test_error_runtime(monkeypatch):
    declared, ran = [], []
    monkeypatch.setattr(
        error_runtime_module, "error_runtime_study", lambda runs, **keywords: declared.append((runs, keywords))
    )
    monkeypatch.setattr(study_module, "run_study", lambda study, out: ran.append(out))
    main(["study", "error-runtime", "r", "s", "--seeds", "2", "--out", "o"])
    assert declared == [((Path("r"), Path("s")), {"max_samples": 1024, "seeds": 2, "device": "cpu"})]
    assert ran == [Path("o")]


# Mistakes end with one line that says what to do, and exit code 2


def test_an_unknown_scene(capsys, tmp_path):
    text = refused(["train", "--path", str(tmp_path / "fren"), "--out", str(tmp_path / "out")], capsys)
    assert text == f"ca-reg: there is no scene folder {tmp_path / 'fren'}; for the built-in scene, say 'synthetic'."
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--dropout", "1.5"], "dropout must be in [0, 1), got 1.5"),
        (["train", "--sh-every", "-1"], "sh_every must be at least 0, got -1"),
        (["train", "--downscale", "0.5"], "downscale must be at least 1"),
        (["compare", "--seeds", "0"], "at least 1 scene, 1 strategy and 1 seed"),
        (["compare", "--jobs", "0"], "at least 1 job, got 0"),
        (["compare", "--path", "a/fern", "b/fern"], "scenes whose folders have different names"),
        (["compare", "--retries", "-1"], "retries of at least 0"),
        (["compare", "--executor", "processes", "--address", "auto"], "--address auto is that of a Ray cluster"),
        (["evaluate", "nowhere"], "nowhere holds no run (no config.json): give the --out folder"),
        (["render", "nowhere"], "nowhere holds no run"),
        (["evaluate", "nowhere.ply"], "nowhere.ply"),
        (["evaluate", "a.ply", "--downscale", "8"], "without photographs no option of a scene but --background"),
        (
            ["evaluate", "a.ply", "--scene", "synthetic", "--cameras", "3"],
            "the options of an orbit do not apply",
        ),
        (["evaluate", "a.ply", "--lpips", "installed"], "give --path"),
        (["evaluate", "run", "--scene", "synthetic"], "run is no PLY, and a run is looked at on its own scene"),
        (["view", "run", "--background", "white"], "run is no PLY, and a run is looked at on its own scene"),
        (["clean", "a.ply", "--views", "3"], "without photographs no option of a scene but --background"),
        (["compare", "--regularizer", "d2gs"], "--strategies says what is compared"),
        (["compare", "--analytic", "--dropout", "0.2"], "--strategies says what is compared"),
        (["evaluate", "a.ply", "--background", "red"], "background must be one of black, white, got 'red'"),
        (["bake", "nowhere.ply"], "nowhere.ply"),
        (["train", "--regularizer", "dropot(0.2)"], "there is no regularizer 'dropot'; choose one of"),
        (["train", "--loss", "photometric(2.0)"], "lambda_dssim must lie in [0, 1], got 2.0"),
        (["train", "--density", "none"], "there is no density strategy 'none'"),
    ],
)
def test_mistakes(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = refused(arguments, capsys)
    assert text.startswith("ca-reg: ")
    assert message in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--recipe", "gsplat"], "gsplat"),
        (["train", "--recipe", "fsgs", "--iterations", "few"], "few"),
        (["fly"], "fly"),
        (["train", "--dropuot", "0.2"], "--dropuot"),
    ],
)
def test_what_cannot_be_parsed(arguments, message, capsys):
    assert message in refused(arguments, capsys)


def test_other_settings_in_the_same_folder(trained, capsys):
    text = refused(["train", "--out", str(trained), "--dropout", "0.3", *SMALL], capsys)
    assert "holds a run with other settings (dropout: 0.2 -> 0.3)" in text


def test_an_interruption(monkeypatch, capsys, tmp_path):
    def interrupt(*args, **keywords):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "run_experiment", interrupt)
    with pytest.raises(SystemExit) as exit_:
        main(["train", "--out", str(tmp_path)])
    assert exit_.value.code == 130
    assert "the same command goes on from what is finished" in capsys.readouterr().err


def test_the_real_arguments_are_the_default(monkeypatch, capsys):
    monkeypatch.setattr(cli.sys, "argv", ["ca-reg", "evaluate", "nowhere"])
    with pytest.raises(SystemExit):
        main()
    assert "nowhere holds no run" in capsys.readouterr().err


@pytest.mark.slow
def test_a_reader_that_has_seen_enough_is_no_error():
    code = "from reference_trainer.cli import main; main(['study', 'attribution', '--help'])"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert b"ca-reg:" not in process.stderr.read()
