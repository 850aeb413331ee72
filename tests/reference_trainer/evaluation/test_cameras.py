"""Scores without photographs: against evaluate, against brute force, and where there is nothing."""

import dataclasses
import math

import pytest
import torch
from PIL import Image

from reference_trainer.evaluation.cameras import CameraEvaluation, CameraScores, evaluate_cameras
from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians


@pytest.fixture(scope="module")
def model(tiny_scene) -> TrainedModel:
    points = tiny_scene.points
    gaussians = Gaussians.from_points(
        points.positions, points.colors, torch.full((150,), 0.25), sh_degree=0, opacity=0.9
    )
    return TrainedModel(gaussians, tiny_scene.background, dropout=0.2, opacity_scale=0.8)


def test_photographs_are_not_needed_for_these_scores(model, tiny_scene):
    cameras = [view.camera for view in tiny_scene.train]
    found = evaluate_cameras(model, cameras, samples=4, seed=3)
    expected = evaluate(model, dataclasses.replace(tiny_scene, test=()), samples=4, seed=3)
    for one, other in zip(found.views, expected.views, strict=True):
        for name in ("ca", "ca_std_error", "ca_exact", "visible", "cv"):
            assert getattr(one, name) == getattr(other, name), name
    assert [view.name for view in found.views] == ["000", "001", "002"]


def test_the_neutral_score_is_that_of_a_background_of_expected_colour(model, tiny_scene):
    """Sampled: 400 masks, every render over the mean colour of its pixel; std error of the score below 2 %."""
    camera = tiny_scene.train[0].camera
    generator = torch.Generator().manual_seed(0)
    opacities, view = model.gaussians.opacities, tiny_scene.train[0]
    colors, alphas = [], []
    for _ in range(400):
        keep = (torch.rand(150, generator=generator) >= 0.6).float()
        image, alpha = dataclasses.replace(model, background=torch.zeros(3)).render(opacities * keep, view)
        colors.append(image)
        alphas.append(alpha)
    color, alpha = torch.stack(colors), torch.stack(alphas)
    behind = color.mean(0) / alpha.mean(0).clamp(min=1e-6)
    variance = (color + (1 - alpha)[:, None] * behind).var(0).mean(0)
    visible = model.exact_ca_score()(opacities, view).visible
    sampled = variance[visible].mean().item()
    assert evaluate_cameras(model, [camera]).views[0].ca_neutral == pytest.approx(sampled, rel=0.08)


def test_coverage_is_that_of_the_test(model, tiny_scene):
    camera, view = tiny_scene.train[0].camera, tiny_scene.train[0]
    alpha = model.render(0.8 * model.gaussians.opacities, view)[1]
    assert evaluate_cameras(model, [camera]).views[0].covered == pytest.approx(alpha.mean().item(), rel=1e-5)


def test_a_camera_that_sees_nothing_has_a_reason(model, tiny_scene):
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ tiny_scene.train[0].camera.world_to_camera
    camera = dataclasses.replace(tiny_scene.train[0].camera, world_to_camera=away)
    (view,) = evaluate_cameras(model, [camera]).views
    assert all(math.isnan(x) for x in (view.ca, view.ca_exact, view.ca_neutral, view.cv))
    assert (view.visible, view.covered) == (0, 0)
    assert view.ca_reason.startswith("no pixel counts")


def test_the_mean_leaves_out_what_does_not_exist():
    views = [CameraScores(f"{i}", x, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, "") for i, x in enumerate((1.0, math.nan, 4.0))]
    data = CameraEvaluation(views).as_dict()
    assert data["mean"]["ca"] == 2.5
    assert "name" not in data["mean"]
    assert data["views"][2]["ca"] == 4.0
    assert math.isnan(CameraEvaluation(views[1:2]).mean("ca"))


def test_pictures(model, tiny_scene, tmp_path):
    evaluate_cameras(model, [tiny_scene.train[0].camera], pictures=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000.png", "000_panel.png"]
    with Image.open(tmp_path / "000_panel.png") as panel, Image.open(tmp_path / "000.png") as picture:
        assert picture.size == (32, 24)
        assert panel.width > 4 * 32 + 3 * 4  # as wide as the labels
        assert panel.height == 24 + 16
