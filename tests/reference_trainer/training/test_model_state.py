"""The Gaussians that a training starts from; a training of two models, and what is saved of them."""

import dataclasses
import gc
from typing import ClassVar

import pytest
import torch
from stand_ins.card import CARD, pretended_card

from ca_reg import Chain, GaussianDropout
from ca_reg.regularizer import Learned
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.training import model_state
from reference_trainer.training.assembly import check, make_density
from reference_trainer.training.checkpoint import load_checkpoint, save_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.model_state import ModelState, initial_gaussians, seen_by_any
from reference_trainer.training.plan import make_plan
from reference_trainer.training.step import Step
from reference_trainer.training.trainer import Trainer

BEHIND = torch.tensor([[0.0, 0.0, -40.0]])


def camera(width: int = 32, height: int = 24) -> Camera:
    return Camera(torch.eye(4), 20.0, 20.0, width / 2, height / 2, width, height)


def with_points(scene: Scene, extra: torch.Tensor) -> Scene:
    """The scene with more initial points at the end of the list."""
    points = scene.points
    positions = torch.cat([points.positions, extra])
    cloud = PointCloud(positions, torch.cat([points.colors, torch.ones_like(extra)]), points.source)
    return dataclasses.replace(scene, points=cloud)


def test_sizes_are_the_distance_to_the_neighbors_times_the_scale(tiny_scene):
    whole = initial_gaussians(tiny_scene, TrainConfig())
    half = initial_gaussians(tiny_scene, TrainConfig(initial_scale=0.5))
    torch.testing.assert_close(half.scales, whole.scales / 2)
    torch.testing.assert_close(half.means, whole.means)


def test_a_gaussian_is_rendered_where_its_footprint_reaches_the_picture():
    """At depth 10 the right edge of the picture is at x = 8; a standard deviation of 1 reaches 2.5 further at 0.1."""
    means = torch.tensor([[0.0, 0.0, 10.0], [9.0, 0.0, 10.0], [40.0, 0.0, 10.0], [0.0, 0.0, -10.0]])
    gaussians = Gaussians.from_points(means, torch.rand(4, 3), torch.ones(4), sh_degree=0)
    view = View("a", camera(), torch.zeros(3, 24, 32))
    assert seen_by_any(gaussians, (view,)).tolist() == [True, True, False, False]


def test_what_is_seen_is_rendered_where_it_is_asked_for(tiny_scene, monkeypatch):
    """On a card the CPU renders nothing, for which its loops would have to be compiled."""
    devices, original = [], model_state.splat

    def splat(means, **given):
        devices.append(means.device.type)
        return original(means, **given)

    monkeypatch.setattr(model_state, "splat", splat)
    scene = with_points(tiny_scene, BEHIND)
    with pretended_card() as card:
        make_plan(scene, TrainConfig(), device=card)
        found = initial_gaussians(scene, TrainConfig(initial_points="seen"), card)
    assert set(devices) == {CARD}
    on_cpu = initial_gaussians(scene, TrainConfig(initial_points="seen"))
    assert torch.equal(found.means, on_cpu.means)


