import dataclasses
import json
import math
import os
import shlex
import shutil
import statistics
from pathlib import Path

import pytest
import sweep_tasks
import torch
from stand_ins.executor import Here
from subprocesses import PYTHONPATH

from ca_reg.monitor import LOG_NAME
from reference_trainer.cli.options import RenderOptions
from reference_trainer.cli.training import Demo
from reference_trainer.evaluation.pictures import save_png
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.tables import comparison_table, summary
from reference_trainer.render import chosen_engine
from reference_trainer.runs import compare as compare_module
from reference_trainer.runs import grid
from reference_trainer.runs.compare import (
    COMPARISON,
    NAMED,
    TABLE,
    Comparison,
    compare,
    report,
    scene_folders,
    strategies,
)
from reference_trainer.runs.executors import Failure, choose_executor
from reference_trainer.runs.folder import RESULTS, check_run, run_settings
from reference_trainer.runs.grid import Running
from reference_trainer.runs.measure import render_run
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import PointCloud
from reference_trainer.training.config import TrainConfig


def cells(table: str) -> list[dict[str, str]]:
    """Read a Markdown table."""
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.strip().splitlines()]
    return [dict(zip(head, row, strict=True)) for row in rows]


def made(psnr: float | None, gaussians: int = 1000) -> dict:
    """The part of ``results.json`` that a table needs."""
    return {
        "gaussians": gaussians,
        "seconds": 2.0,
        "mean": {"test": {"psnr": psnr, "ca_exact_half": 2e-3, "lpips": None}},
    }


def test_the_table_has_mean_and_sample_deviation():
    runs = {"baseline": [made(18.0, 1000), made(19.0, 3000), made(20.0, 2000)], "dropout": [made(21.0)]}
    first, second = cells(comparison_table(runs))
    assert first["strategy"] == "baseline"
    assert first["seeds"] == "3"
    assert first["test PSNR (dB)"] == "19.00 ± 1.00"
    assert first["test exact CA (1e-3)"] == "2.00 ± 0.00"
    assert first["Gaussians"] == "2000 ± 1000"
    assert second["test PSNR (dB)"] == "21.00"
    assert "test LPIPS" not in first  # measured nowhere
    assert "train PSNR (dB)" not in first


def test_a_quality_that_one_strategy_lacks():
    first, second = cells(comparison_table({"a": [made(None)], "b": [made(20.0)]}))
    assert (first["test PSNR (dB)"], second["test PSNR (dB)"]) == ("n/a", "20.00")


def test_the_table_says_how_many_seeds_have_a_score(tmp_path):
    """Also where a file has null in its place, which is how JSON says nan."""
    write_json(tmp_path / "results.json", made(math.nan))
    unknown = json.loads((tmp_path / "results.json").read_text())
    (row,) = cells(comparison_table({"a": [made(18.0), unknown, made(20.0)]}))
    assert (row["seeds"], row["test PSNR (dB)"]) == ("3", "19.00 ± 1.41 (2 of 3)")


def test_strategies_change_the_regularizers_only():
    base = TrainConfig(iterations=5, seed=3, dropout=0.4)
    for config in strategies(list(NAMED), base, dropout=0.1, noise=0.5).values():
        assert dataclasses.replace(config, dropout=0.4, noise=0.0, analytic=False) == base
    assert strategies(["both"], base, dropout=0.1, noise=0.5)["both"] == dataclasses.replace(
        base, dropout=0.1, noise=0.5
    )


SCENE, CONFIG = {Path("x"): SceneOptions()}, {"a": TrainConfig()}


@pytest.mark.parametrize(("scenes", "configs", "seeds"), [({}, CONFIG, [0]), (SCENE, {}, [0]), (SCENE, CONFIG, [])])
def test_nothing_to_compare(scenes, configs, seeds):
    with pytest.raises(ValueError, match=r"1 scene, 1 strategy .*1 seed"):
        compare(scenes, configs, seeds, Running(Here()))


def test_scenes_of_the_same_name_would_share_a_folder(tmp_path):
    with pytest.raises(ValueError, match="different names"):
        scene_folders([str(tmp_path / "a" / "fern"), str(tmp_path / "b" / "fern")], SceneOptions(), tmp_path)


