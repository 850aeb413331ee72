import dataclasses
import json
import statistics
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from ca_reg.monitor import LOG_NAME
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies import compare as compare_module
from reference_trainer.studies import demo as demo_module
from reference_trainer.studies.compare import Comparison, compare, comparison_table, report, strategies
from reference_trainer.studies.run import RESULTS, run_experiment
from reference_trainer.training.config import TrainConfig


def cells(table: str) -> list[dict[str, str]]:
    """Read a Markdown table."""
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.strip().splitlines()]
    return [dict(zip(head, row, strict=True)) for row in rows]


def made(psnr: float | None, gaussians: int = 1000) -> dict:
    """The part of ``results.json`` that a table needs."""
    return {"gaussians": gaussians, "seconds": 2.0, "mean": {"test": {"psnr": psnr, "ca": 2e-3, "lpips": None}}}


def test_the_table_has_mean_and_sample_deviation():
    runs = {"baseline": [made(18.0, 1000), made(19.0, 3000), made(20.0, 2000)], "dropout": [made(21.0)]}
    first, second = cells(comparison_table(runs))
    assert first["strategy"] == "baseline"
    assert first["seeds"] == "3"
    assert first["test PSNR"] == "19.0 ± 1.0"
    assert first["test CA x1e-3"] == "2 ± 0"
    assert first["Gaussians"] == "2.0 ± 1.0k"
    assert second["test PSNR"] == "21"
    assert "test LPIPS" not in first  # measured nowhere
    assert "train PSNR" not in first


def test_a_quality_that_one_strategy_lacks():
    first, second = cells(comparison_table({"a": [made(None)], "b": [made(20.0)]}))
    assert (first["test PSNR"], second["test PSNR"]) == ("n/a", "20")


def test_strategies_change_the_regularizers_only():
    base = TrainConfig(iterations=5, seed=3, dropout=0.4)
    for config in strategies(base, dropout=0.1, noise=0.5).values():
        assert dataclasses.replace(config, dropout=0.4, noise=0.0, analytic=False) == base
    assert strategies(base, dropout=0.1, noise=0.5)["both"] == dataclasses.replace(base, dropout=0.1, noise=0.5)


@pytest.mark.parametrize(("configs", "seeds", "jobs"), [({}, [0], 1), ({"a": TrainConfig()}, [], 1),
                                                        ({"a": TrainConfig()}, [0], 0)])  # fmt: skip
def test_nothing_to_compare(tmp_path, configs, seeds, jobs):
    with pytest.raises(ValueError, match="at least 1 strategy, 1 seed and 1 job"):
        compare(SceneOptions(), configs, seeds, tmp_path, jobs=jobs)


def test_a_comparison_without_a_result_is_an_error(tmp_path):
    said: list[str] = []
    with pytest.raises(RuntimeError, match="no run of the comparison"):
        report(Comparison({}, {"a, seed 0": "ValueError: no"}), tmp_path, say=said.append)
    assert said == ["FAILED a, seed 0: ValueError: no"]


def test_the_demo_is_a_comparison_of_all_strategies(tmp_path, monkeypatch):
    asked: dict = {}

    def fake(options, configs, seeds, out, **keywords):
        asked.update(options=options, configs=configs, seeds=seeds, out=out, **keywords)
        return Comparison({}, {})

    monkeypatch.setattr(demo_module, "compare", fake)
    monkeypatch.setattr(demo_module, "report", lambda comparison, out, say: None)
    demo_module.demo(tmp_path, iterations=4, seeds=range(2), jobs=2, say=lambda text: None)
    assert list(asked["configs"]) == ["baseline", "dropout", "noise", "both"]
    assert {config.iterations for config in asked["configs"].values()} == {4}
    assert asked["options"] == SceneOptions("synthetic")
    assert asked["monitor_every"] == 1
    assert (asked["out"], list(asked["seeds"]), asked["jobs"]) == (tmp_path, [0, 1], 2)


def test_an_interruption_does_not_begin_the_other_runs(tmp_path, monkeypatch):
    asked: list[dict] = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, max_workers, mp_context):
            super().__init__(max_workers)

        def submit(self, function, *args):
            return super().submit(threading.Event().wait, 0.01)

        def shutdown(self, wait=True, *, cancel_futures=False):
            asked.append({"wait": wait, "cancel_futures": cancel_futures})
            super().shutdown(wait, cancel_futures=cancel_futures)

    def interrupt(futures):
        raise KeyboardInterrupt

    monkeypatch.setattr(compare_module, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(compare_module, "as_completed", interrupt)
    with pytest.raises(KeyboardInterrupt):
        compare(SceneOptions(), {"a": TrainConfig()}, range(50), tmp_path)
    assert asked[0] == {"wait": False, "cancel_futures": True}


@pytest.mark.slow
def test_a_comparison_from_photographs_to_figures(tmp_path, options):
    """Two strategies and two seeds; a third strategy loses all its Gaussians, one run is there already."""
    base = TrainConfig(iterations=6, densify_from=1, densify_every=2, densify_gradient=1e9)
    configs = {
        "baseline": base,
        "dropout": dataclasses.replace(base, dropout=0.2),
        "doomed": dataclasses.replace(base, prune_opacity=0.99),
    }
    run_experiment(options, configs["dropout"], tmp_path / "dropout" / "seed_0", monitor_every=3)
    before = (tmp_path / "dropout" / "seed_0" / RESULTS).stat().st_mtime_ns
    said: list[str] = []
    comparison = compare(options, configs, [0, 1], tmp_path, jobs=2, monitor_every=3, say=said.append)
    assert (tmp_path / "dropout" / "seed_0" / RESULTS).stat().st_mtime_ns == before
    assert {name: [run["config"]["seed"] for run in runs] for name, runs in comparison.runs.items()} == {
        "baseline": [0, 1],
        "dropout": [0, 1],
    }
    assert sorted(comparison.failures) == ["doomed, seed 0", "doomed, seed 1"]
    assert all("TrainingStoppedError: all Gaussians were pruned" in text for text in comparison.failures.values())
    assert sum("FAILED" in line for line in said) == 2
    assert len(said) == 6

    rows = {row["strategy"]: row for row in cells((tmp_path / compare_module.TABLE).read_text())}
    for name, runs in comparison.runs.items():
        values = [run["mean"]["test"]["psnr"] for run in runs]
        mean, spread = (float(x) for x in rows[name]["test PSNR"].split(" ± "))
        assert mean == pytest.approx(statistics.mean(values), abs=0.05)
        assert spread == pytest.approx(statistics.stdev(values), rel=0.06)
    stored = json.loads((tmp_path / compare_module.REPORT).read_text())
    assert stored["runs"] == comparison.runs
    assert stored["failures"] == comparison.failures

    said.clear()
    report(comparison, tmp_path, say=said.append)
    for name in ("dynamics", "test_test_0", "test_test_1", "test_test_outside"):
        assert (tmp_path / f"{name}.png").stat().st_size > 1000, name
    assert (tmp_path / "baseline" / "seed_1" / LOG_NAME).exists()
    assert sum(line.startswith("FAILED doomed") for line in said) == 2