def test_unseen_points_change_nothing_at_the_training_views(tiny_scene):
    """Without draws, which depend on the number of Gaussians, training is the same but for rounding."""
    scene = with_points(tiny_scene, BEHIND.repeat(3, 1) + torch.arange(3.0)[:, None])
    visible = seen_by_any(initial_gaussians(scene, TrainConfig()), scene.train)
    assert torch.nonzero(~visible).flatten().tolist() == [150, 151, 152]
    config = TrainConfig(iterations=6, sh_every=2, densify_every=0, opacity_reset_from=3)
    everything, seen = (Trainer(scene, dataclasses.replace(config, initial_points=which)) for which in ("all", "seen"))
    everything.train()
    seen.train()
    assert len(seen.gaussians) == len(everything.gaussians) - 3
    for (name, x), (_, y) in zip(everything.gaussians.named(), seen.gaussians.named(), strict=True):
        torch.testing.assert_close(x[:150], y, rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")


def test_unseen_points_stay_as_they_began(tiny_scene):
    """That is why they are worth leaving out: no step ever moves them."""
    scene = with_points(tiny_scene, BEHIND.repeat(3, 1) + torch.arange(3.0)[:, None])
    trainer = Trainer(scene, TrainConfig(iterations=4, densify_every=0))
    before = trainer.gaussians.map(lambda x: x.detach()[150:].clone())
    trainer.train()
    for (name, x), (_, y) in zip(before.named(), trainer.gaussians.named(), strict=True):
        assert torch.equal(x, y.detach()[150:]), name


def test_no_point_in_view_says_what_to_do(tiny_scene):
    points = PointCloud(BEHIND.repeat(5, 1) + torch.arange(5.0)[:, None], torch.rand(5, 3), "behind")
    scene = dataclasses.replace(tiny_scene, points=points, train=(View("a", camera(), torch.zeros(3, 24, 32)),))
    with pytest.raises(ValueError, match=r"no initial Gaussian .*training view"):
        initial_gaussians(scene, TrainConfig(initial_points="seen"))


class Learning(GaussianDropout):
    """Learns a number whose start is whole."""

    learns: ClassVar[dict[str, Learned]] = {"numbers": Learned(2, 0.1)}


def test_what_is_learned_may_start_at_a_whole_number(tiny_scene):
    config = TrainConfig()
    gaussians = ModelState(tiny_scene, config, make_density(config), Chain(Learning(0.2))).gaussians
    assert torch.equal(gaussians.learned["numbers"].detach(), torch.full((150,), 2.0))


def test_the_largest_seed_trains_two_models_and_can_be_read_again(tiny_scene, tmp_path):
    trainer = trained(tiny_scene, TrainConfig(iterations=2, seed=2**63 - 1, models=2), until=1)
    trainer.save(tmp_path / "checkpoint.pt")
    assert Trainer.load(tmp_path / "checkpoint.pt", tiny_scene).config == trainer.config


SEGS = "self_ensembling(1.0, every=3, start=6, stop=20, views=2)"


def trained(scene, config: TrainConfig, until: int | None = None) -> Trainer:
    trainer = Trainer(scene, config)
    trainer.train(until=until)
    return trainer


@pytest.mark.parametrize("changes", [{}, {"analytic": True}, {"density": "mcmc(growth=1.2)", "regularizer": "d2gs"}])
def test_the_first_of_two_that_are_not_compared_is_the_only_one(tiny_scene, busy, tmp_path, changes):
    config = dataclasses.replace(busy, iterations=14, loss="photometric + views(2) + consistency", **changes)
    if config.analytic:
        config = dataclasses.replace(config, loss="photometric + views(2)")
    alone, both = (trained(tiny_scene, dataclasses.replace(config, models=n)) for n in (1, 2))
    torch.testing.assert_close(both.models[0].state_dict(), alone.models[0].state_dict(), rtol=0, atol=0)
    assert model_of(both).gaussians.means.data_ptr() == both.models[0].gaussians.means.data_ptr()
    for trainer in (alone, both):
        trainer.save(tmp_path / "checkpoint.pt")
        assert len(load_checkpoint(tmp_path / "checkpoint.pt").get("others", [])) == len(trainer.models) - 1


def test_models_start_alike_and_draw_on_their_own(tiny_scene):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=4, dropout=0.3, models=3))
    starts = [model.gaussians for model in trainer.models]
    assert all(torch.equal(starts[0].means, each.means) for each in starts)
    assert len({each.means.data_ptr() for each in starts}) == 3
    steps = trainer.begin_steps()
    for step in steps:
        step.sample(depth=False)
    assert len({step.view.name for step in steps}) == 1
    keeps = [model.regularizer.keep for model in trainer.models]
    assert not torch.equal(keeps[0], keeps[1])
    assert not torch.equal(keeps[1], keeps[2])
    random = [model.density.split_generator(7).initial_seed() for model in trainer.models]
    assert len(set(random)) == 3


@pytest.mark.slow
def test_a_training_of_two_models_is_resumed_to_the_identical_result(tiny_scene, busy, tmp_path):
    loss = "photometric + co_regularization(between(1.0, 4))"
    config = dataclasses.replace(busy, iterations=16, loss=loss, density=SEGS, models=2, regularizer="concrete")
    whole = trained(tiny_scene, config)
    assert len({len(model.gaussians) for model in whole.models}) == 2
    for at in (5, 8, 12):
        part = trained(tiny_scene, config, until=at)
        part.save(tmp_path / "checkpoint.pt")
        again = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
        again.train()
        for one, other in zip(whole.models, again.models, strict=True):
            torch.testing.assert_close(other.state_dict(), one.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s.pop("others"), "expected 2 models, got 1"),
        (lambda s: s["others"].clear(), "expected 2 models, got 1"),
        (lambda s: s["others"].append({}), "expected 2 models, got 3"),
        (lambda s: s.update(others=3), "damaged checkpoint"),
        (lambda s: s["others"][0].pop("moments"), "model 1: it lacks 'moments'"),
        (lambda s: s["others"][0].update(step=3), "model 1: unknown entry 'step'"),
        (lambda s: s["others"][0]["gaussians"]["means"].fill_(torch.nan), "model 1, means: holds nan"),
        (lambda s: s["others"][0]["statistics"].update(pictures=torch.zeros(1)), "model 1, statistics: unknown entry"),
        (
            lambda s: s["statistics"].update(pictures=torch.zeros(2, 3)),
            "pictures: expected float32 of shape",
        ),
        (lambda s: s["statistics"].pop("pictures"), "statistics: it lacks 'pictures'"),
    ],
)
def test_a_damaged_second_model_is_refused(tiny_scene, tmp_path, change, said):
    path = tmp_path / "checkpoint.pt"
    Trainer(tiny_scene, TrainConfig(iterations=30, density=SEGS, models=2)).save(path)
    state = load_checkpoint(path)
    change(state)
    save_checkpoint(path, state)
    with pytest.raises(ValueError, match=said):
        Trainer.load(path, tiny_scene)


