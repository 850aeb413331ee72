"""What every strategy must keep, whatever its rule."""

import dataclasses
import math
import re

import pytest
import torch
from devices import CARD, DEVICES
from strategies import short

from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import DENSITY
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.trainer import Trainer

ALL = {
    "adaptive": "adaptive",
    "absgrad": "absgrad(1e-5, 2e-5, 0.05, ceiling_every=7)",
    "proximity": "proximity(distance=0.001, split_distance=0.01)",
    "mcmc": "mcmc(growth=1.2)",
    "ray_boxes": "ray_boxes(height=5, width=8)",
    "share_pruning": "share_pruning(every=3, fraction=0.1)",
    "co_pruning": "co_pruning(0.5, every=3)",
    "self_ensembling": "self_ensembling(2.0, every=2, start=4, stop=13, views=2)",
}


def test_all_are_tested():
    assert set(ALL) == set(DENSITY)


@pytest.mark.parametrize("expression", ALL.values(), ids=ALL)
def test_a_resumed_training_is_identical(tiny_scene, busy, tmp_path, expression):
    config = short(busy, expression, 14)
    whole = Trainer(tiny_scene, config)
    whole.train()
    assert len(whole.gaussians) != 150  # or nothing would have happened
    for at in (6, 8):  # between two densifications, and where one is due
        part = Trainer(tiny_scene, config)
        part.train(until=at)
        part.save(tmp_path / "checkpoint.pt")
        again = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
        again.train()
        for one, other in zip(whole.models, again.models, strict=True):
            torch.testing.assert_close(other.state_dict(), one.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("device", [pytest.param(CARD, marks=pytest.mark.slow), DEVICES[2]], indirect=True)
@pytest.mark.parametrize("expression", ALL.values(), ids=ALL)
def test_all_work_on_a_device(tiny_scene, busy, expression, device):
    trainer = Trainer(tiny_scene, short(busy, expression, 10), device)
    trainer.train()
    assert len(trainer.gaussians) != 150
    assert all(bool(x.isfinite().all()) for _, x in trainer.gaussians.named())
    found = [*trainer.gaussians.named(), *trainer.density.state_dict().items()]
    assert {x.device.type for _, x in found} == {torch.device(device).type}


@pytest.mark.parametrize("name", ["means", "opacity_logits", "sh_dc"])
@pytest.mark.parametrize("expression", ALL.values(), ids=ALL)
def test_gaussians_that_are_not_numbers_stop_the_training_and_are_said_to(tiny_scene, busy, expression, name):
    """At a step at which strategies that prune or render by a schedule of their own do so, and nothing is densified."""
    trainer = Trainer(tiny_scene, dataclasses.replace(short(busy, expression, 14), densify_every=5))
    trainer.train(until=6)
    with torch.no_grad():
        getattr(trainer.models[-1].gaussians, name)[0] = math.nan
    with pytest.raises(TrainingStoppedError, match=r"finite|nan .*step 6"):
        trainer.train()


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("absgrad(0)", "clone_gradient must be positive"),
        ("absgrad(split_gradient=-1.0)", "split_gradient must be positive"),
        ("absgrad(dense_fraction=0)", "dense_fraction must be positive"),
        ("absgrad(opacity_ceiling=1.0)", "opacity_ceiling must be in"),
        ("absgrad(ceiling_every=-1)", "ceiling_every .*at least 0, got -1: 0 "),
        ("proximity(until=-1)", "until .*at least 0, got -1: 0 "),
        ("proximity(distance=0.0)", "distance and split_distance .*positive"),
        ("mcmc(noise=-1)", "noise .*at least 0, got -1: 0 "),
        ("mcmc(growth=0.9)", "growth .*at least 1, got 0.9: 1 "),
        ("ray_boxes(views=1)", "views .*at least 2, got 1"),
        ("ray_boxes(height=0)", "height .*at least 1, got 0"),
        ("share_pruning(every=0)", "every .*at least 1, got 0: .*'adaptive'"),
        ("share_pruning(fraction=1.0)", "fraction must be in"),
        ("share_pruning(drop_rate=0.0)", "drop_rate must be in"),
        ("co_pruning(0)", "distance must be positive"),
        ("co_pruning(every=0)", "every .*at least 1, got 0: .*'adaptive'"),
        ("self_ensembling(first=0.0)", "above 0|positive"),
        ("self_ensembling(views=0)", "views .*at least 1, got 0"),
        ("self_ensembling(share=1.0)", "share in"),
        ("self_ensembling(least=-0.1)", "least >= 0"),
        ("co_pruning", "compares models, .*models=2"),
    ],
)
def test_bad_arguments_are_refused(expression, message):
    with pytest.raises(ValueError, match=message):
        check(TrainConfig(density=expression))


@pytest.mark.parametrize(
    ("expression", "name"),
    [
        ("absgrad(ceiling_every=0.5)", "ceiling_every"),
        ("proximity(until=2e3)", "until"),
        ("ray_boxes(views=2.5)", "views"),
        ("ray_boxes(height=20.5)", "height"),
        ("ray_boxes(width=40.5)", "width"),
        ("share_pruning(every=500.5)", "every"),
        ("co_pruning(every=500.5)", "every"),
        ("self_ensembling(views=2.5)", "views"),
    ],
)
def test_counts_are_integers(expression, name):
    with pytest.raises(ValueError, match=f"^{re.escape(repr(expression))}: {name} .*integer, got float"):
        check(TrainConfig(density=expression))