def test_the_options_hold_for_every_scene(tmp_path):
    folders = scene_folders(["synthetic", "data/fern/"], SceneOptions(downscale=4.0), tmp_path)
    assert folders == {
        tmp_path / "synthetic": SceneOptions("synthetic", downscale=4.0),
        tmp_path / "fern": SceneOptions("data/fern/", downscale=4.0),
    }


def test_a_grid_of_scenes_strategies_and_seeds(tmp_path, monkeypatch, said):
    """One run of eight fails; every scene has its own table and its own failures."""

    def train(options, config, out, engine, how):
        assert engine == chosen_engine()
        lpips = str(Path("weights.pth").resolve())
        asked = {"device": "cpu", "monitoring": Monitoring(7, checkpoint_every=9), "lpips": lpips}
        assert how == asked | {"auto": False, "progress": False}
        assert out.is_dir()
        assert out.is_absolute()
        if (options.path, config.dropout, config.seed) == ("synthetic", 0.2, 1):
            raise RuntimeError("all Gaussians were pruned")
        return made(20.0 + config.seed) | {"scene": options.path, "dropout": config.dropout}

    monkeypatch.setattr("reference_trainer.runs.grid.train_run", train)
    monkeypatch.chdir(tmp_path)
    engine = Here()
    scenes = scene_folders(["synthetic", "data/fern"], SceneOptions(), Path("out"))
    configs = {"baseline": TrainConfig(), "dropout": TrainConfig(dropout=0.2)}
    running = Running(engine, monitoring=Monitoring(7, checkpoint_every=9), lpips="weights.pth")
    comparisons = compare(scenes, configs, [0, 1], running)

    assert len({task.arguments[2] for task in engine.tasks}) == 8
    assert list(comparisons) == [Path("out/synthetic"), Path("out/fern")]
    synthetic, fern = comparisons.values()
    assert {name: [run["mean"]["test"]["psnr"] for run in runs] for name, runs in synthetic.runs.items()} == {
        "baseline": [20.0, 21.0],
        "dropout": [20.0],
    }
    assert {run["scene"] for run in fern.runs["dropout"]} == {str(tmp_path / "data" / "fern")}
    assert fern.failures == {}
    assert list(synthetic.failures) == ["dropout, seed 1"]
    assert "synthetic, dropout, seed 1: FAILED, RuntimeError" in said[5]
    stored = json.loads(Path("out/synthetic", COMPARISON).read_text())
    assert stored["failures"]["dropout, seed 1"]["error"].startswith("RuntimeError: all Gaussians")
    assert "in train" in stored["failures"]["dropout, seed 1"]["traceback"]
    assert [row["seeds"] for row in cells(Path("out/fern", TABLE).read_text())] == ["2", "2"]


@pytest.mark.parametrize(
    ("changes", "lacking"),
    [({"loss": "pearson"}, "--depth"), ({"models": 2, "loss": "co_regularization"}, "no initial point")],
)
def test_what_a_scene_lacks_is_said_once_before_any_run(changes, lacking, tmp_path, monkeypatch):
    nothing = PointCloud(torch.empty(0, 3), torch.empty(0, 3), "nowhere")
    scene = dataclasses.replace(synthetic_scene(width=32, height=24, points=9), points=nothing)
    monkeypatch.setattr("reference_trainer.runs.compare.load_scene", lambda _: scene)
    engine = Here()
    with pytest.raises(ValueError, match=lacking):
        compare({tmp_path: SceneOptions()}, {"a": TrainConfig(**changes)}, [0, 1], Running(engine))
    assert engine.tasks == []


def test_a_comparison_is_not_made_in_the_folder_of_a_run(tmp_path):
    """Its page, and every other report on the folder, would show that run alone."""
    write_json(tmp_path / "config.json", run_settings(SceneOptions(), TrainConfig()))
    with pytest.raises(ValueError, match=r"a run itself .*--out"):
        compare({tmp_path: SceneOptions()}, {"a": TrainConfig()}, [0], Running(Here()))


def test_somebody_elses_page_is_noticed_before_the_training(tmp_path):
    (tmp_path / "report.html").write_text("precious")
    engine = Here()
    with pytest.raises(ValueError, match="not overwritten"):
        compare({tmp_path: SceneOptions()}, {"a": TrainConfig(iterations=1)}, [0], Running(engine))
    assert engine.tasks == []


