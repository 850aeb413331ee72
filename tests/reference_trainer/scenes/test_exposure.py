"""Exposures from shared points: factors that were put in are found, shading is left alone, test photographs unseen."""

from dataclasses import replace

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.metrics import psnr, view_psnr
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.exposure import exposure_between, exposures, with_one_exposure
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import make_plan

FACTORS = torch.tensor([[0.8, 0.85, 0.9], [1.0, 1.0, 1.1], [1.2, 1.1, 1.0]])


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(160, 120, points=3000)


def brighter(view, factor):
    return replace(view, image=(view.image * factor[:, None, None]).clamp(max=1))


@pytest.fixture(scope="module")
def uneven(scene):
    """The scene's training views, each with an exposure and a white balance of its own, burnt out where too bright."""
    return [brighter(view, factor) for view, factor in zip(scene.train, FACTORS, strict=True)]


def test_the_factors_that_were_put_in_are_found(scene, uneven):
    found = exposures(uneven, scene.points.positions)
    expected = FACTORS / FACTORS.log().mean(0).exp()
    assert torch.allclose(found, expected, rtol=0.01)
    assert found.log().sum(0).abs().max() < 1e-4


def test_equal_photographs_stay_as_they_are(scene):
    assert exposures(scene.train, scene.points.positions) is None
    train, test, note = with_one_exposure(scene.train, scene.test, scene.points.positions)
    assert (train, test, note) == (scene.train, scene.test, "")


def test_shading_is_no_exposure(scene):
    """Where two thirds of a photograph are brighter by a quarter, and the rest is not, something else has changed."""
    view = scene.train[2]
    lit = torch.where(torch.arange(160) < 107, 1.25, 1.0)
    changed = replace(view, image=(view.image * lit).clamp(max=1))
    assert exposures([*scene.train[:2], changed], scene.points.positions) is None


def test_too_few_points_tell_nothing(scene, uneven):
    assert exposures(uneven, scene.points.positions[:90]) is None
    assert exposures(uneven, scene.points.positions[:0]) is None


def test_a_photograph_that_shares_nothing_keeps_its_exposure(scene, uneven):
    away = scene.train[0].camera.world_to_camera.clone()
    away[:3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0])) @ away[:3]  # turned round
    alone = replace(uneven[2], camera=replace(uneven[2].camera, world_to_camera=away))
    found = exposures([*uneven[:2], alone], scene.points.positions)
    assert torch.allclose(found[2], torch.ones(3), atol=1e-5)
    assert torch.allclose(found[1] / found[0], FACTORS[1] / FACTORS[0], rtol=0.01)


def test_photographs_become_equally_bright_and_test_photographs_are_not_looked_at(scene, uneven):
    train, test, note = with_one_exposure(uneven, scene.test, scene.points.positions)
    assert "50 %" in note
    for view, given in zip(train, uneven, strict=True):
        assert torch.allclose(view.as_taken(view.image), given.image)
    dark = [replace(view, image=view.image * 0) for view in scene.test]
    for view, unseen in zip(test, with_one_exposure(uneven, dark, scene.points.positions)[1], strict=True):
        assert torch.equal(view.exposure, unseen.exposure)


def test_the_plan_tells_where_photographs_differ(scene, uneven):
    def decided(views):
        plan = make_plan(replace(scene, train=tuple(views)), TrainConfig())
        return {item.name: item for item in plan.items}["one exposure"]

    assert "--one-exposure" not in decided(scene.train).reason
    assert "50 %: --one-exposure" in decided(uneven).reason
    assert "--one-exposure" not in decided(uneven * 4).reason  # twelve: the time goes by the pairs
    assert decided(with_one_exposure(uneven, (), scene.points.positions)[0]).decision == "used"


def test_what_was_cut_out_keeps_its_background(scene, uneven):
    cut = [replace(view, alpha=torch.ones(view.image.shape[1:])) for view in uneven]
    assert with_one_exposure(cut, scene.test, scene.points.positions) == (tuple(cut), scene.test, "")


def camera(x):
    pose = torch.eye(4)
    pose[0, 3] = -x
    return Camera(pose, 50.0, 50.0, 16.0, 16.0, 32, 32)


@pytest.mark.parametrize(("x", "power"), [(-1.0, 0.0), (0.0, 0.0), (0.5, 0.25), (2.0, 1.0), (4.0, 1.5), (9.0, 2.0)])
def test_between_two_cameras_the_exposure_goes_from_one_to_the_other(x, power):
    factors = torch.tensor([[1.0], [2.0], [4.0]]).expand(3, 3)
    found = exposure_between(camera(x), [camera(0.0), camera(2.0), camera(6.0)], factors)
    assert torch.allclose(found, torch.full((3,), 2.0**power))


def test_quality_is_that_of_the_photograph_as_it_was_taken(scene):
    """Not that of the one that was made darker, whose errors are smaller."""
    cloud = scene.points
    distances = torch.full((len(cloud.positions),), 0.05)
    gaussians = Gaussians.from_points(cloud.positions, cloud.colors, distances, sh_degree=0)
    model = TrainedModel(gaussians, scene.background)
    factor, view = torch.tensor([1.1, 1.0, 0.9]), scene.test[0]
    changed = replace(view, image=view.image / factor[:, None, None], exposure=factor)
    image = (model.test_rendering(view).image.detach() * factor[:, None, None]).clamp(0, 1)
    (found,) = evaluate(model, {"test": [changed]}).views
    assert found.psnr == pytest.approx(psnr(image, view.image), abs=1e-4)
    assert view_psnr(model.test_rendering(changed).image.detach(), changed) == pytest.approx(found.psnr, abs=1e-4)


@pytest.mark.data
def test_herz_jesus_photographs_become_equally_bright(data_root):
    """They get darker from one to the next, by a tenth each; afterwards shared points differ by no factor."""
    scene = load_scene(
        SceneOptions(str(data_root / "herz-jesu"), split="split_near", points="sparse_3near/0", one_exposure=True)
    )
    brightness = torch.stack([view.exposure.mean() for view in scene.train])
    assert (brightness.diff() < -0.07).all()
    assert "exposures differ" in scene.notes[-1]
    assert exposures(scene.train, scene.points.positions) is None
    assert all(brightness.min() < view.exposure.mean() < brightness.max() for view in scene.test)
