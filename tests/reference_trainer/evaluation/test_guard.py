"""The guard, on the built-in scene with a veil planted where no training camera looks."""

import math
import weakref
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from ca_reg import attribute
from reference_trainer.camera import Camera
from reference_trainer.evaluation import shares as shares_module
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.shares import Guard, guard, unseen_shares
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.scenes.virtual_cameras import MOST_UNSEEN, amid_views, unseen_views
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.model_state import initial_gaussians, seen_by_any
from reference_trainer.training.plan import make_plan
from reference_trainer.training.recipes import with_recipe
from reference_trainer.training.trainer import Trainer

OUTSIDE = -1  # the built-in scene's last test view stands beyond its training cameras


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(width=64, height=48, points=1_500)


def veil(scene: Scene, count: int = 12, camera: Camera | None = None, near: float = 1.0) -> Gaussians:
    """Opaque Gaussians close before the view outside, in no picture of the training, in the colors of nothing there."""
    camera = camera or scene.test[OUTSIDE].camera
    size = 0.03 * near
    pixels = torch.cartesian_prod(torch.arange(4.0, camera.width, 2), torch.arange(4.0, camera.height, 2))
    for depth in (0.8, 1.0, 1.3, 1.6):
        places = camera.lift(pixels, torch.full((len(pixels),), near * depth))
        colors = torch.tensor([[0.0, 1.0, 0.0]]).expand(len(places), 3)
        made = Gaussians.from_points(places, colors, torch.full((len(places),), size), sh_degree=3)
        made = replace(made, opacity_logits=torch.full_like(made.opacity_logits, 4.0))
        chosen = (~seen_by_any(made, scene.train)).nonzero()[:, 0]
        if len(chosen) >= count:
            return made[chosen[torch.linspace(0, len(chosen) - 1, count).long()]]
    raise AssertionError("no place outside the training cones")


def together(one: Gaussians, other: Gaussians) -> Gaussians:
    named = dict(other.named())
    return Gaussians.from_named({name: torch.cat([x, named[name]]) for name, x in one.named()})


@torch.no_grad()
def quality(model: TrainedModel, scene: Scene) -> list[float]:
    return [psnr(model.test_rendering(v).image.clamp(0, 1), v.image) for v in scene.test]


def trained(scene: Scene, start: Gaussians, **settings) -> Trainer:
    """A training without densification: the number of a Gaussian stays what it was."""
    quiet = {"iterations": 120, "densify_every": 0, "opacity_reset_every": 0}
    trainer = Trainer(replace(scene, start=start), TrainConfig(**quiet | settings))
    trainer.train()
    return trainer


@pytest.mark.parametrize("analytic", [False, True], ids=["drawn", "expectation"])
@pytest.mark.slow
def test_a_planted_veil_is_found_and_what_it_hides_is_seen_again(scene, analytic):
    start, planted = initial_gaussians(scene, TrainConfig()), veil(scene)
    assert not seen_by_any(planted, scene.train).any()  # no photograph ever tells
    settings = {"dropout": 0.2, "analytic": analytic}
    clean = model_of(trained(scene, start, **settings))
    model = model_of(trained(scene, together(start, planted), **settings))
    before, never = quality(model, scene), quality(clean, scene)
    assert before[OUTSIDE] < never[OUTSIDE] - 3  # dB: the failure is there
    found = guard(model, scene)
    gone = (~found.keep).nonzero()[:, 0]
    assert len(gone) >= len(planted) // 2
    assert gone.min() >= len(start)  # nothing but the veil
    assert found.scores[-1] < found.scores[0]
    assert all(name.startswith("beyond train_2") for name in found.where)
    after = quality(replace(model, gaussians=model.gaussians[found.keep]), scene)
    assert after[OUTSIDE] > before[OUTSIDE] + 3
    assert after[:OUTSIDE] == pytest.approx(before[:OUTSIDE], abs=1e-4)  # where the veil never was

    # A clean model keeps what it has.
    kept = guard(clean, scene).keep
    assert (~kept).sum() <= 0.001 * len(kept)
    left = quality(replace(clean, gaussians=clean.gaussians[kept]), scene)
    assert all(after > before - 0.05 for after, before in zip(left, never, strict=True))


def planted_model(scene: Scene) -> TrainedModel:
    """An untrained model with a veil, opaque enough to have a score."""
    start = initial_gaussians(scene, TrainConfig())
    opaque = replace(start, opacity_logits=torch.full_like(start.opacity_logits, 2.0))
    return TrainedModel(together(opaque, veil(scene)), scene.background, "dropout(0.2)")


