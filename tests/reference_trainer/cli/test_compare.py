"""What `ca-reg compare` asks of the comparison."""

from pathlib import Path

import pytest
import torch

from reference_trainer.cli import main
from reference_trainer.report import page as page_module
from reference_trainer.runs import compare as compare_module
from reference_trainer.runs import executors as choice_module
from reference_trainer.runs.compare import Comparison
from reference_trainer.runs.executors import Failure, Processes
from reference_trainer.scenes.options import SceneOptions


def test_a_cluster_may_have_the_card(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(choice_module, "choose_executor", lambda *a, **k: Processes(1))
    monkeypatch.setattr(compare_module, "compare", lambda *a: {tmp_path: Comparison({}, {})})
    main(["compare", "--out", str(tmp_path), "--device", "cuda", "--address", "head:6379"])


@pytest.mark.parametrize(
    ("given", "rates"),
    [([], {"baseline": (0.0, 0.0), "dropout": (0.2, 0.0), "noise": (0.0, 0.8), "both": (0.2, 0.8)}),
     (["--strategies", "baseline", "both", "--dropout", "0.3", "--noise", "0.1", "--seed", "5"],
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
    assert (asked["seeds"], asked["running"].executor.jobs) == ([5, 6] if given else [0, 1], 3)
    assert asked["scenes"] == {tmp_path: SceneOptions()}


def test_several_scenes_and_how_they_are_run(monkeypatch, tmp_path):
    asked: dict = {}

    def fake(scenes, configs, seeds, running):
        asked.update(scenes=scenes, running=running)
        return {tmp_path / "fern": Comparison({}, {"baseline, seed 0": Failure("ValueError: no", "")})}

    monkeypatch.setattr(compare_module, "compare", fake)
    monkeypatch.chdir(tmp_path)
    Path("data/fern").mkdir(parents=True)
    with pytest.raises(SystemExit) as exit_:
        main(["compare", "--out", str(tmp_path), "--path", "data/fern", "synthetic", "--downscale", "2",
              "--executor", "processes", "--retries", "1", "--checkpoint-every", "50"])  # fmt: skip
    assert exit_.value.code == 1  # a run failed
    assert asked["scenes"] == {
        tmp_path / "fern": SceneOptions("data/fern", downscale=2.0),
        tmp_path / "synthetic": SceneOptions("synthetic", downscale=2.0),
    }
    assert (asked["running"].retries, asked["running"].monitoring.checkpoint_every) == (1, 50)


def test_a_page_that_is_refused_does_not_stop_the_others(capsys, monkeypatch, tmp_path):
    """A run that was there before may be of another scene, or of code that this command line does not name."""
    pages = []

    def fake(folders, **options):
        if folders == [tmp_path / "fern"]:
            raise ValueError("If it is yours, say --trust mine.")
        pages.extend(folders)

    found = {tmp_path / name: Comparison({"baseline": []}, {}) for name in ("fern", "lego")}
    monkeypatch.setattr(compare_module, "compare", lambda *a: found)
    monkeypatch.setattr(compare_module, "report", lambda comparisons: None)
    monkeypatch.setattr(page_module, "write_report", fake)
    with pytest.raises(SystemExit) as exit_:
        main(["compare", "--out", str(tmp_path)])
    assert (exit_.value.code, pages) == (1, [tmp_path / "lego"])
    said = capsys.readouterr().err
    assert "--trust mine" in said
    assert f"ca-reg report {tmp_path / 'fern'}" in said
