"""The presets against the schedules of the code bases that they are named after, restated line by line.

Read at: INRIA 3DGS, release of 2023; FSGS a536a64; Binocular3DGS 2b3b7a4; of each train.py, scene/gaussian_model.py and
arguments. What the presets leave out is in docs/presets.md.
"""

import dataclasses
import math
from collections.abc import Iterator

import pytest
import torch

from reference_trainer.density import adaptive
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.scene import Scene
from reference_trainer.training import step as step_module
from reference_trainer.training.config import TrainConfig, with_preset
from reference_trainer.training.plan import make_plan
from reference_trainer.training.trainer import Trainer

Event = tuple[int, str, float | None]  # iteration, what happens after its gradient, and its number


def inria(white: bool) -> Iterator[Event]:
    for iteration in range(1, 30_001):
        if iteration < 15_000:
            if iteration > 500 and iteration % 100 == 0:
                yield iteration, "densify", 2e-4
                # Of the two tests by size the one on the screen has no effect: densifying has zeroed max_radii2D.
                yield iteration, "prune", 0.1 if iteration > 3_000 else None
            if iteration % 3_000 == 0 or (white and iteration == 500):
                yield iteration, "reset", 0.01


def fsgs(white: bool) -> Iterator[Event]:
    for iteration in range(1, 10_001):
        if iteration < 10_000 and iteration > 500 and iteration % 100 == 0:
            yield iteration, "densify", 5e-4
            yield iteration, "prune", None  # size_threshold = None
        if (iteration - 2_000 - 1) % 3_000 == 0 and iteration > 2_000:
            yield iteration, "reset", 0.05


def binocular(white: bool) -> Iterator[Event]:
    densify_until = 15_000
    for iteration in range(1, 30_001):
        if iteration > 500:
            densify_until = 30_000
            if iteration < 30_000:  # the last one's decay, without a step after it, is left out
                yield iteration, "decay", 0.995
        if iteration < densify_until and iteration > 500 and iteration % 100 == 0:
            yield iteration, "densify", 2e-4
            yield iteration, "prune", None


def control(monkeypatch: pytest.MonkeyPatch, scene: Scene, config: TrainConfig) -> list[Event]:
    """Run nothing but density control, and list what it does."""
    trainer, events = Trainer(scene, config), []

    def note(name: str, number):
        monkeypatch.setattr(
            adaptive, name, lambda *a, **k: events.append((trainer.step, name.split("_")[0], number(*a, **k)))
        )

    note("densify", lambda *a, **k: config.densify_gradient)
    note("prune", lambda *a, max_scale, **k: None if max_scale is None else pytest.approx(max_scale / scene.extent))
    note("reset_opacity", lambda optimizer, ceiling: ceiling)
    note("decay_opacity", lambda optimizer, factor: factor)
    for trainer.step in range(config.iterations):
        trainer.density.before_step(trainer.optimizer, trainer.step)
    return events


@pytest.mark.parametrize("white", [False, True])
@pytest.mark.parametrize("code_base", [inria, fsgs, binocular])
def test_events_happen_at_the_iterations_of_the_code_base(tiny_scene, monkeypatch, code_base, white):
    scene = dataclasses.replace(tiny_scene, background=torch.full((3,), float(white)))
    happened, expected = control(monkeypatch, scene, with_preset(code_base.__name__)), list(code_base(white))
    assert len(expected) > 180
    for one, other in zip(happened, expected, strict=False):
        assert one == other
    assert len(happened) == len(expected)


@pytest.mark.parametrize(("name", "every", "most"), [("inria", 1_000, 3), ("fsgs", 500, 3), ("binocular", 1_000, 1)])
def test_bands_begin_with_the_iteration_of_the_code_base(tiny_scene, monkeypatch, name, every, most):
    """They call ``oneupSHdegree`` before the render of every iteration that ``every`` divides."""
    trainer, used = Trainer(tiny_scene, with_preset(name, densify_every=0)), []
    original = step_module.render_gaussians
    monkeypatch.setattr(
        step_module, "render_gaussians", lambda *a, **k: used.append(k["sh_degree"]) or original(*a, **k)
    )
    near = [k * every + d for k in (1, 2, 3, 4) for d in (-1, 0)]
    expected = [min(most, iteration // every) for iteration in near]
    for iteration in near:
        trainer.step = iteration - 1
        trainer.train_step()
        assert trainer.sh_degree == used[-1]
    assert used == expected


@pytest.mark.parametrize("name", ["inria", "fsgs", "binocular"])
def test_rates_and_thresholds(tiny_scene, name):
    config = with_preset(name)
    groups = {group["name"]: group for group in Trainer(tiny_scene, config).optimizer._adam.param_groups}
    rates = {name: group["lr"] for name, group in groups.items()}
    assert rates == {
        "means": pytest.approx(1.6e-4 * tiny_scene.extent), "sh_dc": 0.0025, "sh_rest": 0.0025 / 20,
        "opacity_logits": 0.05, "log_scales": 0.005, "quaternions": 0.001,
    }  # fmt: skip
    assert all(group["eps"] == 1e-15 and group["betas"] == (0.9, 0.999) for group in groups.values())
    assert (config.means_rate_final, config.make_losses()[0].lambda_dssim, config.dense_fraction) == (1.6e-6, 0.2, 0.01)
    assert (config.prune_opacity, config.initial_opacity, config.initial_scale) == (0.005, 0.1, 1.0)


def test_resets_over_white_stay_off_without_resets_and_are_planned(tiny_scene, monkeypatch):
    white = dataclasses.replace(tiny_scene, background=torch.ones(3))
    config = with_preset("inria", iterations=700, opacity_reset_every=0)
    assert not [event for event in control(monkeypatch, white, config) if event[1] == "reset"]
    plans = [make_plan(scene, with_preset("inria", iterations=700)) for scene in (tiny_scene, white)]
    decisions = [next(item for item in plan.items if item.name == "opacity reset").decision for plan in plans]
    assert decisions == ["left out", "used"]


def test_large_gaussians_are_removed_by_their_size_in_the_world_only(tiny_scene):
    """With the thresholds of the inria preset; its 20 pixels on the screen have no effect there either."""
    trainer = Trainer(tiny_scene, with_preset("inria", densify_gradient=1e9))
    with torch.no_grad():
        trainer.gaussians.log_scales[:] = math.log(0.09 * tiny_scene.extent)
        trainer.gaussians.log_scales[:5, 1] = math.log(0.12 * tiny_scene.extent)
        trainer.gaussians.means.mul_(0.1)
    camera, background = tiny_scene.train[0].camera, tiny_scene.background
    radii = render_gaussians(trainer.gaussians, camera, background).splats.projection.radii
    assert (radii > 20).sum() > 20
    for step, left in ((3_000, 150), (3_100, 145), (3_200, 145)):
        with torch.no_grad():  # the reset at 3,000 lowers them
            trainer.gaussians.opacity_logits[:] = 0.0
        trainer.step = step - 1
        trainer.train_step()
        trainer.density.before_step(trainer.optimizer, trainer.step)
        assert len(trainer.gaussians) == left