def test_the_folder_of_several_comparisons_says_so(tmp_path):
    for scene in ("fern", "lego"):
        write_json(tmp_path / scene / COMPARISON, {"runs": {}})
        write_json(tmp_path / scene / "baseline/seed_0/config.json", run_settings(SceneOptions(), TrainConfig()))
    with pytest.raises(FileNotFoundError, match=r"2 scenes: .*such as .*fern"):
        check_run(tmp_path)


def test_other_settings_leave_a_finished_comparison_as_it_is(tmp_path):
    write_json(tmp_path / "a/seed_0/config.json", run_settings(SceneOptions(), TrainConfig()))
    (tmp_path / COMPARISON).write_text("the results")
    with pytest.raises(ValueError, match=r"seed_0 .*\(dropout: 0\.0 -> 0\.3\)"):
        compare({tmp_path: SceneOptions()}, {"a": TrainConfig(dropout=0.3)}, [0, 1], Running(Here()))
    assert (tmp_path / COMPARISON).read_text() == "the results"


def test_strategies_that_are_compared_later_stand_beside_those_of_before(tmp_path, monkeypatch):
    """But for those that were trained for another time, or on other views."""
    results = {**made(20.0), "config": {"seed": 3}, "views": [{"name": "a", "split": "train"}]}
    results["mean"]["train"] = {}
    short, others = TrainConfig(iterations=7), (SceneOptions(), SceneOptions(views=2))
    for name, options, config in (
        ("before", others[0], dataclasses.replace(short, noise=0.3, seed=3)),
        ("longer", others[0], TrainConfig(iterations=8)),
        ("narrower", others[1], short),
    ):
        write_json(tmp_path / name / "seed_3/config.json", run_settings(options, config))
        write_json(tmp_path / name / "seed_3" / RESULTS, results)
    monkeypatch.setattr("reference_trainer.runs.grid.train_run", lambda *_: made(21.0))
    compare({tmp_path: SceneOptions()}, {"new": short}, [0], Running(Here()))
    assert [row["strategy"] for row in cells((tmp_path / TABLE).read_text())] == ["before", "new"]
    assert list(json.loads((tmp_path / COMPARISON).read_text())["runs"]) == ["before", "new"]


def test_failed_runs_are_listed_at_the_end(tmp_path, said):
    report({tmp_path: Comparison({}, {"a, seed 0": Failure("ValueError: no", "Traceback")})})
    assert said[-2].startswith("1 of 1 runs FAILED")
    assert said[-1].startswith(f"FAILED a, seed 0: ValueError: no ({tmp_path / COMPARISON}")


@pytest.mark.slow
def test_all_photographs_are_trained_on(tmp_path, options, short, monkeypatch, said):
    """Nothing is held out: exact CA is reported at the training views, between them and around them."""
    options = dataclasses.replace(options, test="none")
    results = run_experiment(options, short, tmp_path / "a" / "seed_0")
    assert sum(line.startswith("No test views") for line in said) == 1
    assert list(results["mean"]) == ["train", "between", "around"]
    assert all(isinstance(results["mean"][split]["ca_exact"], float) for split in results["mean"])
    assert [split for split in results["mean"] if results["mean"][split]["psnr"] is not None] == ["train"]
    assert "| between | n/a |" in summary(results)
    (row,) = cells(comparison_table({"a": [results]}))
    for split in ("train", "between", "around"):
        assert row[f"{split} exact CA (1e-3)"] == f"{1e3 * results['mean'][split]['ca_exact_half']:.2f}"
    assert not any(title.startswith("test") for title in row)
    report({tmp_path: Comparison({"a": [results]}, {})})
    names = {f"{view['split']}_{view['name']}.png" for view in results["views"] if view["split"] != "train"}
    assert {path.name for path in tmp_path.glob("*.png")} == {"dynamics.png", *names}
    with pytest.raises(ValueError, match=r"test view: .*--what train"):
        render_run(tmp_path / "a" / "seed_0", "test")


