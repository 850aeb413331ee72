"""The oracles: what they look at, on models whose error is known."""

import dataclasses

import pytest
import torch
from oracles import random_scene
from scipy.stats import spearmanr

from benchmarks import oracle
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.scenes.scene import View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


@pytest.fixture
def too_many() -> tuple[TrainedModel, View]:
    """Five Gaussians, and a photograph of them without the third."""
    scene = random_scene(5, 25, 17, seed=2, size=0.4)
    gaussians = Gaussians.from_points(scene.means, scene.colors, scene.scales[:, 0], sh_degree=0)
    logits = torch.tensor([-0.5, 0.3, 1.0, 0.0, 0.7], dtype=torch.float64)
    model = TrainedModel(
        dataclasses.replace(gaussians, opacity_logits=logits), torch.zeros(3, dtype=torch.float64), "dropout(0.2)"
    )
    view = View("a", scene.camera, torch.zeros(3, 17, 25, dtype=torch.float64))
    without = model.test_opacities.index_fill(0, torch.tensor([2]), 0.0)
    return model, dataclasses.replace(view, image=model.render(without, view)[0].detach())


def test_slopes_are_differences_and_name_the_one_too_many(too_many):
    model, view = too_many
    slopes = oracle.error_slopes(model, [view, view])

    def error(factors):
        image = model.render(model.test_opacities * factors, view)[0]
        return 2 * (image - view.image).square().mean()

    ones = torch.ones(5, dtype=torch.float64)
    for i, slope in enumerate(slopes.tolist()):
        step = torch.zeros_like(ones).index_fill_(0, torch.tensor([i]), 1e-5)
        assert slope == pytest.approx((error(ones + step) - error(ones - step)).item() / 2e-5, rel=1e-6, abs=1e-12)
    assert slopes.argmax() == 2
    assert slopes[2] > 1e-4


def test_the_search_takes_the_one_too_many_away(too_many):
    model, view = too_many
    found = oracle.best_factors(model, [view], 60, rate=0.1)
    torch.testing.assert_close(found, torch.tensor([1.0, 1.0, 0.0, 1.0, 1.0], dtype=torch.float64), rtol=0, atol=0.05)


def test_ranks_and_what_parts_of_the_pixels_hold():
    g = torch.Generator().manual_seed(0)
    a, b = torch.rand(20, 30, generator=g), torch.rand(20, 30, generator=g)
    b += a
    assert oracle.rank_correlation(a, b) == pytest.approx(spearmanr(a.flatten(), b.flatten()).statistic)
    order = sorted(range(600), key=lambda i: -b.flatten()[i])
    expected = [sum(a.flatten()[i].item() for i in order[:n]) / a.sum().item() for n in (60, 300, 600)]
    assert oracle.held(a, b, [0.1, 0.5, 1.0]) == pytest.approx(expected, rel=1e-5)


def test_a_run_is_measured_and_told(tiny_scene, tmp_path, monkeypatch):
    trainer = Trainer(tiny_scene, TrainConfig(initial_opacity=0.7, dropout=0.2))
    monkeypatch.setattr(oracle, "load_run", lambda run: trainer)
    (tmp_path / "checkpoint.pt").touch()
    study = oracle.oracle_study([tmp_path], steps=3)
    ((_, case),) = study.cases.items()
    found = study.measure(**case)
    pixels, gains = found["pixels"], found["gains"]
    for name in ("exact CA", "edges"):
        assert all(a <= b for a, b in zip(pixels[f"held, {name}"], pixels["held, error"], strict=True))
        assert pixels[f"curve, {name}"][-1] == pytest.approx(1)
    assert set(gains) == set(oracle.CRITERIA)
    assert gains["error, these views"]["halved"][0] > max(0, gains["random"]["halved"][0])
    assert found["rates, these views"] > 0
    assert study.report({"one": found}).count("| one |") == 3 + 2 * len(gains) + 1
