"""The commands about several runs: what they ask of the comparison and of the studies."""

from pathlib import Path

import pytest
import torch

from reference_trainer.cli import main
from reference_trainer.runs import compare as compare_module
from reference_trainer.runs.compare_report import Comparison
from reference_trainer.runs.engines import choice as choice_module
from reference_trainer.runs.engines.engine import Failure
from reference_trainer.runs.engines.processes import Processes
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies import error_runtime as error_runtime_module
from reference_trainer.studies import gaussian_shares as shares_module
from reference_trainer.studies import study as study_module


def test_a_cluster_may_have_the_card(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(choice_module, "choose_engine", lambda *a, **k: Processes(1))
    monkeypatch.setattr(compare_module, "compare", lambda *a: {tmp_path: Comparison({}, {})})
    main(["compare", "--out", str(tmp_path), "--device", "cuda", "--address", "head:6379"])


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
