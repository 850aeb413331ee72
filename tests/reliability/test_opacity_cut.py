"""The cut at 1/255 and what falls below it: without a regularizer for ever, with noise until the next lucky draw."""

import math
from typing import Any

import pytest
import torch

from reference_trainer.render.constants import MIN_ALPHA
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

BELOW = 0.75 * MIN_ALPHA  # 0.0029: under the cut, and under what pruning removes


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(width=32, height=24, points=150)


def lowered(scene: Scene, opacity: float, steps: int, **settings: Any) -> tuple[torch.Tensor, Trainer]:
    """Lower all opacities, train, and tell which of the Gaussians ever received a gradient of their opacity."""
    config = TrainConfig(iterations=steps, opacity_reset_every=0, **{"densify_every": 0, **settings})
    trainer = Trainer(scene, config)
    logits = torch.logit(torch.full((150,), opacity))
    trainer.optimizer.set_opacity_logits(logits)
    reached, step = torch.zeros(150, dtype=torch.bool), trainer.optimizer.step

    def note() -> None:
        nonlocal reached
        reached |= trainer.gaussians.opacity_logits.grad != 0
        step()

    trainer.optimizer.step = note  # type: ignore[method-assign]
    trainer.train()
    return reached, trainer


def seen(scene: Scene) -> torch.Tensor:
    """Gaussians that have a pixel in a training view when they are faint but above the cut."""
    return lowered(scene, 0.02, 3)[0]


def test_without_noise_what_is_below_the_cut_stays_there(scene):
    reached, trainer = lowered(scene, BELOW, 12)
    assert not reached.any()
    assert trainer.gaussians.opacities.detach() == pytest.approx(BELOW)


def test_with_noise_it_comes_back_because_every_step_draws_anew(scene):
    """Above the cut with probability 1 - Phi((4/3 - 1) / 0.8) = 0.34 at each step; of 30 none with 4e-6."""
    steps, chance = 30, 0.5 * math.erfc((MIN_ALPHA / BELOW - 1) / 0.8 / math.sqrt(2))
    assert chance == pytest.approx(0.34, abs=0.005)
    reached, trainer = lowered(scene, BELOW, steps, noise=0.8)
    visible = seen(scene)
    assert visible.sum() > 100
    # A footprint shrinks to a point near the cut: it may miss all pixel centers.
    assert reached[visible].float().mean() > 0.5
    assert trainer.gaussians.opacities[reached].max() > 2 * MIN_ALPHA


def test_a_reset_to_one_percent_under_strong_noise_kills_nobody(scene):
    """gsplat resets to 0.01; noise of sigma 0.8 takes a quarter below the cut at every step, each time another one."""
    hidden = 0.5 * math.erfc((1 - MIN_ALPHA / 0.01) / 0.8 / math.sqrt(2))
    assert hidden == pytest.approx(0.22, abs=0.01)
    reached, _ = lowered(scene, 0.01, 30, noise=0.8)
    plain, _ = lowered(scene, 0.01, 30)
    assert bool(reached[plain].all())


def test_what_stays_below_is_pruned_at_the_next_densification(scene):
    """Nothing invisible is carried along."""
    _, trainer = lowered(scene, 0.02, 6, densify_every=4, densify_from=1, densify_gradient=1e9)
    logits = trainer.gaussians.opacity_logits.detach().clone()
    logits[:40] = math.log(BELOW / (1 - BELOW))
    trainer.optimizer.set_opacity_logits(logits)
    before = len(trainer.gaussians)
    trainer.step = 4
    trainer.density.before_step(trainer.optimizer, trainer.step)
    assert len(trainer.gaussians) == before - 40
