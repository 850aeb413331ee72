"""MVGS's further views against the photometric loss of each by itself."""

import pytest
import torch

from ca_reg import Chain, GaussianDropout
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.photometric import photometric_loss
from reference_trainer.training.losses.views import Views
from reference_trainer.training.trainer import Trainer


def losses_of_others(six, three_views, background):
    images = [render_gaussians(six, view.camera, background).image for view in three_views[1:]]
    return [photometric_loss(x, view.image).item() for x, view in zip(images, three_views[1:], strict=True)]


@pytest.mark.parametrize("n", [2, 3, 9])
def test_the_losses_of_further_views_add_up_and_density_control_sees_them(six, three_views, take_step, n):
    chosen = set()
    for seed in range(12):  # of two views always the same one: once in 2,048
        step = take_step(seed=seed, depth=False)
        one, other = losses_of_others(six, three_views, step.background)
        value = Views(n, 0.5)(step).item()
        sums = {"both": one + other} if n > 2 else {"b": one, "c": other}
        chosen.add(next(names for names, x in sums.items() if value == pytest.approx(0.5 * x, rel=1e-10)))
        assert len(step.observed) == min(n, 3)
        assert step.view.name == "a", "the step is still of its own view"
    assert len(chosen) == (2 if n == 2 else 1)


def test_every_view_has_a_draw_of_its_own(take_step):
    chain = Chain(GaussianDropout(0.5))
    keeps = set()
    step = take_step(depth=False, regularizer=chain)
    for view in step.views:
        other = step.at(view)
        keeps.add(tuple(chain.keep.tolist()))
        assert torch.equal(other.image, step.at(view).image), "which is the same when taken again"
    assert len(keeps) > 1  # false once in 4,096 seeds


def test_an_analytic_step_takes_the_expectation_at_every_view(tiny_scene):
    config = TrainConfig(iterations=1, dropout=0.3, analytic=True, loss="photometric + views(2)")
    trainer = Trainer(tiny_scene, config)
    seen, sizes = trainer.losses[1], []
    original = seen.photometric
    seen.photometric = lambda step: sizes.append(step.variance) or original(step)
    trainer.train()
    assert len(sizes) == 1
    assert sizes[0].max() > 0


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(Views(3, 0.7, lambda_dssim=0.0), "means", "opacity_logits")


def test_arguments():
    for text, message in (
        ("views(1)", "n must be at least 2, got 1: one view is what photometric has"),
        ("views(2.5)", r"'views\(2\.5\)': n must be an integer, got float"),
        ("views(2, -1.0)", "weight must"),
        ("views(2, 1.0, 2.0)", "lambda_dssim"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
