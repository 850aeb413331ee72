"""What all terms share: weights that follow schedules, demands on the views, and that an idle term costs nothing."""

import dataclasses
from contextlib import nullcontext

import pytest

from reference_trainer.renderers import BuiltinRenderer
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.trainer import Trainer


def test_a_weight_follows_its_schedule_and_idle_terms_are_not_met(tiny_scene, monkeypatch):
    depths, render = [], BuiltinRenderer.__call__

    def spied(self, **arguments):
        depths.append(arguments["depth"])
        return render(self, **arguments)

    monkeypatch.setattr(BuiltinRenderer, "__call__", spied)
    loss = "photometric + smooth_depth(between(0.1, 2, 3)) + warp(0.0) + opacity(0.01)"
    Trainer(tiny_scene, TrainConfig(iterations=4, loss=loss)).train()
    assert depths == [False, False, True, False]


def test_a_schedule_decides_the_weight_of_each_step(take_step):
    term, plain = LOSSES.make("opacity(ramp(0.0, 0.4, 10, 20)) + opacity(1.0)")
    for number, weight in ((10, 0.0), (15, 0.2), (30, 0.4)):
        step = take_step(number=number)
        assert term(step).item() == pytest.approx(weight * plain(step).item())


def test_a_negative_weight_is_refused_at_its_step(take_step):
    (term,) = LOSSES.make("opacity(ramp(0.1, -0.1, 0, 10))")
    assert term(take_step(number=0)) > 0
    with pytest.raises(ValueError, match=r"weight .*negative, got -0\.1"):
        term(take_step(number=10))


def test_every_registered_term_takes_a_weight():
    for name in LOSSES:
        assert isinstance(LOSSES.make(name)[0], WeightedTerm)
        with pytest.raises(ValueError, match=r"weight .*negative"):
            LOSSES.make(f"{name}(weight=-1.0)")


def test_terms_look_at_the_photographs_before_the_first_step(tiny_scene):
    for loss, message in (("pearson", "lack"), ("patch_depth", "lack"), ("alpha", "have no alpha")):
        with pytest.raises(ValueError, match=message):
            Trainer(tiny_scene, TrainConfig(loss=f"photometric + {loss}"))


@pytest.mark.parametrize("name", list(LOSSES))
def test_analytic_training_refuses_what_needs_a_draw_and_nothing_else(name):
    needs_one = name in {"pearson", "patch_depth", "warp", "alpha", "straight_through"}
    with pytest.raises(ValueError, match=r"analytic .*no draw") if needs_one else nullcontext():
        check(TrainConfig(dropout=0.2, analytic=True, models=2, loss=f"photometric + {name}"))


@pytest.mark.parametrize("name", ["photometric", "views", "consistency", "straight_through", "co_regularization"])
def test_a_weight_of_ssim_out_of_range_is_refused(name):
    with pytest.raises(ValueError, match=r"lambda_dssim .*\[0, 1\], got 1\.5"):
        LOSSES.make(f"{name}(lambda_dssim=1.5)")


@pytest.mark.slow
@pytest.mark.parametrize(
    "term",
    ["pearson(0.5, None)", "patch_depth", "patch_depth(which='hard') + patch_depth(which='soft')", "warp(smooth=0.1)",
     "smooth_depth(0.1)", "alpha(dark=1.0)", "views(2)", "flat(0.1)", "scale(1.0)",
     "ray_extent(1.0, 1e-3)", "opacity(0.1, 0.2)"],
)  # fmt: skip
def test_every_term_trains_beside_dropout(tiny_scene, term):
    views = tuple(dataclasses.replace(view, depth_prior=view.depth) for view in tiny_scene.train)
    scene = dataclasses.replace(tiny_scene, train=views)
    config = TrainConfig(iterations=4, dropout=0.2, loss=f"photometric + {term}")
    alone = dataclasses.replace(config, loss="photometric")
    trainers = [Trainer(scene, each) for each in (alone, config)]
    for trainer in trainers:
        trainer.train()
    assert any(not a.equal(b) for (_, a), (_, b) in zip(*(t.gaussians.named() for t in trainers), strict=True))