def test_few_places_are_named_and_the_others_counted():
    found = Guard(torch.zeros(28, dtype=torch.bool), Counter({f"at {i}": 7 - i for i in range(7)}), (2e-3, 1e-3))
    assert "28 of 28" in str(found)
    assert "3 at 4; 3 elsewhere" in str(found)
    assert "at 5" not in str(found)


def test_a_model_without_a_regularizer_is_refused(scene):
    plain = replace(planted_model(scene), regularizer="")
    with pytest.raises(ValueError, match="need each other"):
        guard(plain, scene)


def test_one_camera_has_nothing_between(scene):
    with pytest.raises(ValueError, match="it takes two"):
        guard(planted_model(scene), replace(scene, train=scene.train[:1]))


def test_shares_at_unseen_views_add_up_to_their_scores(scene):
    model, views = planted_model(scene), unseen_views(scene)[::9]
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ views[0].camera.world_to_camera  # which sees nothing
    views.insert(1, Viewpoint("away", replace(views[0].camera, world_to_camera=away)))
    shares, where, score = unseen_shares(model, views)
    exact, opacities = model.exact_ca_score(drop_rate=0.2), model.gaussians.opacities
    of_views = torch.stack([attribute(exact, model.shares, opacities, view).shares for view in views])
    scores = [exact(opacities, view).value for view in views if view.name != "away"]
    assert score == pytest.approx(sum(scores) / 3)
    assert shares.sum().item() == pytest.approx(sum(scores) / 4, rel=1e-3)
    torch.testing.assert_close(shares, of_views.mean(0))
    assert torch.equal(of_views.gather(0, where[None])[0], of_views.amax(0))
    assert len(where[shares > 0].unique()) > 1


def test_the_shares_of_all_views_are_never_held_at_once(scene, monkeypatch):
    """Of a hundred photographs there would be gigabytes."""
    made = []

    def watched(*args):
        found = attribute(*args)
        made.append(weakref.ref(found.shares))
        assert sum(share() is not None for share in made) <= 2
        return found

    monkeypatch.setattr(shares_module, "attribute", watched)
    guard(planted_model(scene), scene, rounds=1)
    assert len(made) >= 2 * len(unseen_views(scene))


@pytest.mark.slow
def test_a_guarded_training_ends_without_what_hangs_and_resumes_identically(scene, tmp_path):
    """The veil goes at a removal on the way, with all that is counted of it; nothing goes of an unguarded model."""
    start = together(initial_gaussians(scene, TrainConfig()), veil(scene))
    start = replace(start, opacity_logits=start.opacity_logits.clamp(min=2.0))
    settings = {"dropout": 0.2, "iterations": 6, "densify_from": 1, "densify_every": 0}
    whole = trained(scene, start, guard=4, **settings)
    unguarded = trained(scene, start, **settings)
    assert len(unguarded.gaussians) == len(start) > len(whole.gaussians)
    assert len(whole.density.statistics.steps) == len(whole.gaussians)
    part = Trainer(replace(scene, start=start), whole.config)
    part.train(until=5)
    assert len(part.gaussians) < len(start)  # the removal of step 4
    part.save(tmp_path / "checkpoint.pt")
    again = Trainer.load(tmp_path / "checkpoint.pt", replace(scene, start=start))
    again.train()
    for name, x in whole.gaussians.named():
        assert torch.equal(x, dict(again.gaussians.named())[name])


def test_the_guard_of_a_plain_training_is_left_out_and_says_why(scene, said):
    start = initial_gaussians(scene, TrainConfig())
    trainer = trained(scene, start, guard=1, iterations=2)
    assert len(trainer.gaussians) == len(start)
    assert any("no guard" in text and "need each other" in text for text in said)


def test_a_single_view_trains_at_the_setting_that_the_plan_recommends(scene, said):
    """It has nothing between or beyond: what the guard looks at is not there."""
    one = replace(scene, train=scene.train[:1])
    config = with_recipe("sparse", iterations=3)
    items = {item.name: item for item in make_plan(one, TrainConfig()).items}
    assert items["dropout"].decision == "recommended"
    assert items["dropout"].reason.endswith("--recipe sparse")
    guarding = {item.name: item for item in make_plan(one, config).items}["guard"]
    assert (guarding.decision, "single training view" in guarding.reason) == ("left out", True)
    trainer = Trainer(one, config)
    trainer.train()
    assert trainer.step == 3
    assert any("no guard" in text and "single training view" in text for text in said)


