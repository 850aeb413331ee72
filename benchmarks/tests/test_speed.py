"""The benchmark on a workload of 60 Gaussians, and its gate."""

import json
import runpy
import sys

import pytest
import torch

from benchmarks import speed as module
from benchmarks.speed import measure_speed
from benchmarks.workloads import WorkloadSpec
from reference_trainer.evaluation.results import write_json
from reference_trainer.scenes import synthetic_scene

TINY = {"tiny": WorkloadSpec(60, 40, 24, 0.05)}


@pytest.fixture
def measure(monkeypatch):
    """A measurement of a second, without processes."""
    peaks = {"forward": 3 << 20, "forward+backward": 5 << 20}
    monkeypatch.setattr(module, "peak_memory", lambda spec, engine, device: peaks)
    scene = synthetic_scene(width=20, height=15, points=60)
    return lambda out, **how: measure_speed(TINY, out, scene=scene, repeats=2, **how)


@pytest.mark.slow
def test_a_tiny_measurement_and_its_gate(tmp_path, measure):
    threads = torch.get_num_threads()
    report = measure(tmp_path)
    assert json.loads((tmp_path / "speed.json").read_text()) == report
    assert torch.get_num_threads() == threads
    tiny = report["workloads"]["tiny"]
    assert all(len(x) == 2 for x in (*tiny["seconds"].values(), *tiny["stages"]["numba"].values()))
    engines = ("numba", "torch")
    ratios = ("forward / baseline", "forward+backward / baseline", "exact score / render", "score, K = 5 / render")
    assert {f"tiny, {e}: {x}" for e in engines for x in (*ratios, "two threads / one")} <= set(report["ratios"])
    parts = ("analytic / sampled", "renderer / step", "loss / step", "optimizer / step")
    assert {f"step, {e}: {x}" for e in engines for x in parts} <= set(report["ratios"])
    assert len(report["errors"]) == 2 * (2 + 5)
    assert all(0 < x < 1e-4 for x in report["errors"].values())
    text = (tmp_path / "speed.md").read_text()
    row = next(x for x in text.splitlines() if x.startswith("| tiny (60, 40x24) | numba |"))
    forward, pairs = sorted(tiny["seconds"]["numba: forward"]), tiny["pairs"]
    cells = [float(x) for x in row.strip("| ").split("|")[2:]]
    assert cells[0] == pytest.approx(5e2 * sum(forward), rel=1e-3)
    assert cells[2:4] == pytest.approx([pairs / (5e5 * sum(forward)), 3], rel=1e-3)

    old = tmp_path / "old.json"
    write_json(old, report | {"errors": {x: y / 3 for x, y in report["errors"].items()}, "ratios": {}})
    with pytest.raises(RuntimeError, match=r"worse .*old\.json:\n  tiny, numba: gradient"):
        measure(tmp_path / "worse", against=old)
    assert (tmp_path / "worse" / "speed.md").exists()


def test_mistakes_are_told_before_anything_is_measured(tmp_path, measure, monkeypatch):
    monkeypatch.setattr(WorkloadSpec, "make", lambda self: pytest.fail("measured"))
    with pytest.raises(FileNotFoundError):
        measure(tmp_path, against=tmp_path / "none.json")
    write_json(tmp_path / "other.json", {"ratios": {}})
    with pytest.raises(KeyError):
        measure(tmp_path, against=tmp_path / "other.json")


@pytest.mark.parametrize("name", ["speed", "growth", "plan"])
def test_the_commands_have_a_help(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [name, "--help"])
    monkeypatch.delitem(sys.modules, f"benchmarks.{name}", raising=False)  # runpy warns of what is there already
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"benchmarks.{name}", run_name="__main__")
    assert ended.value.code == 0
    assert "--out" in capsys.readouterr().out
