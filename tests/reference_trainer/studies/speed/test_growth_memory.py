"""The formula of the memory against what torch's allocator counts, and against a fresh process."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from reference_trainer.render import tiles
from reference_trainer.studies.speed.calls import SUBJECT, gradients, image
from reference_trainer.studies.speed.growth import _every_tensor_mapped
from reference_trainer.studies.speed.growth_memory import Counts, Phase, count, predict
from reference_trainer.studies.speed.memory import peak_memory
from reference_trainer.studies.speed.workloads import WorkloadSpec

MIB = 1 << 20
CALLS = {"forward": image, "forward+backward": gradients}


def allocated(call, folder):
    """The largest sum of the allocations that live at the same time, bytes: from the profiler's log."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as log:
        result = call()
    del result
    log.export_chrome_trace(str(folder / "trace.json"))
    events = json.loads((folder / "trace.json").read_text())["traceEvents"]
    changes = sorted((e for e in events if e["name"] == "[memory]"), key=lambda e: e["ts"])
    alive, total, peak = {}, 0, 0
    for change in (e["args"] for e in changes):
        if change["Bytes"] > 0:
            alive[change["Addr"]] = change["Bytes"]
            total += change["Bytes"]
        else:
            total -= alive.pop(change["Addr"], 0)  # older than the log if it is unknown
        peak = max(peak, total)
    return peak


# What dominates differs: Gaussians, strips, entries, pixels, one long list.
SPECS = {
    "gaussians": WorkloadSpec(20_000, 16, 16, 0.001),
    "strips": WorkloadSpec(1_500, 16, 512, 0.05),
    "entries": WorkloadSpec(200, 256, 256, 0.1),
    "pixels": WorkloadSpec(20, 512, 512, 0.01),
    "long lists": WorkloadSpec(5_000, 24, 24, 0.1),
    "some of all": WorkloadSpec(3_000, 104, 88, 0.02),
}


@pytest.mark.parametrize("name", SPECS)
def test_one_chunk_is_counted_exactly(name, tmp_path):
    workload = SPECS[name].make()
    counts = count(workload)
    assert len(counts.chunks) == 1
    for what, peak in predict(counts).items():
        CALLS[what](SUBJECT, workload)  # what is kept from then on is no part of a rendering
        measured = allocated(lambda what=what: CALLS[what](SUBJECT, workload), tmp_path)
        assert measured == pytest.approx(peak.bytes, rel=0.02), (what, peak)


@pytest.mark.parametrize("spec", [SPECS["entries"], SPECS["long lists"], SPECS["some of all"]])
@pytest.mark.parametrize("entries", [1 << 12, 1 << 14])
def test_of_many_chunks_the_one_before_counts(spec, entries, tmp_path, monkeypatch):
    monkeypatch.setattr(tiles, "CHUNK_ENTRIES", entries)
    workload = spec.make()
    counts = count(workload)
    assert len(counts.chunks) > 1
    for what, peak in predict(counts).items():
        CALLS[what](SUBJECT, workload)
        measured = allocated(lambda what=what: CALLS[what](SUBJECT, workload), tmp_path)
        assert measured == pytest.approx(peak.bytes, rel=0.02), (what, peak)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux's /proc")
def test_a_fresh_process_needs_what_the_formula_says():
    spec = WorkloadSpec(2_000, 256, 256, 0.06)
    cpu = torch.device("cpu")
    with _every_tensor_mapped():
        libraries, measured = peak_memory(WorkloadSpec(1, 8, 8, 0.01), cpu), peak_memory(spec, cpu)
    assert "MALLOC_MMAP_THRESHOLD_" not in os.environ
    for what, peak in predict(count(spec.make())).items():
        assert peak.bytes > 20 * MIB
        assert measured[what] - libraries[what] == pytest.approx(peak.bytes, rel=0.15), (what, peak)


def test_the_counts_are_those_of_the_lists():
    # Two Gaussians wider than the picture: both are in all 6 tiles, and in 2 rows of tiles.
    workload = WorkloadSpec(2, 24, 16, 5.0).make()
    workload = replace(workload, means=torch.zeros(2, 3))
    assert count(workload) == Counts(gaussians=2, strips=4, entries=12, pixels=384, chunks=((12, 384, 768),))


def test_nothing_to_see_needs_no_chunk():
    workload = WorkloadSpec(2, 24, 16, 0.1).make()
    counts = count(replace(workload, means=torch.tensor([[0.0, 0.0, -5.0]]).expand(2, 3)))
    assert counts == Counts(0, 0, 0, 384, ())
    assert all(0 < peak.bytes < 64 * 384 for peak in predict(counts).values())


def test_only_the_chunk_just_before_counts():
    phase = Phase(0, 0, 0, 0, chunk=(10, 0, 0), earlier=(3, 0, 0))
    chunks = ((100, 0, 0), (50, 0, 0), (90, 0, 0))
    assert phase.total(Counts(0, 0, 0, 0, chunks)) == 90 * 10 + 50 * 3
    assert phase.total(Counts(0, 0, 0, 0, chunks[:1])) == 100 * 10
