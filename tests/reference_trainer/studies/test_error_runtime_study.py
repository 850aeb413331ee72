"""Table, figure and the study that continues, on the built-in scene at 20 x 15 pixels."""

import dataclasses
import json

import pytest
import torch
from PIL import Image

from reference_trainer.camera import Camera
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import save_ply
from reference_trainer.runs.measure import of_run
from reference_trainer.runs.run import run_experiment
from reference_trainer.scenes.scene import View
from reference_trainer.studies import error_runtime_study
from reference_trainer.studies.error_runtime import LOOPS, ErrorRuntime, Measurement
from reference_trainer.studies.error_runtime_study import (
    error_runtime_figure,
    error_runtime_table,
    study,
    study_error_runtime,
)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(error_runtime_study, "PICTURE", 24)


@pytest.fixture
def ball(tmp_path):
    """A PLY of 300 opaque Gaussians in a ball of radius 1."""
    g = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(300, 3, generator=g), dim=1) * torch.rand(300, 1, generator=g)
    colors = torch.rand(300, 3, generator=g)
    gaussians = Gaussians.from_points(points, colors, torch.full((300,), 0.2), sh_degree=0, opacity=0.8)
    save_ply(gaussians, tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


@pytest.fixture
def models():
    """A model and a view, by the name of the scene."""
    gaussians = Gaussians.from_points(torch.rand(8, 3), torch.rand(8, 3), torch.full((8,), 0.3), sh_degree=0)
    camera = Camera(torch.eye(4), 9.0, 9.0, 4.0, 3.0, 8, 6)
    return {"wall": (TrainedModel(gaussians, torch.zeros(3)), View("front", camera, torch.zeros(3, 6, 8)))}


def quiet(text):
    pass


@pytest.fixture
def calls(monkeypatch):
    """Studies whose measurements take no time, and the settings of each."""
    asked = []

    def measure(model, view, *, max_samples, seeds, progress):
        asked.append((view.name, max_samples))
        if view.name == "away":
            raise ValueError("no pixel of away")
        return known(5e-4)

    monkeypatch.setattr(error_runtime_study, "error_runtime", measure)
    monkeypatch.setattr(error_runtime_study, "error_runtime_figure", lambda results, path: None)
    return asked


def test_a_finished_scene_is_kept_and_a_changed_one_measured_again(models, tmp_path, calls):
    first = study(models, tmp_path, max_samples=16, seeds=1, say=quiet)
    said = []
    again = study(models, tmp_path, max_samples=16, seeds=1, say=said.append)
    assert (len(calls), again, said[0]) == (1, first, "wall: measured before, kept")
    study(models, tmp_path, max_samples=32, seeds=1, say=quiet)
    assert calls == [("front", 16), ("front", 32)]
    model, view = models["wall"]
    brighter = TrainedModel(model.gaussians, torch.ones(3))
    study({"wall": (brighter, view), "plain": (model, view)}, tmp_path, max_samples=32, seeds=1, say=quiet)
    assert len(calls) == 4
    shifted = dataclasses.replace(view, camera=dataclasses.replace(view.camera, cx=view.camera.cx + 1))
    study({"wall": (brighter, shifted)}, tmp_path, max_samples=32, seeds=1, say=quiet)
    assert len(calls) == 5
    data = json.loads((tmp_path / "error_runtime.json").read_text())
    assert sorted(data) == ["plain", "wall"]
    assert data["plain"]["machine"]["threads"] == torch.get_num_threads()
    assert "## plain" not in (tmp_path / "error_runtime.md").read_text()


def test_an_interrupted_study_keeps_what_is_finished(models, tmp_path, calls):
    model, view = models["wall"]
    two = {**models, "away": (model, dataclasses.replace(view, name="away"))}
    for _ in range(2):
        with pytest.raises(ValueError, match="no pixel of away"):
            study(two, tmp_path, max_samples=16, seeds=1, say=quiet)
    assert calls == [("front", 16), ("away", 16), ("away", 16)]


@pytest.fixture(scope="module")
def run(tmp_path_factory, options, short):
    folder = tmp_path_factory.mktemp("runs") / "scene" / "strategy" / "seed_0"
    run_experiment(options, short, folder, monitor_every=0)
    return folder


@pytest.mark.slow
def test_runs_and_ply_files_are_sources(run, ball, tmp_path):
    results = study_error_runtime([run, ball], tmp_path / "out", max_samples=16, seeds=1, say=quiet)
    assert list(results) == ["scene/strategy/seed_0", "ball"]
    model, scene, _ = of_run(run)
    exact = model.exact_ca_score(drop_rate=0.5)(model.gaussians.opacities, scene.test[0])
    assert results["scene/strategy/seed_0"].view == scene.test[0].name
    assert results["scene/strategy/seed_0"].score == pytest.approx(exact.value, rel=1e-4)
    assert (results["ball"].width, results["ball"].height, results["ball"].gaussians) == (24, 24, 300)
    assert results["ball"].covered > 0.1
    with Image.open(tmp_path / "out" / "error_runtime.png") as figure:
        assert figure.width > 1.5 * figure.height  # two panels


def test_sources_that_cannot_be_told_apart_or_are_scaled_are_refused(ball, tmp_path):
    with pytest.raises(ValueError, match="two sources are called ball"):
        study_error_runtime([ball, ball], tmp_path / "out", max_samples=16, seeds=1, say=quiet)
    gaussians = error_runtime_study.load_ply(ball).gaussians
    for keywords, by in (({"bake_p": 0.2}, r"0\.8"), ({"opacities": gaussians.opacities}, "the mean of their noise")):
        save_ply(gaussians, tmp_path / "baked.ply", **keywords)
        with pytest.raises(ValueError, match=f"baked.ply are scaled by {by}"):
            study_error_runtime([tmp_path / "baked.ply"], tmp_path / "out", max_samples=16, seeds=1, say=quiet)
    with pytest.raises(ValueError, match="at least one model"):
        study_error_runtime([], tmp_path / "out", say=quiet)


def known(exact_error):
    """Two seeds, errors 3 / sqrt(K) and 4 / sqrt(K), a second for 10 renders."""
    sampled = [
        Measurement("Monte Carlo", k, [k / 10] * 2, [2e-3, 2.2e-3], [3 / k**0.5, 4 / k**0.5], [0.1, 0.1])
        for k in (8, 16)
    ]
    others = [
        Measurement("first order", None, [0.1, 0.2, 0.9], [4e-3], [1.0], [2.0]),
        Measurement(LOOPS, None, [0.4], [2e-3], [exact_error], [1e-3]),
        Measurement("exact float64", None, [0.5], [2e-3], [0.0], [0.0]),
    ]
    return ErrorRuntime("v", 8, 6, 12, 0.75, 0.5, 2e-3, [0.1, 0.1], [*sampled, *others])


def test_the_table_holds_medians_and_root_mean_squares():
    lines = error_runtime_table(known(5e-4)).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[2] == ["Monte Carlo", "8", "0.8", "8", "2.10 ± 0.14", "1.2", "0.1"]  # rms of 3 and 4 over root 8
    assert cells[4] == ["first order", "", "0.2", "2", "4", "1", "2"]
    assert cells[6] == ["exact float64", "", "0.5", "5", "2", "0", "0"]
    text = "\n".join(lines)
    assert "8x6, 12 Gaussians; the region covers 75%" in text
    # 12.5 / K = 25e-8 at K = 5e7, which takes 5e6 seconds.
    assert (
        "falls as K^-0.50; continued as K^-0.5 it equals that of exact, loops at K = 5.0e+07, after 1.4e+03 hours"
        in text
    )
    assert "exact, loops has none" in error_runtime_table(known(0.0))


def test_the_figure_can_be_drawn_without_an_error_of_the_exact_estimate(tmp_path):
    error_runtime_figure({"a": known(5e-4), "b": known(0.0), "c": known(1e-6)}, tmp_path / "f.png")
    with Image.open(tmp_path / "f.png") as figure:
        assert figure.width > 2.5 * figure.height
        assert len(figure.convert("RGB").getcolors(1 << 24)) > 10  # not an empty page
