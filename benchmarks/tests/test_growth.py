"""The benchmark on tiny workloads: what is measured, kept, left out and written."""

import json
import re

import pytest

from benchmarks import growth as module
from benchmarks.growth import Axis, extrapolated, measure_growth
from benchmarks.workloads import WorkloadSpec

MIB = 1 << 20
TINY = {"layers": Axis("Gaussians, 24x16", "Gaussians", {n: WorkloadSpec(n, 24, 16, 0.05) for n in (20, 40, 80)})}


def peaks(spec, engine, device):
    return {"forward": MIB * spec.gaussians, "forward+backward": 2 * MIB * spec.gaussians}


@pytest.fixture
def canned(monkeypatch):
    """Workloads that take no time: 1 ms and 3 ms per Gaussian by torch, which alone draws."""
    measured = []

    def measure(spec, engines, *, repeats, device):
        measured.append(spec.gaussians)
        seconds = {"forward": 1e-3 * spec.gaussians, "forward+backward": 3e-3 * spec.gaussians}
        return {"per_pixel": 2.0, "medians": {"torch": seconds}, "memory": {"torch": peaks(spec, "torch", device)}}

    monkeypatch.setattr(module, "measure_workload", measure)
    monkeypatch.setattr(module, "growth_figure", lambda report, path: None)
    return measured


def test_a_tiny_measurement_of_both_engines(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "peak_memory", peaks)
    report = measure_growth(TINY, tmp_path, repeats=2)
    assert json.loads((tmp_path / "growth.json").read_text()) == report
    assert (tmp_path / "growth.png").stat().st_size > 10_000
    for point in report["axes"]["layers"]["points"]:
        assert all(len(x) == 2 and min(x) > 0 for x in point["seconds"].values())
    assert set(report["axes"]["layers"]["fits"]) == {
        f"{engine}, {x}, {what}"
        for engine in ("numba", "torch")
        for x in ("forward", "forward+backward")
        for what in ("time", "memory")
    }


def test_every_point_is_written_at_once_and_kept(canned, tmp_path, monkeypatch):
    measure = module.measure_workload

    def fails_at_80(spec, engines, *, repeats, device):
        if spec.gaussians == 80:
            raise KeyboardInterrupt
        return measure(spec, engines, repeats=repeats, device=device)

    monkeypatch.setattr(module, "measure_workload", fails_at_80)
    with pytest.raises(KeyboardInterrupt):
        measure_growth(TINY, tmp_path)
    monkeypatch.setattr(module, "measure_workload", measure)
    first = measure_growth(TINY, tmp_path)
    assert canned == [20, 40, 80]
    again = measure_growth(TINY, tmp_path)
    assert canned == [20, 40, 80]
    assert {**again, "date": 0} == {**first, "date": 0}
    measure_growth(TINY, tmp_path, repeats=2)  # other settings
    assert canned == [20, 40, 80] * 2


def test_exponents_reach_the_tables(canned, tmp_path):
    measure_growth(TINY, tmp_path)
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (tmp_path / "growth.md").read_text().splitlines()
        if line.startswith("| ")
    ]
    exponents = next(row for row in rows if row[0] == "Gaussians, 24x16")
    assert exponents[1:] == ["torch", "20 to 80", "1.00 ± 0.00", "1.00 ± 0.00", "0.24 s, 160 MiB"]
    assert ["40", "2", "40", "40", "120", "80"] in rows  # ms and MiB of each pass


def test_too_large_a_workload_is_left_out_with_its_reason(canned, tmp_path):
    # A round of 40 Gaussians takes 0.16 s, of 80 by extrapolation 0.32 s; 3 + 1 + 1 of them are needed.
    report = measure_growth(TINY, tmp_path, time_limit=1.5)
    assert canned == [20, 40]
    *_, last = report["axes"]["layers"]["points"]
    assert last["x"] == 80
    assert re.search(r"about 1\.6 s, .*limit is 1\.5 s", last["skipped"])
    assert f"- 80 Gaussians: left out, {last['skipped']}" in (tmp_path / "growth.md").read_text()
    assert report["axes"]["layers"]["fits"] == {}
    measure_growth(TINY, tmp_path, time_limit=1.7)
    assert canned == [20, 40, 80]
    kept = measure_growth(TINY, tmp_path, time_limit=0.1)  # what is there already is not left out
    assert "skipped" not in kept["axes"]["layers"]["points"][-1]


def test_extrapolation_follows_the_last_step_and_at_least_the_size():
    assert extrapolated({}, 10) == 0
    assert extrapolated({10: 2.0}, 30) == pytest.approx(6)
    assert extrapolated({10: 1.0, 100: 10.0, 200: 40.0}, 400) == pytest.approx(160)
    assert extrapolated({10: 1.0, 100: 1.0}, 1000) == pytest.approx(10)
