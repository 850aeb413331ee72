"""Renders that share their projection against renders that do not, and the callables of a score against each other."""

import math
from dataclasses import replace

import pytest
import torch

from ca_reg import CAScore, GaussianDropout, OpacityNoise, Reason, attribute
from ca_reg.functional import Multiplier
from reference_trainer.evaluation.trained_model import MaskedRenders, TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(width=40, height=30, points=300)


@pytest.fixture(scope="module")
def model(scene) -> TrainedModel:
    points = scene.points
    assert points is not None
    generator = torch.Generator().manual_seed(0)
    gaussians = Gaussians.from_points(points.positions, points.colors, torch.full((300,), 0.3), sh_degree=1)
    logits = 2.0 * torch.randn(300, generator=generator)
    rest = 0.1 * torch.randn(gaussians.sh_rest.shape, generator=generator)
    return TrainedModel(replace(gaussians, opacity_logits=logits, sh_rest=rest), scene.background, "dropout(0.2)")


def assert_equal_renders(mine, other) -> None:
    for x, y in zip(mine, other, strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=1e-6)


def test_masked_renders_are_the_renders(model, scene):
    renders = MaskedRenders(model)
    generator = torch.Generator().manual_seed(1)
    masks = [torch.ones(300), (torch.rand(300, generator=generator) < 0.5).float(), torch.zeros(300)]
    for view in (scene.train[0], scene.train[1], scene.train[0]):
        for mask in masks:
            opacities = model.gaussians.opacities * mask
            assert_equal_renders(renders(opacities, view), model.render(opacities, view))


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
def test_other_opacities_are_rendered_as_well(model, scene, factor):
    opacities = (factor * model.gaussians.opacities).clamp(max=1.0)
    assert_equal_renders(MaskedRenders(model)(opacities, scene.train[0]), model.render(opacities, scene.train[0]))


def test_the_score_of_shared_renders_is_the_score(model, scene):
    opacities = model.gaussians.opacities
    shared = model.ca_score()(opacities, scene.train[0])
    plain = CAScore(model.render, p=0.2)(opacities, scene.train[0])
    assert shared.reason is Reason.OK
    both = shared.visible & plain.visible
    assert (shared.visible != plain.visible).sum() <= 1  # where an alpha is within rounding of the threshold
    torch.testing.assert_close(shared.variance[both], plain.variance[both], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("neutral", [False, True])
def test_the_shares_of_the_model_add_up_to_its_exact_score(model, scene, neutral):
    opacities = model.gaussians.opacities
    shares, result = attribute(model.exact_ca_score(neutral=neutral), model.shares, opacities, scene.train[0])
    assert result.value > 0
    assert shares.sum().item() == pytest.approx(result.value, rel=1e-5)
    outside = model.moments(opacities, scene.train[0], Multiplier.dropout(0.5))
    assert outside.variance.shape == (3, 30, 40)


@pytest.mark.parametrize("p", [0.0, 0.3])
def test_the_test_time_image_is_the_mean_of_the_training_images(model, scene, p):
    """Both regularizers in the order of the trainer, against one render with the expected opacities."""
    view, generator = scene.train[0], torch.Generator().manual_seed(2)
    logits = model.gaussians.opacity_logits + 2.0  # many opaque ones
    model = replace(model, gaussians=replace(model.gaussians, opacity_logits=logits), regularizer=f"dropout({p})")
    scaled = replace(model, regularizer=f"dropout({p}) + noise(0.8, scale=True)")
    dropout, noise = GaussianDropout(p), OpacityNoise(0.8)
    image, plain = (m.render(m.test_opacities, view)[0] for m in (scaled, model))
    step = plain - image
    # 0 where the mean is that of expected_noise, 1 where it is that of opacities without.
    place = []
    for _ in range(300):
        opacities = noise(dropout(model.gaussians.opacities, generator=generator), generator=generator)
        rendered = model.render(opacities, view)[0]
        place.append(((rendered - image) * step).sum() / step.square().sum())
    found = torch.stack(place)
    error = 5 * found.std().item() / math.sqrt(len(place))  # false alarm 6e-7
    clamp = image.max().item() / 99 * (step.abs().sum() / step.square().sum()).item()  # of alpha, over black
    assert abs(found.mean().item()) < error + clamp < 0.4


def test_test_time_opacities(model):
    opacities = model.gaussians.opacities
    assert torch.equal(replace(model, regularizer="").test_opacities, opacities)
    assert torch.equal(model.test_opacities, opacities * 0.8)
    assert torch.equal(
        replace(model, regularizer="dropout(ramp(0.0, 0.4, 0, 10))", step=6).test_opacities, opacities * 0.8
    )
    assert torch.equal(replace(model, regularizer="dropout(0.2, compensate=True)").test_opacities, opacities)
    both = replace(model, regularizer="dropout(0.2) + noise(0.6, clip=True, scale=True)")
    mean = Multiplier.clamped_noise(opacities, 0.6, clip=True).mean
    torch.testing.assert_close(both.test_opacities, 0.8 * mean * opacities)
    assert (model.factor, both.factor, replace(model, regularizer="dropout(0.2) + noise(0.6)").factor) == (
        0.8,
        None,
        0.8,
    )
    assert both.ca_score().settings == model.ca_score().settings


@pytest.mark.parametrize(
    ("schedule", "last"),
    [
        ("between(0.4, 0, 8)", 0.4),
        ("decay(0.6, 0.3, 0, 8)", 0.6 * 0.5 ** (7 / 8)),
        ("ramp(0.0, 0.4, 0, 8)", 0.35),
        ("between(0.4, 0, 7)", 0.0),
    ],
)
def test_a_model_is_rendered_with_the_rate_of_its_last_step(scene, schedule, last):
    """Also where a schedule stops with the training: of steps 0 to 7 the last drew with that rate."""
    trainer = Trainer(scene, TrainConfig(iterations=8, regularizer=f"dropout({schedule})", densify_every=0))
    trainer.train()
    trained = model_of(trainer)
    assert trained.dropout == pytest.approx(last)
    torch.testing.assert_close(trained.test_opacities, (1 - last) * trained.gaussians.opacities)
