"""`ca-reg plan`, and what a training takes from the plan."""

import dataclasses
import json
import re

import pytest

from reference_trainer.cli import main
from reference_trainer.cli.training import given_fields
from reference_trainer.runs import run as run_module
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.plan import Plan


@pytest.fixture
def asked(monkeypatch) -> dict:
    """What `ca-reg train` asks of the run."""
    found: dict = {}

    def stop(options, config, out, **keywords):
        found.update(keywords, config=config)
        raise ValueError("stopped here")

    monkeypatch.setattr(run_module, "run_experiment", stop)
    return found


def test_plan_prints_every_item_and_writes_it(capsys, tmp_path):
    main(["plan", "synthetic", "--downscale", "8", "--verbose", "--out", str(tmp_path / "plan.json")])
    said = capsys.readouterr().out
    plan = Plan.from_dict(json.loads((tmp_path / "plan.json").read_text()))
    assert len(plan.items) > 10
    for item in plan.items:
        assert f"| {item.name} | {item.decision} |" in said
        assert item.reason in said


def test_plan_says_in_a_few_lines_what_matters(capsys):
    """Pictures, views, changes, whether dropout is recommended, with losses where some were measured, and an option."""
    main(["plan", "synthetic", "--downscale", "8"])
    photographs, train, test, changes, dropout, start = capsys.readouterr().out.splitlines()
    assert photographs.endswith("20x15 pixels")
    assert train == "3 training views: train_0, train_1, train_2"
    assert test == "3 test views: test_0, test_1, test_outside"
    assert changes.startswith("Training changes ")
    assert changes.endswith("--verbose")
    assert re.search(r"^Dropout is .*; 3 views, .* [-+]\d\.\d to [-+]\d\.\d dB", dropout)
    assert "--points dense" in start


def test_the_scene_may_be_given_either_way(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garden").mkdir()
    loaded: list[SceneOptions] = []

    def load(options, **_):
        loaded.append(options)
        raise OSError

    monkeypatch.setattr("reference_trainer.scenes.load.load_scene", load)
    for arguments in (["garden"], ["--path", "garden"], []):
        with pytest.raises(SystemExit):
            main(["plan", *arguments, "--views", "5"])
    assert [(options.path, options.views) for options in loaded] == [("garden", 5), ("garden", 5), ("synthetic", 5)]


def test_an_option_at_its_default_is_still_the_users(capsys):
    arguments = ["plan", "--downscale", "8", "--iterations", "400", "--sh-every", "500"]
    main(arguments)
    assert "sh_degree=0" in capsys.readouterr().out
    main([*arguments, "--sh-degree", "3", "--verbose"])
    assert "asked for (sh_degree=3)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "auto", "given"),
    [
        ([], True, set()),
        (["--no-auto"], False, set()),
        (["--auto", "--sh_degree=3", "--no-analytic"], True, {"sh_degree", "analytic"}),
        (["--recipe", "binocular", "--seed", "4"], True, {"seed"}),
    ],
)
def test_train_passes_on_what_was_given(asked, options, auto, given):
    with pytest.raises(SystemExit):
        main(["train", *options])
    assert asked["auto"] is auto
    assert asked["given"] == given


def test_a_value_is_not_an_option():
    assert given_fields(["train", "--out", "seed", "--lpips", "noise"]) == frozenset()


def test_plan_says_what_the_loader_did(tiny_scene, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garden").mkdir()
    noted = dataclasses.replace(tiny_scene, notes=("lens distortion is undone",))
    monkeypatch.setattr("reference_trainer.scenes.load.load_scene", lambda *_, **__: noted)
    main(["plan", "garden"])
    assert capsys.readouterr().out.splitlines()[3] == "lens distortion is undone"
