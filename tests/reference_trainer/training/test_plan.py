import dataclasses
import json
import re

import pytest
import torch

from reference_trainer.scenes.scene import PointCloud, Scene
from reference_trainer.scenes.virtual_cameras import look_at
from reference_trainer.training import step as step_module
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.model_state import initial_gaussians
from reference_trainer.training.plan import Plan, PlanItem, make_plan
from reference_trainer.training.recipes import RECIPES, with_recipe
from reference_trainer.training.trainer import Trainer

SHORT = TrainConfig(iterations=400)  # ends before the first band of spherical harmonics begins


def items(scene: Scene, config: TrainConfig, **keywords) -> dict[str, PlanItem]:
    return {item.name: item for item in make_plan(scene, config, **keywords).items}


def test_every_item_has_a_reason_and_changes_only_fields_that_exist(tiny_scene):
    plan = make_plan(tiny_scene, TrainConfig())
    assert len({item.name for item in plan.items}) == len(plan.items)
    for item in plan.items:
        assert item.reason
        assert item.decision in ("used", "reduced", "left out", "recommended")
        assert set(item.changes) <= set(vars(TrainConfig()))


def test_a_plan_survives_json(tiny_scene):
    plan = make_plan(tiny_scene, SHORT)
    assert any(item.changes for item in plan.items)
    assert Plan.from_dict(json.loads(json.dumps(plan.as_dict()))) == plan
    with pytest.raises(ValueError, match=r"a plan \(plan\.json"):
        Plan.from_dict({"items": [{"title": "SH bands"}]})


def test_the_user_wins_by_another_value_or_by_naming_the_field(tiny_scene):
    assert make_plan(tiny_scene, SHORT).applied(SHORT).sh_degree == 0
    for asked, given in ((dataclasses.replace(SHORT, sh_degree=2), ()), (SHORT, ("sh_degree",))):
        plan = make_plan(tiny_scene, asked, given=given)
        assert plan.applied(asked, given=given) == asked
        item = items(tiny_scene, asked, given=given)["SH bands"]
        assert item.decision == "used"
        assert item.reason.startswith(f"asked for (sh_degree={asked.sh_degree})")


def test_a_stored_plan_yields_to_what_is_given_later(tiny_scene):
    plan = make_plan(tiny_scene, SHORT)
    assert plan.applied(SHORT) != SHORT
    assert plan.applied(SHORT, given=["sh_degree"]) == SHORT


@pytest.mark.parametrize("recipe", RECIPES)
def test_what_a_recipe_sets_stays(tiny_scene, recipe):
    config = with_recipe(recipe, iterations=400)
    applied = make_plan(tiny_scene, config).applied(config)
    default = vars(TrainConfig())
    for name, value in vars(config).items():
        if value != default[name]:
            assert getattr(applied, name) == value, name


def test_given_must_name_fields(tiny_scene):
    with pytest.raises(ValueError, match=r"TrainConfig, got \['sh'\]"):
        make_plan(tiny_scene, TrainConfig(), given=["sh"])


@pytest.mark.parametrize(("iterations", "degree"), [(1, 0), (499, 0), (500, 1), (1_499, 2), (1_500, 3), (9_000, 3)])
def test_bands_that_never_begin_are_left_out(tiny_scene, iterations, degree):
    config = TrainConfig(iterations=iterations)
    assert make_plan(tiny_scene, config).applied(config).sh_degree == degree