@pytest.mark.parametrize("settings", [{"loss": "photometric + co_regularization"}, {"density": "co_pruning"}])
def test_what_compares_models_needs_two(settings):
    with pytest.raises(ValueError, match=r"compares models, .*models=2"):
        check(TrainConfig(**settings))
    check(TrainConfig(**settings, models=2))
    with pytest.raises(ValueError, match=r"models .*1, got 0"):
        TrainConfig(models=0)


def test_all_models_train_over_one_random_background(tiny_scene):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=9, models=2, random_background="on"))
    colors = []
    for _ in range(3):
        steps = trainer.begin_steps()
        assert torch.equal(steps[0].background, steps[1].background)
        colors.append(steps[0].background)
        steps[0].sample(depth=False)
        behind = (1 - steps[0].rendering.alpha) * colors[-1][:, None, None]
        over_black = steps[0].render(steps[0].view.camera).image - behind
        dark = dataclasses.replace(steps[0], background=torch.zeros(3))
        torch.testing.assert_close(dark.render(dark.view.camera).image, over_black, rtol=0, atol=1e-5)
        trainer.train_step()
    assert len({tuple(color.tolist()) for color in colors}) == 3
    assert torch.equal(model_of(trainer).background, tiny_scene.background)


def test_photographs_with_an_alpha_channel_lie_over_the_random_background_too(tiny_scene):
    """Those of the step and those that a term asks for, made anew from what is in front."""

    def over(color, front, alpha):
        return front * alpha + (1 - alpha) * color[:, None, None]

    g = torch.Generator().manual_seed(0)
    fronts = {view.name: (view.image, torch.rand(24, 32, generator=g)) for view in tiny_scene.train}
    white = torch.ones(3)
    views = tuple(
        dataclasses.replace(view, image=over(white, *fronts[view.name]), alpha=fronts[view.name][1])
        for view in tiny_scene.train
    )
    scene = dataclasses.replace(tiny_scene, train=views, background=white)
    trainer = Trainer(scene, TrainConfig(iterations=3, random_background="on"))
    (step,) = trainer.begin_steps()
    step.sample(depth=False)
    for view in (step.view, step.at(trainer.views[0]).view, step.at(trainer.views[1]).view):
        torch.testing.assert_close(view.image, over(step.background, *fronts[view.name]))
    assert not step.background.equal(white)
    for name, (front, alpha) in fronts.items():  # what was photographed stays
        assert next(view for view in trainer.views if view.name == name).image.equal(over(white, front, alpha))


@pytest.mark.parametrize(
    ("background", "dark", "alpha", "drawn"),
    [
        (0.0, 1, False, True),  # of 200 pixels
        (0.0, 3, False, False),
        (1.0, 3, False, True),  # nothing in the picture is white
        (0.0, 0, True, False),
    ],
)
def test_auto_keeps_a_background_that_photographs_show(tiny_scene, background, dark, alpha, drawn):
    image = torch.full((3, 10, 20), 0.5)
    image[:, 0, :dark] = torch.tensor([0.0, 0.04, 0.02])[:, None]
    image[2, 5] = 0.0  # blue is missing, which makes nothing black
    camera = dataclasses.replace(tiny_scene.train[0].camera, width=20, height=10)
    view = dataclasses.replace(
        tiny_scene.train[0], camera=camera, image=image, alpha=torch.ones(10, 20) if alpha else None
    )
    scene = dataclasses.replace(tiny_scene, train=(view, view), background=torch.full((3,), background))
    trainer = Trainer(scene, TrainConfig(iterations=2, random_background="auto"))
    colors = []
    for _ in range(2):
        (step,) = trainer.begin_steps()
        colors.append(step.background)
        trainer.train_step()
    assert (not colors[0].equal(colors[1])) is drawn
    assert all(color.equal(scene.background) for color in colors) is not drawn


@pytest.mark.parametrize("models", [1, 2])
def test_nothing_of_a_step_outlives_it(tiny_scene, models):
    loss = "photometric + views(2)" + " + co_regularization" * (models == 2)
    trainer = Trainer(tiny_scene, TrainConfig(iterations=4, models=models, loss=loss))
    gc.collect()
    gc.disable()
    try:
        trainer.train_step()
        assert not [x for x in gc.get_objects() if type(x) is Step]
    finally:
        gc.enable()
