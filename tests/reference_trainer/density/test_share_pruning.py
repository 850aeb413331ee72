"""Pruning by shares of the exact score."""

import pytest
import torch

from ca_reg import CAScore
from reference_trainer.evaluation.shares import blend_weights
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


def opaque(scene, density: str, **settings) -> Trainer:
    """A training whose views have a score: large Gaussians that let little through."""
    trainer = Trainer(scene, TrainConfig(iterations=9, density=density, opacity_reset_every=0, **settings))
    with torch.no_grad():
        trainer.gaussians.opacity_logits[:] = torch.linspace(1.0, 4.0, 150)
        trainer.gaussians.log_scales.add_(0.7)
    return trainer


def test_share_pruning_removes_the_highest_shares_per_weight(tiny_scene):
    """The shares add up to the scores of the training views at plain opacities, which are rendered another way."""
    trainer = opaque(tiny_scene, "share_pruning(5, 0.1, 0.3)", densify_from=1, densify_every=0, dropout=0.4)
    trainer.train(until=5)
    strategy, optimizer = trainer.density, trainer.optimizer
    values = strategy.shares_per_weight(optimizer, 5)
    model = TrainedModel(trainer.gaussians.map(torch.Tensor.detach), trainer.background, sh_degree=trainer.sh_degree)
    score, weights = CAScore.exact(model.moments, drop_rate=0.3), blend_weights(model, trainer.views)
    scores = [score(model.gaussians.opacities, view).value for view in trainer.views]
    assert min(scores) > 0
    assert (values[weights > 0] * weights[weights > 0]).sum().item() == pytest.approx(sum(scores), rel=1e-3)

    counted, means = strategy.statistics.steps.clone(), model.gaussians.means.clone()
    strategy.before_step(optimizer, 5)
    kept = torch.tensor([bool((optimizer.gaussians.means == mean).all(1).any()) for mean in means])
    assert int((~kept).sum()) == 15
    assert values[~kept].min() >= values[kept].max()
    assert torch.equal(strategy.statistics.steps, counted[kept])
    strategy.before_step(optimizer, 6)
    assert len(optimizer.gaussians) == 135


def test_share_pruning_keeps_those_without_a_share(tiny_scene):
    trainer = opaque(tiny_scene, "share_pruning(1, 0.9)", densify_from=0, densify_every=0)
    with torch.no_grad():
        trainer.gaussians.means[100:] += 1e3  # out of every view
    trainer.density.before_step(trainer.optimizer, 1)
    assert int((trainer.gaussians.means > 500).all(1).sum()) == 50
    assert len(trainer.gaussians) < 150