def test_bands_that_never_begin_make_no_difference(tiny_scene):
    """What is left out stays 0 in the other run; the rest differs by the rounding of tensors of another shape."""
    whole = TrainConfig(iterations=7, sh_every=4, densify_from=2, densify_every=3, densify_gradient=1e-4, dropout=0.2)
    planned = make_plan(tiny_scene, whole).applied(whole)
    assert planned == dataclasses.replace(whole, sh_degree=1)
    three, one = Trainer(tiny_scene, whole), Trainer(tiny_scene, planned)
    three.train()
    one.train()
    parameters, expected = dict(one.gaussians.named()), dict(three.gaussians.named())
    assert len(one.gaussians) > 150
    assert not expected["sh_rest"][:, 3:].any()
    expected["sh_rest"] = expected["sh_rest"][:, :3]
    assert expected["sh_rest"].any()
    for name, x in parameters.items():
        torch.testing.assert_close(x, expected[name], rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")


def test_points_behind_all_cameras_are_left_out(tiny_scene):
    points = tiny_scene.points
    behind = torch.tensor([[0.0, 0.0, -40.0]]) + torch.arange(3.0)[:, None]
    both = PointCloud(torch.cat([points.positions, behind]), torch.cat([points.colors, torch.zeros(3, 3)]), "both")
    scene, rule = dataclasses.replace(tiny_scene, points=both), "Gaussians outside every view"
    item = items(scene, TrainConfig())[rule]
    assert "3 of 153" in item.reason
    assert item.changes == {"initial_points": "seen"}
    assert not items(tiny_scene, TrainConfig())[rule].changes
    model = dataclasses.replace(scene, start=initial_gaussians(scene, TrainConfig()))
    assert not items(model, TrainConfig())[rule].changes  # a model is trained on as it is


@pytest.mark.parametrize("given", [(), ("initial_scale",)])
def test_those_left_out_have_no_pixel_at_the_size_that_they_start_with(tiny_scene, given):
    """Random points start half as wide, unless a size was asked for."""
    positions = tiny_scene.points.positions
    scattered = positions.mean(0) + 3 * (positions - positions.mean(0))
    random = PointCloud(scattered, tiny_scene.points.colors, "random")
    scene = dataclasses.replace(tiny_scene, points=random)
    plan = make_plan(scene, TrainConfig(), given=given)
    left = len(positions) - len(initial_gaussians(scene, plan.applied(TrainConfig(), given=given)))
    told = next(item.reason for item in plan.items if item.changes.get("initial_points") == "seen")
    assert told.startswith(f"{left} of {len(positions)} ")


@pytest.mark.parametrize(
    ("name", "config", "said"),
    [
        ("densification", TrainConfig(densify_every=0), r"asked for"),
        ("densification", TrainConfig(iterations=400), r"first would be at step 600 of 400"),
        ("opacity reset", TrainConfig(iterations=2_000), r"first would be at step 2001 of 2000"),
        ("opacity reset", TrainConfig(opacity_reset_every=0), r"asked for"),
        ("dropped Gaussians", TrainConfig(dropout=0.2), r"neither projected nor sorted"),
        ("dropped Gaussians", TrainConfig(), r"draws no masks"),
        ("guard", TrainConfig(guard=500), r"Gaussians of a model need each other"),
        ("guard", TrainConfig(dropout=0.2), r"not asked for: --guard"),
        ("moments", TrainConfig(), r"a step needs none"),
        ("SSIM windows without change", TrainConfig(loss="photometric(0.0)"), r"the loss has no SSIM"),
    ],
)
def test_left_out_by_construction(tiny_scene, name, config, said):
    item = items(tiny_scene, config)[name]
    assert (item.decision, item.changes) == ("left out", {})
    assert re.search(said, item.reason)


@pytest.mark.parametrize(
    ("views", "apart", "config", "decision", "said"),
    [
        (1, 0.0, TrainConfig(), "recommended", r"^not asked for; 1 view; with 2 views .* by \+1\.4 to \+1\.7 dB"),
        (3, 20.0, TrainConfig(), "recommended", r"3 views, 20 degrees apart; with 3 views .* \+0\.5 to \+1\.8 dB"),
        (3, 20.0, TrainConfig(), "recommended", r"single trainings of 6 scenes\): use --recipe sparse$"),
        (
            4,
            30.0,
            TrainConfig(),
            "recommended",
            r"30 degrees apart; .* by -0\.1 to \+0\.4 dB .* 3 scenes\): use --recipe",
        ),
        (
            11,
            30.0,
            TrainConfig(),
            "left out",
            r"30 degrees apart; .* by -0\.1 to \+0\.4 dB \(means of 3 seeds or more\)$",
        ),
        (12, 10.0, TrainConfig(dropout=0.2), "used", r"^asked for; 12 views, 10 degrees apart; with 9 views"),
        (36, 10.0, TrainConfig(noise=0.8), "left out", r"36 views.*; with 48 views .* by -0\.3 to -0\.1 dB"),
    ],
)
def test_what_is_said_of_dropout(tiny_scene, views, apart, config, decision, said):
    """Cameras on a circle around the middle of the points."""
    middle, camera = tiny_scene.points.positions.median(0).values, tiny_scene.train[0].camera
    cameras = []
    for angle in torch.deg2rad(apart * torch.arange(float(views))):
        place = middle + torch.stack([5 * angle.sin(), torch.zeros(()), -5 * angle.cos()])
        pose = look_at(place.double(), middle.double(), torch.tensor([0.0, 1.0, 0.0]).double())
        cameras.append(dataclasses.replace(camera, world_to_camera=pose.float()))
    train = tuple(dataclasses.replace(tiny_scene.train[0], camera=each) for each in cameras)
    item = items(dataclasses.replace(tiny_scene, train=train), config)["dropout"]
    assert (item.decision, item.changes) == (decision, {})
    assert re.search(said, item.reason)


def test_a_step_renders_no_depth_and_no_dropped_gaussian(tiny_scene, monkeypatch):
    """The two claims about what a step computes, seen at the renderer's own output."""
    seen = []
    original = step_module.render_gaussians

    def watched(params, *args, **keywords):
        rendering = original(params, *args, **keywords)
        seen.append((rendering, params.opacities.detach()))
        return rendering

    monkeypatch.setattr(step_module, "render_gaussians", watched)
    Trainer(tiny_scene, TrainConfig(iterations=3, dropout=0.5)).train()
    assert len(seen) == 3
    for rendering, opacities in seen:
        assert rendering.depth is None
        assert 0 < int((opacities == 0).sum()) < len(opacities)
        assert bool((opacities[rendering.splats.indices] > 0).all())
        assert len(rendering.splats.projection.means) == len(rendering.splats.indices)


@pytest.mark.parametrize(
    ("name", "config", "said"),
    [
        ("moments", TrainConfig(loss="photometric + co_adaptation(3.0)"), r"asked for: CoAdaptation"),
        ("moments", TrainConfig(loss="photometric + consistency(0.3, exact=True)"), r"asked for: Consistency"),
        ("moments", TrainConfig(analytic=True, dropout=0.2), r"asked for \(analytic\)"),
        ("alpha masks", TrainConfig(loss="photometric + alpha(1.0)"), r"asked for: Alpha compares with them"),
        ("alpha masks", TrainConfig(random_background="on"), r"\(random_background\): the pictures"),
        ("background", TrainConfig(random_background="auto"), r"\(random_background\): the photographs do not show it"),
        ("background", TrainConfig(random_background="on"), r"anew at each step \(random_background\): asked"),
    ],
)
def test_what_a_training_uses_is_not_said_to_be_left_out(tiny_scene, name, config, said):
    scene = masked(tiny_scene) if name == "alpha masks" else tiny_scene
    item = items(scene, config)[name]
    assert (item.decision, item.changes) == ("used", {})
    assert re.search(said, item.reason)


def test_a_background_that_photographs_show_stays(tiny_scene):
    item = items(masked(tiny_scene), TrainConfig(random_background="auto"))["background"]
    assert (item.decision, "which photographs show" in item.reason) == ("used", True)


def masked(scene):
    """Give every photograph an alpha channel."""
    train = tuple(dataclasses.replace(view, alpha=torch.ones_like(view.image[0])) for view in scene.train)
    return dataclasses.replace(scene, train=train)


def test_a_warp_of_transparent_pictures_is_recommended_an_alpha_term(tiny_scene):
    config = TrainConfig(loss="photometric + warp")
    assert items(tiny_scene, config)["alpha masks"].decision == "left out"
    plan = make_plan(masked(tiny_scene), config)
    assert re.search(r"^Recommended, alpha masks", plan.summary(), re.MULTILINE)


@pytest.mark.parametrize("iterations", [500, 501, 600, 601, 650])
@pytest.mark.parametrize(("start", "every"), [(500, 100), (499, 100), (550, 300), (0, 7)])
def test_growth_is_planned_where_the_schedule_densifies(tiny_scene, iterations, start, every):
    """Held against the steps at which density control acts."""
    config = TrainConfig(iterations=iterations, densify_from=start, densify_every=every)
    density = Trainer(tiny_scene, config).density
    due = [step for step in range(iterations) if density.is_due(step)]
    item = items(tiny_scene, config)["densification"]
    assert item.decision == ("used" if due else "left out")
    if due:
        assert f"from step {due[0]} of {iterations} on" in item.reason


def test_a_reset_over_white_that_never_comes_is_not_planned(tiny_scene):
    """Not at a densification that begins with the first step."""
    white = dataclasses.replace(tiny_scene, background=torch.ones(3))
    config = TrainConfig(iterations=2_500, opacity_reset_over_white=True, densify_from=0)
    assert "first at step 2001 of 2500" in items(white, config)["opacity reset"].reason
    later = dataclasses.replace(config, densify_from=300)
    assert "first at step 300 of 2500" in items(white, later)["opacity reset"].reason


def test_a_step_computes_no_moments_unless_it_trains_on_them(tiny_scene, monkeypatch):
    calls = []
    original = step_module.render_moments_of
    monkeypatch.setattr(step_module, "render_moments_of", lambda *a, **k: calls.append(1) or original(*a, **k))
    Trainer(tiny_scene, TrainConfig(iterations=2, dropout=0.2)).train()
    assert not calls
    Trainer(tiny_scene, TrainConfig(iterations=2, dropout=0.2, analytic=True)).train()
    assert len(calls) == 2


def test_random_points_start_half_as_wide_and_measured_ones_as_wide_as_they_are(tiny_scene):
    random = dataclasses.replace(tiny_scene, points=dataclasses.replace(tiny_scene.points, source="random"))
    measured = dataclasses.replace(tiny_scene, points=dataclasses.replace(tiny_scene.points, source="points.ply"))
    assert make_plan(random, TrainConfig()).applied(TrainConfig()).initial_scale == 0.5
    assert make_plan(measured, TrainConfig()).applied(TrainConfig()).initial_scale == 1
    assert items(random, TrainConfig(), given=["initial_scale"])["size of initial points"].changes == {}
