"""The study on a workload of 60 Gaussians, and its gate on results that are made up."""

import json

import pytest
import torch
from devices import slow_on_card

from reference_trainer.evaluation.report import write_json
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.speed import measure
from reference_trainer.studies.speed import study as module
from reference_trainer.studies.speed.limits import Limits
from reference_trainer.studies.speed.measure import WorkloadSpeed
from reference_trainer.studies.speed.study import study, study_speed
from reference_trainer.studies.speed.workloads import WorkloadSpec

TINY = {"tiny": WorkloadSpec(60, 40, 24, 0.05)}


def quiet(text):
    pass


@slow_on_card
def test_a_tiny_study(device, tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "peak_memory", lambda spec, device: None)  # a process of its own: tested elsewhere
    scene = SceneOptions("synthetic", downscale=8)
    said = []
    report = study(TINY, tmp_path, scene=scene, repeats=2, device=str(device), say=said.append)
    assert json.loads((tmp_path / "speed.json").read_text()) == report
    assert (tmp_path / "speed.md").read_text() in said
    assert (report["device"], report["machine"]["threads"]) == (device.type, torch.get_num_threads())
    tiny = report["workloads"]["tiny"]
    assert all(len(x) == 2 for x in (*tiny["seconds"].values(), *tiny["stages"].values()))
    assert all(min(x) > 0 for x in (*tiny["seconds"].values(), *tiny["stages"].values()))
    assert tiny["evaluated"] >= tiny["pairs"] > 0
    assert set(report["ratios"]) == {
        "tiny: forward / baseline",
        "tiny: forward+backward / baseline",
        "tiny: score of 5 / 5 renders",
        "ssim_map / kornia",
    }
    gradients = {f"tiny: gradient of {x}" for x in ("means", "quaternions", "scales", "opacities", "colors")}
    assert set(report["errors"]) == {"tiny: image, mean", "tiny: image, max", *gradients}
    assert all(0 < x < 1e-4 for x in report["errors"].values())


@pytest.fixture
def canned(monkeypatch):
    """Studies that take no time: 2 ms forward and 6 ms with gradients, the baseline ten times as long."""
    result = WorkloadSpeed(
        gaussians=60, width=40, height=24, pairs=3000, evaluated=6000,
        bounds={"exp": 1e-6, "copy": 1e-7},
        seconds={
            "forward": [2e-3, 2e-3, 9e-3], "baseline forward": [20e-3, 20e-3, 20e-3],
            "forward+backward": [6e-3] * 3, "baseline forward+backward": [60e-3] * 3,
            "5 renders": [10e-3] * 3, "score of 5": [7e-3] * 3,
        },
        stages={"projection": [1e-3] * 3, "blending": [3e-3] * 3},
        memory={"forward": 3 << 20, "forward+backward": 5 << 20},
        image_error={"mean": 1e-7, "max": 1e-4},
        gradient_errors={"means": 2e-5},
    )  # fmt: skip
    step = {"scene": "s", "width": 4, "height": 3, "gaussians": 9, "seconds": {"step": [0.04], "forward": [0.01]}}
    monkeypatch.setattr(module, "measure_limits", lambda device, repeats: Limits(1e9, 3e9, 2e10))
    monkeypatch.setattr(module, "measure_workload", lambda spec, limits, repeats, device: result)
    monkeypatch.setattr(module, "similarity", lambda repeats, device: {"ssim_map": [1e-3], "kornia": [4e-3]})
    monkeypatch.setattr(module, "training_step", lambda options, repeats, device: step)


def test_medians_and_ratios_reach_the_tables(canned, tmp_path):
    report = study(TINY, tmp_path, repeats=3, say=quiet)
    assert report["ratios"] == pytest.approx(
        {
            "tiny: forward / baseline": 0.1,
            "tiny: forward+backward / baseline": 0.1,
            "tiny: score of 5 / 5 renders": 0.7,
            "ssim_map / kornia": 0.25,
        }
    )
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (tmp_path / "speed.md").read_text().splitlines()
        if line.startswith("| ")
    ]
    # 2 ms over 1 microsecond and 0.1 microseconds; 3000 pairs in 2 ms.
    assert ["tiny (60, 40x24), forward", "2", "20", "0.1", "2000", "20000", "1.5", "3"] in rows
    assert ["tiny", "1", "3", "0.6667", "2"] in rows
    assert ["gradient of means", "2.0e-05"] in rows
    assert ["its forward, unit: the step", "10", "0.25"] in rows


def test_the_gate_passes_and_fails_after_writing(canned, tmp_path):
    old = tmp_path / "old" / "speed.json"
    report = study(TINY, old.parent, say=quiet)
    study(TINY, tmp_path / "same", against=old, say=quiet)
    report["ratios"]["tiny: forward / baseline"] = 0.05
    report["errors"]["tiny: gradient of means"] = 0.9e-5
    write_json(old, report)
    with pytest.raises(RuntimeError, match=r"2 numbers are worse") as caught:
        study(TINY, tmp_path / "worse", against=old, say=quiet)
    assert "tiny: forward / baseline: ratio 0.1, was 0.05" in str(caught.value)
    assert "tiny: gradient of means: error 2e-05, was 9e-06" in str(caught.value)
    assert (tmp_path / "worse" / "speed.md").exists()


def test_mistakes_are_told_before_anything_is_measured(tmp_path):
    with pytest.raises(ValueError, match="no workload 'huge'; choose among small, medium, large"):
        study_speed(tmp_path, workloads=("small", "huge"))
    with pytest.raises(ValueError, match="at least 1 workload and 1 round, got 1 and 0"):
        study(TINY, tmp_path, repeats=0)
    with pytest.raises(FileNotFoundError):
        study(TINY, tmp_path, against=tmp_path / "none.json")
    write_json(tmp_path / "other.json", {"ratios": {}})
    with pytest.raises(ValueError, match=r"other.json has no \['device', 'errors', 'machine'\]"):
        study(TINY, tmp_path, against=tmp_path / "other.json")
