"""The recipes against the schedules of the code bases that they are named after, restated line by line.

Read at the commits that `Recipe.source` names: train.py, scene/gaussian_model.py, arguments, scripts. What they
leave out is in docs/recipes.md.
"""

import dataclasses
import math
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import pytest
import torch

from ca_reg.schedules import as_schedule
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render.densification import SMALLEST_SPREAD, longer_radii
from reference_trainer.scenes.depth import true_priors
from reference_trainer.scenes.scene import Scene
from reference_trainer.training import step as step_module
from reference_trainer.training.assembly import check, make_density, make_losses
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import adaptive
from reference_trainer.training.plan import make_plan
from reference_trainer.training.recipes import RECIPES, with_recipe
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


def dngaussian(white: bool) -> Iterator[Event]:  # scripts/run_llff.sh; its resets are commented out
    for iteration in range(1, 6_001):
        if iteration < 6_000 and iteration > 500 and iteration % 100 == 0:
            yield iteration, "densify", 0.0013 / 1.2  # of L1 + 0.2 (1 - SSIM), which is 1.2 times ours
            yield iteration, "prune", None


def corgs(white: bool) -> Iterator[Event]:  # and SE-GS, by their LLFF scripts
    for iteration in range(1, 10_001):
        if iteration < 10_000 and iteration > 500 and iteration % 100 == 0:
            yield iteration, "densify", 5e-4
            yield iteration, "prune", None
        if (iteration - 500 - 1) % 3_000 == 0 and iteration > 500:
            yield iteration, "reset", 0.05


def absgs(white: bool) -> Iterator[Event]:
    of = {iteration: list(events) for iteration, events in groupby(inria(white), lambda event: event[0])}
    for iteration in range(1, 30_001):
        yield from of.get(iteration, [])
        if iteration < 15_000 and iteration % 500 == 0:
            yield iteration, "reset", 0.8  # there before resets, of which the lower one holds in either order


def sparse(white: bool) -> Iterator[Event]:  # ours: fsgs at three tenths but later, with Binocular3DGS's decay
    for iteration in range(1, 3_000):
        if iteration > 1_000:
            yield iteration, "decay", 0.995
            if iteration % 100 == 0:
                yield iteration, "densify", 5e-4
                yield iteration, "prune", None
        if iteration == 600:
            yield iteration, "reset", 0.05


def distilled(white: bool) -> Iterator[Event]:  # ours: nothing is made or removed
    yield from ()


