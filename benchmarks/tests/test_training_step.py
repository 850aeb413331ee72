"""What surrounds a rendering is timed on the right thing."""

import itertools

import pytest
import torch

from benchmarks import training_step
from benchmarks.calls import image, render_with
from benchmarks.training_step import PARTS, analytic_step, scores, step_parts
from benchmarks.workloads import WorkloadSpec
from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture
def steps(monkeypatch):
    """What every step of a training was: its degree, whether it is analytic, and what rendered it."""
    seen = []
    original, render = Trainer.train_step, training_step.render_gaussians

    def train_step(trainer):
        seen.append((trainer.sh_degree, trainer.config.analytic))
        return original(trainer)

    def part(*args, **keywords):
        out = render(*args, **keywords)
        seen.append((keywords["sh_degree"], out.splats.engine.name))
        return out

    monkeypatch.setattr(Trainer, "train_step", train_step)
    monkeypatch.setattr(training_step, "render_gaussians", part)
    return seen


@pytest.fixture
def scene():
    return synthetic_scene(width=20, height=15, points=60)


def test_a_step_and_its_parts_are_timed_with_all_bands(scene, steps):
    ticks = itertools.count()
    found = step_parts(scene, "torch", repeats=2, device=CPU, clock=lambda: float(next(ticks)))
    assert steps[3:] == [(3, False), (3, "torch")] * 3
    # One tick for the whole step, two for the renderer, one each for loss and optimizer: what is left is -3.
    assert found == {"step": [1, 1], "renderer": [2, 2], "loss": [1, 1], "optimizer": [1, 1], "rest": [-3, -3]}
    assert list(found) == ["step", *PARTS]


def test_analytic_and_sampled_steps_take_turns(scene, steps):
    found = analytic_step(scene, "numba", repeats=2, device=CPU, clock=itertools.count().__next__)
    assert steps[6:] == [(3, False), (3, True)] * 3
    assert found == {"sampled": [1, 1], "analytic": [1, 1]}


@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_scores_are_those_of_the_workload_rendered_by_the_engine(engine, monkeypatch):
    rendered = []
    splats = training_step.TrainedModel.splats

    def spy(self, opacities, view):
        rendered.append(splats(self, opacities, view))
        return rendered[-1]

    monkeypatch.setattr(training_step.TrainedModel, "splats", spy)
    workload = WorkloadSpec(300, 40, 24, 0.06).make()
    calls = scores(workload, engine)
    found, _ = calls["render"]()
    torch.testing.assert_close(found, image(render_with(engine), workload), rtol=0, atol=1e-5)
    exact = calls["exact score"]()
    sampled = [calls["score, K = 5"]() for _ in range(2)]
    assert [len(x.indices) for x in rendered] == [300] * 3  # one projection for each score, none is kept
    assert {x.engine.name for x in rendered} == {engine}
    assert 0 < exact.value < 1
    assert sampled[0].value == sampled[1].value > 0
