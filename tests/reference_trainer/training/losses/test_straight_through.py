"""The error of one render with the gradients of another, against a chain rule of two separate derivatives."""

import pytest
import torch

from ca_reg import Chain, GaussianDropout
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.comparisons import StraightThrough
from reference_trainer.training.losses.photometric import Photometric, photometric_loss
from reference_trainer.training.trainer import Trainer

NAMES = "opacity_logits", "sh_dc", "means", "log_scales"


@pytest.fixture
def step(take_step, six):
    """A step that has dropped some of its Gaussians, of which the parameters want gradients."""
    raw = {name: getattr(six, name).detach().clone().requires_grad_() for name in NAMES}
    taken = take_step(seed=3, regularizer=Chain(GaussianDropout(0.5, compensate=True)), **raw)
    assert 0 < taken.regularizer.keep.count_nonzero() < 6
    return taken


def gradients(of, step, weights=None):
    leaves = [getattr(step.gaussians, name) for name in NAMES]
    return torch.autograd.grad(of, leaves, weights, retain_graph=True)


@pytest.mark.parametrize("error", ["full", "dropped"])
def test_the_error_of_one_render_and_the_derivatives_of_the_other(error, step):
    images = {"full": step.render(step.view.camera).image, "dropped": step.image}
    seen = images.pop(error).detach().requires_grad_()
    (through,) = images.values()
    loss = photometric_loss(seen, step.view.image)
    (errors,) = torch.autograd.grad(loss, seen)
    found = StraightThrough(error)(step)
    torch.testing.assert_close(found, loss, rtol=1e-6, atol=1e-12)
    plain = gradients(Photometric()(step), step)
    for one, other, usual in zip(gradients(found, step), gradients(through, step, errors), plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-12)
        assert not torch.allclose(one, usual, rtol=1e-3), "the step's own error or derivatives"


@pytest.mark.parametrize(("error", "counted"), [("full", 0), ("dropped", 1)])
def test_density_control_counts_the_render_that_learns(error, counted, step):
    StraightThrough(error)(step).backward()
    learned = [splats.means.grad is not None for splats, _ in step.observed]
    assert [place for place, it in enumerate(learned) if it] == [counted]


def test_without_a_regularizer_it_is_the_photometric_loss(take_step):
    step = take_step()
    for error in ("full", "dropped"):
        torch.testing.assert_close(StraightThrough(error, 0.3)(step), Photometric(0.3)(step))


def test_arguments():
    for text, message in (
        ("straight_through('mean')", "error must be full or dropped, got 'mean'"),
        ("straight_through(lambda_dssim=2.0)", "lambda_dssim must lie"),
        ("straight_through(weight=-1.0)", "weight must not be negative"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)


@pytest.mark.slow
def test_it_trains(tiny_scene):
    ends = []
    for loss in ("photometric", "straight_through('full')", "straight_through('dropped')"):
        trainer = Trainer(tiny_scene, TrainConfig(iterations=4, loss=loss, regularizer="dropout(0.2, compensate=True)"))
        trainer.train()
        ends.append(trainer.gaussians.opacity_logits)
    assert not any(torch.equal(ends[a], ends[b]) for a, b in ((0, 1), (0, 2), (1, 2)))