@pytest.mark.parametrize("lines", [None, ""])
def test_runs_without_a_measurement_get_their_pictures_all_the_same(tmp_path, lines, said):
    """As after --monitor-every 0, or fewer steps than that."""
    out = tmp_path / "my runs"
    results = made(20.0) | {"config": {"seed": 0}, "views": [{"split": "test", "name": f"{x}/r_0.png"} for x in "ab"]}
    for strategy, width in (("baseline", 90), ("dropout", 84)):  # a label with a digit less makes a narrower panel
        folder = out / strategy / "seed_0"
        for name in ("a_r_0", "b_r_0"):
            save_png(folder / "views" / "test" / f"{name}_panel.png", torch.rand(3, 8, width))
        if lines is not None:
            (folder / LOG_NAME).write_text(lines)
    comparisons = {out: Comparison({"baseline": [results], "dropout": [results]}, {})}
    (out / "test_a_r_0.png").write_bytes(b"somebody else's")
    report(comparisons)
    assert (out / "test_a_r_0.png").read_bytes() == b"somebody else's"
    assert any(line.startswith("no figure of CA and PSNR") for line in said)
    assert sorted(path.name for path in out.glob("*.png")) == ["test_a_r_0.png", "test_b_r_0.png"]
    (logs,) = (line for line in said if "tensorboard" in line)
    assert shlex.split(logs.partition("curves: ")[2]) == ["tensorboard", "--logdir", str(out)]
    shutil.rmtree(out / "baseline/seed_0/views")  # takes nothing but these pictures from a comparison
    report(comparisons)
    assert any(line.startswith("no pictures of the views") for line in said)
    assert "tensorboard" in said[-1]


def test_a_worker_that_does_not_share_the_folder_does_not_train(tmp_path, options):
    """As on another machine of a cluster: the folder of the run is not there."""

    class Elsewhere(Here):
        def start(self, number, task):
            task.arguments[2].rmdir()
            super().start(number, task)

    comparison = compare({tmp_path: options}, {"a": TrainConfig(iterations=2)}, [0], Running(Elsewhere()))[tmp_path]
    assert "file system that all machines" in comparison.failures["a, seed 0"].error
    assert not (tmp_path / "a" / "seed_0").exists()


@pytest.mark.parametrize("wrong", [{"retries": -1}])
def test_what_running_refuses(wrong):
    with pytest.raises(ValueError, match=rf"{next(iter(wrong))} of at least \d"):
        Running(Here(), **wrong)


def test_the_demo_is_a_comparison_of_all_strategies(tmp_path, monkeypatch):
    asked: dict = {}

    def fake(scenes, configs, seeds, running):
        asked.update(scenes=scenes, configs=configs, seeds=list(seeds), running=running)
        return {tmp_path: Comparison({}, {})}

    monkeypatch.setattr(compare_module, "compare", fake)
    monkeypatch.setattr(compare_module, "report", lambda comparisons: None)
    monkeypatch.setattr(RenderOptions, "begin", lambda self, device, trains: None)
    Demo(tmp_path, iterations=4, seeds=2, jobs=2)()
    assert list(asked["configs"]) == ["baseline", "dropout", "noise", "both"]
    assert {config.iterations for config in asked["configs"].values()} == {4}
    assert asked["scenes"] == {tmp_path: SceneOptions("synthetic")}
    running = asked["running"]
    assert (running.monitoring.every, running.executor.jobs, asked["seeds"]) == (1, 2, [0, 1])


