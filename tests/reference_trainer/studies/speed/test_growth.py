"""The study on tiny workloads: what is measured, kept, left out and written."""

import json
import math

import pytest
from devices import slow_on_card

from reference_trainer.studies.speed import growth as module
from reference_trainer.studies.speed.growth import extrapolated, study, study_growth
from reference_trainer.studies.speed.growth_memory import Counts, count, predict
from reference_trainer.studies.speed.growth_points import Axis
from reference_trainer.studies.speed.workloads import WorkloadSpec

MIB = 1 << 20
TINY = {"layers": Axis("Gaussians, 24x16", "Gaussians", {n: WorkloadSpec(n, 24, 16, 0.05) for n in (20, 40, 80)})}


def quiet(text):
    pass


@pytest.fixture
def no_process(monkeypatch):
    """Memory without processes, which other tests start: 12 MiB of the libraries, and 1 KiB per Gaussian."""

    def peaks(spec, device):
        size = 12 * MIB + 1024 * (spec.gaussians - 1)
        return {"forward": size, "forward+backward": 2 * size}

    monkeypatch.setattr(module, "peak_memory", peaks)


@pytest.fixture
def canned(monkeypatch, no_process):
    """Workloads that take no time: 1 ms and 3 ms per Gaussian."""
    measured = []

    def measure(spec, *, repeats, device):
        measured.append(spec.gaussians)
        seconds = {"forward": 1e-3 * spec.gaussians, "forward+backward": 3e-3 * spec.gaussians}
        counts = Counts(spec.gaussians, 0, 0, 384, ())
        return {
            "per_pixel": 2.0,
            "counts": {**vars(counts), "chunks": []},
            "seconds": {name: [x] * repeats for name, x in seconds.items()},
            "medians": seconds,
            "formula": {name: peak._asdict() for name, peak in predict(counts).items()},
            "memory": module._memory(spec, device),
        }

    monkeypatch.setattr(module, "_measure", measure)
    return measured


@slow_on_card
def test_a_tiny_study(device, tmp_path, no_process):
    said = []
    report = study(TINY, tmp_path, repeats=2, device=str(device), say=said.append)
    assert json.loads((tmp_path / "growth.json").read_text()) == report
    assert (tmp_path / "growth.md").read_text() in said
    assert (tmp_path / "growth.png").stat().st_size > 10_000
    points = report["axes"]["layers"]["points"]
    assert [p["x"] for p in points] == [20, 40, 80]
    for p, spec in zip(points, TINY["layers"].points.values(), strict=True):
        assert p["counts"]["entries"] == count(spec.make().to(device)).entries > 0
        assert all(len(x) == 2 and min(x) > 0 for x in p["seconds"].values())
        assert p["per_pixel"] > 0
        assert p["memory"]["tensors"]["forward"] == 1024 * (spec.gaussians - 1)
    assert set(report["axes"]["layers"]["fits"]) == {
        f"{x}, {what}" for x in ("forward", "forward+backward") for what in ("time", "memory")
    }


def test_every_point_is_written_at_once_and_kept(canned, tmp_path, monkeypatch):
    measure = module._measure

    def fails_at_80(spec, *, repeats, device):
        if spec.gaussians == 80:
            raise KeyboardInterrupt
        return measure(spec, repeats=repeats, device=device)

    monkeypatch.setattr(module, "_measure", fails_at_80)
    with pytest.raises(KeyboardInterrupt):
        study(TINY, tmp_path, say=quiet)
    assert canned == [1, 20, 40]
    monkeypatch.setattr(module, "_measure", measure)
    said = []
    first = study(TINY, tmp_path, say=said.append)
    assert canned == [1, 20, 40, 80]
    assert "layers 40: measured before, kept" in said
    again = study(TINY, tmp_path, say=quiet)
    assert canned == [1, 20, 40, 80]
    assert {**again, "date": 0} == {**first, "date": 0}
    study(TINY, tmp_path, repeats=2, say=quiet)  # other settings
    assert canned == [1, 20, 40, 80] * 2


def test_exponents_and_formula_reach_the_tables(canned, tmp_path):
    report = study(TINY, tmp_path, say=quiet)
    fit = report["axes"]["layers"]["fits"]["forward, time"]
    assert (fit["exponent"], fit["start"], fit["end"], fit["points"]) == (pytest.approx(1), 20, 80, 3)
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (tmp_path / "growth.md").read_text().splitlines()
        if line.startswith("| ")
    ]
    exponents = next(row for row in rows if row[0] == "Gaussians, 24x16")
    assert exponents[1:3] == ["20 to 80 (3)", "1.00 ± 0.00"]
    times, memory = (row for row in rows if row[0] == "40")
    formula = predict(Counts(40, 0, 0, 384, ()))["forward"]
    assert times[1:] == ["2", "0", "40", "120"]
    assert [float(x) for x in memory[1:4]] == pytest.approx(
        [formula.bytes / MIB, 39 * 1024 / MIB, 12 + 39 * 1024 / MIB], rel=1e-3
    )
    assert memory[4] == formula.phase


def test_too_large_a_workload_is_left_out_with_its_reason(canned, tmp_path):
    # A round of 40 Gaussians takes 0.16 s, of 80 by extrapolation 0.32 s; 3 + 1 + 2 of them are needed.
    report = study(TINY, tmp_path, time_limit=1.9, say=quiet)
    assert canned == [1, 20, 40]
    *_, last = report["axes"]["layers"]["points"]
    assert last == {"x": 80, "skipped": "it would take about 1.9 s, extrapolated; the limit is 1.9 s"}
    assert "- 80 Gaussians: left out, it would take about 1.9 s" in (tmp_path / "growth.md").read_text()
    assert report["axes"]["layers"]["fits"] == {}
    study(TINY, tmp_path, time_limit=2.0, say=quiet)
    assert canned == [1, 20, 40, 80]
    kept = study(TINY, tmp_path, time_limit=0.1, say=quiet)  # what is there already is not left out
    assert "skipped" not in kept["axes"]["layers"]["points"][-1]


def test_where_the_system_tells_no_memory_the_times_remain(canned, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "peak_memory", lambda spec, device: None)
    report = study(TINY, tmp_path, say=quiet)
    assert set(report["axes"]["layers"]["fits"]) == {"forward, time", "forward+backward, time"}
    assert (tmp_path / "growth.png").exists()


def test_extrapolation_follows_the_last_step_and_at_least_the_size():
    assert extrapolated({}, 10) == 0
    assert extrapolated({10: 2.0}, 30) == pytest.approx(6)
    assert extrapolated({10: 1.0, 100: 10.0, 200: 40.0}, 400) == pytest.approx(160)
    assert extrapolated({10: 1.0, 100: 1.0}, 1000) == pytest.approx(10)


def test_mistakes_are_told_before_anything_is_measured(canned, tmp_path):
    with pytest.raises(ValueError, match="at least 1 axis, 1 round and a positive limit, got 0, 3 and"):
        study({}, tmp_path)
    for wrong in ({"repeats": 0}, {"time_limit": 0.0}, {"time_limit": math.nan}):
        with pytest.raises(ValueError, match="at least 1 axis"):
            study(TINY, tmp_path, **wrong)
    with pytest.raises(ValueError, match="largest must be at least 1000"):
        study_growth(tmp_path, largest=10)
    assert canned == []


def test_the_study_takes_the_axes_of_its_size(canned, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "growth_axes", lambda largest: asked.append(largest) or TINY)
    study_growth(tmp_path, largest=5_000, say=quiet)
    assert asked == [5_000]
    assert canned == [1, 20, 40, 80]