CODE_BASES = {
    "3dgs": fsgs, "inria": inria, "fsgs": fsgs, "dngaussian": dngaussian, "binocular": binocular, "mvgs": inria,
    "absgs": absgs, "corgs": corgs, "segs": corgs, "sparse": sparse,
    "distilled": distilled,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    """With a depth prior, which some need."""
    return true_priors(tiny_scene, "true")


def named(name: str, **changes: Any) -> TrainConfig:
    """A recipe with all that it needs beside the scene."""
    loss = {"loss": "photometric + distillation('a.ply', 'b.ply')"} if name == "distilled" else {}
    return with_recipe(name, **{**loss, **changes})


def test_all_are_tested():
    assert set(CODE_BASES) == set(RECIPES)


def control(monkeypatch: pytest.MonkeyPatch, scene: Scene, config: TrainConfig) -> list[Event]:
    """Run nothing but density control, and list what it does."""
    trainer, events = Trainer(scene, config), []

    def note(name: str, number):
        monkeypatch.setattr(
            adaptive, name, lambda *a, **k: events.append((trainer.step, name.split("_")[0], number(*a, **k)))
        )

    kind = type(trainer.density)
    monkeypatch.setattr(
        kind, "grow", lambda self, *a: events.append((trainer.step, "densify", self.config.densify_gradient))
    )
    note("prune", lambda *a, max_scale, **k: None if max_scale is None else pytest.approx(max_scale / scene.extent))
    note("reset_opacity", lambda optimizer, ceiling: ceiling)
    note("decay_opacity", lambda optimizer, factor: factor)
    for trainer.step in range(config.iterations):
        trainer.density.before_step(trainer.optimizer, trainer.step)
    return events


@pytest.mark.parametrize("white", [False, True])
@pytest.mark.parametrize("name", RECIPES)
def test_events_happen_at_the_iterations_of_the_code_base(scene, monkeypatch, name, white):
    scene = dataclasses.replace(scene, background=torch.full((3,), float(white)))
    happened, expected = control(monkeypatch, scene, named(name)), list(CODE_BASES[name](white))
    assert len(expected) > 100 or name == "distilled"
    for one, other in zip(happened, expected, strict=False):
        assert one == other
    assert len(happened) == len(expected)


@pytest.mark.parametrize(("name", "every", "most"), [
    ("3dgs", 500, 3), ("inria", 1_000, 3), ("fsgs", 500, 3), ("binocular", 1_000, 1), ("mvgs", 1_000, 3),
    ("absgs", 1_000, 3),
])  # fmt: skip
def test_bands_begin_with_the_iteration_of_the_code_base(scene, monkeypatch, name, every, most):
    """They call ``oneupSHdegree`` before the render of every iteration that ``every`` divides."""
    trainer, used = Trainer(scene, with_recipe(name, densify_every=0)), []
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
    assert used == [degree for degree in expected for _ in range(len(used) // len(near))]  # mvgs renders three views


@pytest.mark.parametrize("name", RECIPES)
def test_rates_and_thresholds(scene, name):
    config, far = named(name), {"dngaussian": 100, "distilled": 0.1}.get(name, 1)
    groups = {group["name"]: group for group in Trainer(scene, config).optimizer._adam.param_groups}
    rates = {name: group["lr"] for name, group in groups.items()}
    assert rates == {
        "means": pytest.approx(far * 1.6e-4 * scene.extent), "sh_dc": 0.0025, "sh_rest": 0.0025 / 20,
        "opacity_logits": 0.05, "log_scales": 0.003 if far > 1 else 0.005, "quaternions": 0.001,
    }  # fmt: skip
    assert all(group["eps"] == 1e-15 and group["betas"] == (0.9, 0.999) for group in groups.values())
    # DNGaussian's L1 + 0.2 (1 - SSIM) is this but for a factor.
    dssim = pytest.approx(0.2 / 1.2, abs=1e-6) if far > 1 else 0.2
    last = 1.6e-4 if name == "segs" else max(far, 1) * 1.6e-6
    assert (config.means_rate_final, make_losses(config)[0].lambda_dssim) == (pytest.approx(last), dssim)
    assert (config.prune_opacity, config.initial_opacity) == (0.01 if far > 1 else 0.005, 0.1)
    assert (config.dense_fraction, config.initial_scale) == (0.01, 1.0)


# Weights of the terms by iteration, of the train.py and arguments of each.
WEIGHTS = {
    "fsgs": {"Pearson": lambda i: 0.001 if i > 9_500 else 0.05},
    "binocular": {"Alpha": lambda i: 1.0, "Warp": lambda i: float(i > 20_000)},
    "dngaussian": {  # the photometric loss is 1.2 times ours; 0.01 is ours, the passes begin where theirs do
        "PatchDepth": lambda i: 0.01 + 0.01 * (i > 1_000),
        "Flat": lambda i: 0.002 / 1.2,
        "Scale": lambda i: 0.001 / 1.2,
        "Opacity": lambda i: 0.001 / 1.2,
    },
    "mvgs": {"Views": lambda i: 1.0},
    "sparse": {"SmoothDepth": lambda i: 0.1 * (i > 1_000)},
    "distilled": {"Distillation": lambda i: 1.0},
    "corgs": {"CoRegularization": lambda i: float(i > 500)},
    "segs": {"CoRegularization": lambda i: float(i > 500)},
}


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize("share", [1.0, 0.1])
def test_terms_act_when_those_of_the_code_base_do(name, share):
    config = named(name, iterations=round(share * RECIPES[name].config.iterations))
    terms = make_losses(config)
    assert {type(term).__name__ for term in terms} == {"Photometric", *WEIGHTS.get(name, {})}
    for kind, weight in WEIGHTS.get(name, {}).items():
        for iteration in (1, 1_000, 1_010, 9_500, 9_510, 20_000, 20_010, 30_000):  # of the code base
            if iteration <= RECIPES[name].config.iterations:
                number = math.ceil(share * iteration) - 1
                weights = [as_schedule(term.weight)(number) for term in terms if type(term).__name__ == kind]
                assert sum(weights) == pytest.approx(weight(iteration), abs=1e-6), (kind, iteration)


def test_sparse_is_3dgs_of_as_many_steps_with_six_options():
    """Dropout, decay, the guard at the end, any color behind, density control and smooth depth from a third on."""
    for iterations in (1_000, 1_500, 3_000):
        third = round(iterations / 3)
        loss = f"photometric + smooth_depth(between(0.1, {third}))"
        options = {"dropout": 0.2, "opacity_decay": 0.995, "guard": iterations, "densify_from": third, "loss": loss,
                   "random_background": "auto"}  # fmt: skip
        assert with_recipe("sparse", iterations=iterations) == with_recipe("3dgs", iterations=iterations, **options)


def test_steps_scale_with_the_iterations_and_all_else_stays():
    assert with_recipe("fsgs") == RECIPES["fsgs"].config
    whole, short = RECIPES["inria"].config, with_recipe("inria", iterations=3_000, densify_until=700)
    changed = {name: value for name, value in vars(short).items() if value != vars(whole)[name]}
    assert changed == {"iterations": 3_000, "sh_every": 100, "densify_from": 50, "densify_until": 700,
                       "prune_size_from": 300, "opacity_reset_from": 300}  # fmt: skip
    assert make_density(with_recipe("fsgs", iterations=2_000)).unpool_until == 400
    for name, recipe in RECIPES.items():
        for iterations in (1, 30, 60_000):
            config = with_recipe(name, iterations=iterations, dropout=0.2)
            check(config)
            assert config.density.count("(") == recipe.config.density.count("(")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in RECIPES if name != "distilled"])  # which needs trained models
@pytest.mark.parametrize("regularizer", ["", "dropout(0.2)"])
def test_all_train_and_repeat_themselves(scene, name, regularizer):
    """Scaled to 30 iterations, of which the last three are taken, where every term acts."""
    ends = []
    for _ in range(2):
        trainer = Trainer(scene, with_recipe(name, iterations=30, regularizer=regularizer, densify_every=2))
        trainer.step = 27
        trainer.train()
        ends.append(dict(trainer.gaussians.named()))
    start = dict(Trainer(scene, with_recipe(name)).gaussians.named())["sh_dc"]
    assert not torch.equal(ends[0]["sh_dc"][: len(start)], start)
    assert all(torch.equal(x, ends[1][name]) and bool(x.isfinite().all()) for name, x in ends[0].items())


@pytest.mark.parametrize("name", ["fsgs", "mvgs"])
def test_a_resumed_recipe_is_identical(scene, tmp_path, name):
    config = with_recipe(name, iterations=12, regularizer="dropout(0.2)", densify_every=3, densify_gradient=1e-4)
    whole, part = Trainer(scene, config), Trainer(scene, config)
    whole.train()
    part.train(until=5)
    part.save(tmp_path / "checkpoint.pt")
    again = Trainer.load(tmp_path / "checkpoint.pt", scene)
    again.train()
    assert len(whole.gaussians) != 150
    for (name, x), (_, y) in zip(whole.gaussians.named(), again.gaussians.named(), strict=True):
        assert torch.equal(x, y), name


@pytest.mark.parametrize("name", [name for name, recipe in RECIPES.items() if "--depth" in recipe.needs])
def test_what_needs_a_depth_prior_says_so_before_it_begins(tiny_scene, name):
    with pytest.raises(ValueError, match=r"depth of every .*--depth"):
        Trainer(tiny_scene, with_recipe(name))


def test_a_distillation_names_its_models_before_it_begins(tiny_scene):
    with pytest.raises(ValueError, match=r"distillation needs .*\.ply"):
        Trainer(tiny_scene, with_recipe("distilled"))


def test_resets_over_white_stay_off_without_resets_and_are_planned(tiny_scene, monkeypatch):
    white = dataclasses.replace(tiny_scene, background=torch.ones(3))
    config = dataclasses.replace(RECIPES["inria"].config, iterations=700)
    assert not [
        event
        for event in control(monkeypatch, white, dataclasses.replace(config, opacity_reset_every=0))
        if event[1] == "reset"
    ]
    plans = [make_plan(scene, config) for scene in (tiny_scene, white)]
    decisions = [next(item for item in plan.items if item.name == "opacity reset").decision for plan in plans]
    assert decisions == ["left out", "used"]


def test_large_gaussians_are_removed_by_their_size_in_the_world_only(tiny_scene):
    """With the thresholds of the inria recipe; its 20 pixels on the screen have no effect there either."""
    trainer = Trainer(tiny_scene, with_recipe("inria", densify_gradient=1e9))
    with torch.no_grad():
        trainer.gaussians.log_scales[:] = math.log(0.09 * tiny_scene.extent)
        trainer.gaussians.log_scales[:5, 1] = math.log(0.12 * tiny_scene.extent)
        trainer.gaussians.means.mul_(0.1)
    camera, background = tiny_scene.train[0].camera, tiny_scene.background
    covariances = render_gaussians(trainer.gaussians, camera, background).splats.projection.covariances
    radii = longer_radii(covariances, SMALLEST_SPREAD)
    assert (radii > 20).sum() > 20
    for step, left in ((3_000, 150), (3_100, 145), (3_200, 145)):
        with torch.no_grad():  # the reset at 3,000 lowers them
            trainer.gaussians.opacity_logits[:] = 0.0
        trainer.step = step - 1
        trainer.train_step()
        trainer.density.before_step(trainer.optimizer, trainer.step)
        assert len(trainer.gaussians) == left