@pytest.mark.slow
def test_a_comparison_from_photographs_to_figures(tmp_path, options, said):
    """Two strategies and two seeds; a third strategy loses all its Gaussians, one run is there already."""
    base = TrainConfig(iterations=6, densify_from=1, densify_every=2, densify_gradient=1e9)
    configs = {
        "baseline": base,
        "dropout": dataclasses.replace(base, dropout=0.2),
        "doomed": dataclasses.replace(base, prune_opacity=0.99),
    }
    run_experiment(options, configs["dropout"], tmp_path / "dropout" / "seed_0", monitoring=Monitoring(3))
    before = (tmp_path / "dropout" / "seed_0" / RESULTS).stat().st_mtime_ns
    running = Running(Here(), monitoring=Monitoring(3))
    comparison = compare({tmp_path: options}, configs, [0, 1], running)[tmp_path]
    assert (tmp_path / "dropout" / "seed_0" / RESULTS).stat().st_mtime_ns == before
    assert {name: [run["config"]["seed"] for run in runs] for name, runs in comparison.runs.items()} == {
        "baseline": [0, 1],
        "dropout": [0, 1],
    }
    assert sorted(comparison.failures) == ["doomed, seed 0", "doomed, seed 1"]
    for failure in comparison.failures.values():
        assert "TrainingStoppedError: all Gaussians" in failure.error
        assert "in run_experiment" in failure.traceback
    assert sum("FAILED" in line for line in said) == 2
    assert sum(", seed " in line and line.startswith("[") for line in said) == 6  # one line a run

    rows = {row["strategy"]: row for row in cells((tmp_path / TABLE).read_text())}
    for name, runs in comparison.runs.items():
        values = [run["mean"]["test"]["psnr"] for run in runs]
        mean, spread = (float(x) for x in rows[name]["test PSNR (dB)"].split(" ± "))
        assert mean == pytest.approx(statistics.mean(values), abs=0.05)
        assert spread == pytest.approx(statistics.stdev(values), rel=0.06, abs=0.0051)  # half of the last digit shown
    stored = json.loads((tmp_path / COMPARISON).read_text())
    assert stored["runs"] == comparison.runs
    assert stored["failures"] == {name: dataclasses.asdict(why) for name, why in comparison.failures.items()}

    said.clear()
    report({tmp_path: comparison})
    for name in ("dynamics", "test_test_0", "test_test_1", "test_test_outside"):
        assert (tmp_path / f"{name}.png").stat().st_size > 1000, name
    assert (tmp_path / "baseline" / "seed_1" / LOG_NAME).exists()
    assert sum(line.startswith("FAILED doomed") for line in said) == 2


def files_of(folder: Path) -> dict[Path, int]:
    """When every file below a folder was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_a_run_whose_worker_is_killed_ends_as_if_nothing_had_happened(tmp_path, options, monkeypatch, said):
    """Its worker is killed at its first checkpoint; a second call starts no worker and writes no run.

    That other workers go on is tested with those of `Processes`.
    """
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)  # one thread for each of two workers: the bits depend on it
    monkeypatch.setattr("reference_trainer.runs.grid.train_run", sweep_tasks.train_and_be_killed_once)
    config = TrainConfig(iterations=30, dropout=0.2)
    whole = run_experiment(options, dataclasses.replace(config, seed=1), tmp_path / "whole", monitoring=Monitoring(0))

    out = tmp_path / "sweep"
    running = Running(choose_executor("processes", jobs=2), monitoring=Monitoring(0, checkpoint_every=5))
    comparison = compare({out: options}, {"dropout": config}, [1], running)[out]
    assert (out / "dropout" / "seed_1" / "killed").exists()
    assert sum("again with another (1 of 3)" in line for line in said) == 1
    assert comparison.failures == {}
    (run,) = comparison.runs["dropout"]
    assert run["config"]["seed"] == 1
    assert run["views"] == whole["views"]

    before = files_of(out / "dropout")
    said.clear()
    nobody = Here()
    again = compare({out: options}, {"dropout": config}, [1], Running(nobody))[out]
    assert again == comparison
    assert nobody.tasks == []
    assert files_of(out / "dropout") == before
    assert sum(line.endswith("finished before") for line in said) == 1


@pytest.mark.parametrize("chosen", ["torch", "auto"])
def test_a_worker_renders_with_the_engine_of_the_sweep(chosen, tmp_path, options, short, monkeypatch):
    """Also where it does not inherit the environment, as on another machine."""
    monkeypatch.setenv("CA_REG_ENGINE", chosen)
    train = grid.train_run

    def elsewhere(*arguments):
        monkeypatch.setenv("CA_REG_ENGINE", "numba")
        return train(*arguments)

    monkeypatch.setattr(grid, "train_run", elsewhere)
    monkeypatch.setattr(grid, "run_experiment", lambda *arguments, **options: made(20.0) | {"engine": chosen_engine()})
    (outcome,) = grid.run_grid([grid.Run("one", options, short, tmp_path)], Running(Here()))
    assert outcome["engine"] == chosen
