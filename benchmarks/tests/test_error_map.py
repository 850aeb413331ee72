import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import error_map
from benchmarks.clean_by_error import error_shares
from benchmarks.error_map import Quality, Seen, ause, fitted, predict, ranked
from benchmarks.error_map_tables import tables
from reference_trainer.evaluation.shares import blend_weights
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians


def by_loop(predicted: np.ndarray, error: np.ndarray) -> float:
    """Remove 0, 1, ... 99 % of the pixels, those of the largest prediction or error first, one list after the other."""
    total, n = 0.0, len(error)
    for percent in range(100):
        removed = percent * n // 100
        for sign, by in ((1, predicted), (-1, error)):
            left = sorted(zip(by, error, strict=True), key=lambda pair: pair[0])[: n - removed]
            total += sign * sum(e for _, e in left) / len(left)
    return total / 100 / float(error.mean())


def test_the_area_is_that_of_a_loop_and_0_for_the_error_itself():
    rng = np.random.default_rng(0)
    error, predicted = rng.exponential(size=300), rng.random(300)
    assert ause(predicted, error) == pytest.approx(by_loop(predicted, error))
    assert ause(error**2, error) == ause(error, error, root=True) == 0
    assert ause(-error, error) > ause(predicted, error) > 0


def test_a_prediction_that_knows_nothing_has_the_expected_area():
    """Half of the pixels are wrong by 1: the oracle's curve is (1/2 - r)+ / (1 - r), times 2; at random it stays 1."""
    error = np.repeat([0.0, 1.0], 50_000)
    steps = np.arange(100) / 100
    expected = np.mean(1 - 2 * np.maximum(0.5 - steps, 0) / (1 - steps))
    assert ause(np.zeros(100_000), error) == pytest.approx(expected, abs=0.01)  # ties at random; sigma is about .003


def test_a_fit_finds_the_weights_and_the_unit_of_planted_errors():
    rng = np.random.default_rng(1)
    truth, views = {"constant": 0.03, "deviation": 0.8, "warp": 0.3}, []
    for unit in (0.5, 1.0, 2.0):
        terms = {"constant": np.ones(8000), "deviation": rng.random(8000) * 0.1, "warp": rng.random(8000) * 0.2}
        mean = unit * sum(weight * terms[name] for name, weight in truth.items())
        own = {name: float(x.mean()) for name, x in terms.items()} | {"difference": 2 * float(mean.mean())}
        error = rng.exponential(mean)
        views.append(Seen(terms, {}, error, 2 * error**2, own))
    found = fitted(views, [*truth])
    for name, weight in truth.items():
        assert found.weights[name] == pytest.approx(weight, rel=0.15)  # the units' geometric mean is 1
    assert found.transfer == pytest.approx(0.5, rel=0.05)
    assert found.spread < 0.5
    assert found.expect(views[2]).mean() == pytest.approx(views[2].error.mean(), rel=0.05)
    # An exponential error: mean square twice the square of the mean, and here doubled.
    squares = predict(views[0], truth) ** 2
    assert found.peaked == pytest.approx(4, rel=0.15)
    assert math.isfinite(squares.mean())


def test_models_are_ranked_within_a_scene_and_a_seed():
    def of(psnr: float, expected: float) -> list[Quality]:
        return [Quality(0.1, 0.1, psnr - 1, expected), Quality(0.1, 0.1, psnr + 1, expected + 2)]

    views = {
        "dtu-scan24-plain-0": of(20, 25), "dtu-scan24-dropout-0": of(22, 24), "dtu-scan24-dropout-1": of(30, 30),
        "fern-plain-0": of(21, 20), "fern-dropout-0": of(22.5, 21), "lego-plain-0": of(25, 25),
    }  # fmt: skip
    found = ranked(views, "plain", "dropout")
    assert found == {"dtu-scan24, seed 0": (2.0, -1.0), "fern, seed 0": (1.5, 1.0)}


def row(psnr: float, expected: float, ause: float, rival: float) -> dict:
    figures = dict.fromkeys(("AUSE-RMSE", "AUSE-RMSE, deviation", "Spearman", "Spearman, deviation"), 0.5)
    figures |= dict.fromkeys(("errors below 2.303 expected", "negative log likelihood", "of the view's true mean"), 0.9)
    figures |= {f"without {term}": 0.3 for term in ("constant", "deviation", "warp", "hidden*colors")}
    return figures | {"error map": ause, "deviation": rival, "views": [[0.1, 0.11, psnr, expected]]}


def test_tables_have_the_means_and_who_is_ahead():
    rows = {
        "fern-plain-0": row(20.0, 23.0, 0.2, 0.25), "lego-plain-0": row(22.0, 23.0, 0.4, 0.3),
        "fern-recommended-0": row(21.0, 20.0, 0.1, 0.2),
        "pairs": {"recommended over plain": {"fern, seed 0": (1.0, -3.0)}}, "deciles": [[0.1] * 10, [0.2] * 10],
    }  # fmt: skip
    lines = tables(rows).splitlines()
    assert "| plain | 2 | 0.300 | 0.275 | 1 of 2 |" in lines
    assert "| recommended | 1 | 0.100 | 0.200 | 1 of 1 |" in lines
    assert "| Fern | 21.00 / 20.00 | 20.00 / 23.00 |" in lines
    assert "| recommended over plain | 1 | +1.00 | -3.00 | 0 |" in lines
    assert "| plain, 2 | 100% | 100% | +2.00 | 2.2 | 100% |" in lines  # off by 3 and 1 dB
    assert "| **error map** | 0.200 | 0.400 | 0.300 |" in lines


def test_the_folder_of_a_run_may_have_an_equals_sign(monkeypatch):
    plotted = {}
    monkeypatch.setattr(error_map, "plot", lambda runs, file: plotted.update(runs))
    run = "runs/noise_0.8_scale=True/seed_0"  # as compare calls it
    monkeypatch.setattr(sys, "argv", ["error_map", f"fern-noise-0={run}", "--picture", "picture.webp"])
    error_map.main()
    assert plotted == {"fern-noise-0": run}


def test_the_page_has_the_tables_of_its_rows():
    here = Path(__file__).parents[1]
    rows = json.loads((here / "data" / "error_map.json").read_text("utf-8"))
    assert tables(rows).strip() in (here / "error_map.md").read_text("utf-8")


def test_errors_are_handed_out_by_weight_in_the_render(tiny_scene):
    """The same everywhere: the blend weights times the error. In one pixel: what the Gaussians weigh there."""
    points = tiny_scene.points
    sizes = torch.full((len(points.colors),), 0.2)
    gaussians = Gaussians.from_points(points.positions, points.colors, sizes, opacity=0.6, sh_degree=0)
    model, views = TrainedModel(gaussians, tiny_scene.background, "dropout(0.2)"), tiny_scene.train[:2]
    even = [(view, torch.full(view.image.shape[1:], 0.3)) for view in views]
    torch.testing.assert_close(error_shares(model, even), 0.3 * blend_weights(model, views), rtol=1e-5, atol=1e-6)
    error = torch.zeros(views[0].image.shape[1:])
    error[8, 10] = 2.0
    alpha = model.test_rendering(views[0]).alpha[8, 10]
    assert error_shares(model, [(views[0], error)]).sum().item() == pytest.approx(2 * alpha.item(), abs=1e-5)
