"""Training with the renderer that is chosen, through a stand-in for gsplat."""

import dataclasses
import functools

import pytest
import torch
from stand_ins.gsplat import rasterization

from reference_trainer.renderers import gsplat
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


def test_a_run_with_gsplat_is_the_run_with_the_own_renderer(tiny_scene, busy, monkeypatch):
    monkeypatch.setattr(gsplat, "load_gsplat_render", lambda device: functools.partial(gsplat.render_by, rasterization))
    ours, theirs = Trainer(tiny_scene, busy), Trainer(tiny_scene, dataclasses.replace(busy, renderer="gsplat"))
    for trainer in (ours, theirs):
        trainer.train(until=4)  # up to the first densification
    seen = ours.density.statistics.steps > 0
    assert seen.any()
    torch.testing.assert_close(
        theirs.density.statistics.gradient_sum, ours.density.statistics.gradient_sum, rtol=1e-3, atol=1e-6
    )
    before = len(theirs.gaussians)
    theirs.train()
    assert (theirs.step, len(theirs.gaussians) != before) == (busy.iterations, True)


def test_the_choice_is_checked(tiny_scene):
    with pytest.raises(RuntimeError, match="--renderer builtin"):
        Trainer(tiny_scene, TrainConfig(renderer="gsplat"))
    with pytest.raises(ValueError, match=r"renderer 'cuda'; .*builtin, gsplat"):
        check(TrainConfig(renderer="cuda"))
    with pytest.raises(ValueError, match=r"analytic .*moments .*builtin"):
        check(TrainConfig(renderer="gsplat", analytic=True, dropout=0.2))