def test_cameras_nobody_took_go_around_what_the_training_cameras_look_at():
    """Of cameras on a circle, those between and beyond stand on it too, and look at its center."""
    scene = synthetic_scene(width=32, height=24, points=50)
    around = []
    for i, view in enumerate(scene.train):
        angle = math.radians(40 * i)
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor(
            [[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]]
        )
        pose[2, 3] = 5.0
        around.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    views = unseen_views(replace(scene, train=tuple(around)))
    assert len(views) == 3 * 3 + 3 * 6
    for view in views:
        torch.testing.assert_close(view.camera.position.norm(), torch.tensor(5.0), rtol=1e-4, atol=0)
        torch.testing.assert_close(view.camera.forward, -view.camera.position / 5, rtol=0, atol=1e-4)


def test_many_photographs_have_no_more_cameras_nobody_took_than_a_guard_can_look_at():
    scene = synthetic_scene(width=32, height=24, points=50)
    row = []
    for i in range(40):
        pose = scene.train[0].camera.world_to_camera.clone()
        pose[0, 3] += 0.1 * i
        row.append(replace(scene.train[0], name=str(i), camera=replace(scene.train[0].camera, world_to_camera=pose)))
    names = [view.name for view in unseen_views(replace(scene, train=tuple(row)))]
    assert len(set(names)) == len(names) == MOST_UNSEEN
    places = {kind: [int(name.split()[1].strip(",")) for name in names if name.startswith(kind)]
              for kind in ("between", "beyond")}  # fmt: skip
    for of in places.values():
        assert max(b - a for a, b in pairwise([0, *sorted(of), 39])) <= 4  # everywhere along the row


def zigzag(count: int) -> Scene:
    """The built-in scene with so many training cameras, each second one raised."""
    scene = synthetic_scene(width=64, height=48, points=1_500, train_views=count)
    for view in scene.train[1::2]:
        view.camera.world_to_camera[1, 3] += 1.0
    return scene


@pytest.mark.slow
def test_what_hangs_at_one_of_many_places_is_found(monkeypatch):
    """Amid three cameras, off the ways between them, where the mean over all places hardly knows of it."""
    scene = zigzag(11)
    start = initial_gaussians(scene, TrainConfig())
    start = replace(start, opacity_logits=torch.full_like(start.opacity_logits, 2.0))
    places = amid_views(scene)
    planted = veil(scene, 6, places[len(places) // 2].camera, near=0.3)
    model = TrainedModel(together(start, planted), scene.background, "dropout(0.2)")
    found = guard(model, scene, rounds=1)
    assert (~found.keep).nonzero()[:, 0].tolist() == [*range(len(start), len(start) + len(planted))]
    assert found.where == {places[len(places) // 2].name: len(planted)}
    monkeypatch.setattr(shares_module, "amid_views", lambda scene: [])
    assert guard(model, scene, rounds=1).keep.all()


def test_cameras_amid_three_neighbors_stand_between_them():
    scene = zigzag(11)
    assert amid_views(replace(scene, train=scene.train[:10])) == []
    views, by_name = amid_views(scene), {view.name: view.camera for view in scene.train}
    assert len({view.name for view in views}) == len(views) > 4
    for view in views:
        three = [by_name[name] for name in view.name.removeprefix("amid ").replace(" and ", ", ").split(", ")]
        middle = torch.stack([camera.position for camera in three]).mean(0)
        apart = max((camera.position - middle).norm() for camera in three)
        assert (view.camera.position - middle).norm() < 0.3 * apart
        for axis in range(3):  # not turned more than they are
            turns = [camera.world_to_camera[axis, :3] for camera in three]
            assert min(view.camera.world_to_camera[axis, :3] @ turn for turn in turns) > 0.9


def test_nothing_but_the_veil_goes(scene):
    """Without a training: the points of the built-in scene lie on its surfaces."""
    model = planted_model(scene)
    found = guard(model, scene, rounds=1)
    gone = (~found.keep).nonzero()[:, 0]
    assert len(gone) >= 6
    assert gone.min() >= len(model.gaussians) - 12
    assert found.where.total() == len(gone)
    assert f"{len(gone)} of {len(model.gaussians)} Gaussians hang" in str(found)
