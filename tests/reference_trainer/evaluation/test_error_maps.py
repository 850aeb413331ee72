"""Against a plane whose photographs have a closed form."""

import dataclasses
import math

import pytest
import torch

from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.metrics import color_variance_map
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import render_moments
from reference_trainer.scenes.scene import View, Viewpoint

DEPTH, WIDTH, HEIGHT, FOCAL = 2.0, 24, 16, 24.0
GRAY = 0.5


def camera_at(x: float) -> Camera:
    pose = torch.eye(4)
    pose[0, 3] = -x
    return Camera(pose, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def place(camera: Camera) -> torch.Tensor:
    """The world's x of the plane at every pixel, (H, W)."""
    x = (torch.arange(WIDTH) + 0.5 - camera.cx) / camera.fx * DEPTH + camera.position[0]
    return x.expand(HEIGHT, WIDTH)


def photograph(name: str, x: float, of=lambda at: 0.5 + 0.2 * at) -> View:
    """What a camera sees of a plane whose color is a linear function of the place, which interpolation keeps."""
    return View(name, camera_at(x), of(place(camera_at(x))).expand(3, -1, -1).contiguous())


def of_points(points: torch.Tensor, size: float) -> Gaussians:
    gray, sizes = torch.full_like(points, GRAY), torch.full((len(points),), size)
    return Gaussians.from_points(points, gray, sizes, opacity=0.9, sh_degree=0)


@pytest.fixture(scope="module")
def plane() -> TrainedModel:
    """A gray, nearly opaque plane of small Gaussians in front of all cameras, dropout 0.2."""
    x, y = torch.meshgrid(torch.arange(-2.5, 2.5, 0.04), torch.arange(-1.2, 1.2, 0.04), indexing="ij")
    points = torch.stack([x, y, torch.full_like(x, DEPTH)], -1).reshape(-1, 3)
    return TrainedModel(of_points(points, 0.05), torch.zeros(3), "dropout(0.2)")


def test_a_photograph_is_brought_to_its_place_by_the_depth(plane):
    view = Viewpoint("new", camera_at(0.1))
    features = ErrorMaps(plane, [photograph("a", -0.2), photograph("b", 0.3)]).features(view)
    image = plane.test_rendering(view).image.mean(0)
    inside = slice(4, -4)  # the photographs' own borders are half a pixel wide
    expected = (0.5 + 0.2 * place(view.camera) - image).abs()
    torch.testing.assert_close(features["warp"][:, inside], expected[:, inside], atol=2e-3, rtol=0)
    assert not features["hidden"][:, inside].any()


def test_the_photograph_that_agrees_best_counts(plane):
    view = Viewpoint("new", camera_at(0.0))
    wrong = photograph("b", 0.2, lambda at: torch.full_like(at, 0.9))
    right = photograph("a", -0.2, lambda at: torch.full_like(at, GRAY))
    warp = ErrorMaps(plane, [wrong, right]).features(view)["warp"]
    only_wrong = ErrorMaps(plane, [wrong]).features(view)["warp"]
    assert warp[:, 4:-4].max() < 0.02
    assert only_wrong[:, 4:-4].min() > 0.35


def test_what_no_photograph_saw_is_hidden(plane):
    """A camera 1 to the left sees 12 pixels of the view: 1 times the focal length over the depth."""
    hidden = ErrorMaps(plane, [photograph("a", -1.0)]).features(Viewpoint("new", camera_at(0.0)))["hidden"]
    assert hidden[:, :11].sum() == 0
    assert hidden[:, 13:].all()


def test_support_counts_the_photographs_that_show_a_place(plane):
    """A camera at x sees the pixels of a view at 0 from 12 x to 24 + 12 x."""
    photographs, view = [photograph("a", -1.0), photograph("b", 0.5)], Viewpoint("new", camera_at(0.0))
    support = ErrorMaps(plane, photographs).support(view)
    for columns, count in ((slice(0, 5), 1), (slice(7, 11), 2), (slice(13, 23), 1)):
        assert bool((support[1:-1, columns] == count).all())
    assert bool((ErrorMaps(plane, photographs[:1]).support(view)[1:-1, 13:23] == 0).all())
    faint = dataclasses.replace(plane.gaussians, opacity_logits=torch.full_like(plane.gaussians.opacity_logits, -5.0))
    assert bool(ErrorMaps(dataclasses.replace(plane, gaussians=faint), photographs).support(view).isnan().all())


def test_what_another_surface_hides_from_the_photograph_is_hidden(plane):
    """A wall at half the depth, from -0.3 to 0.8, hides the plane at 0.8 from a camera at 0, not from one at 1.2."""
    near = torch.tensor([[x, y, 1.0] for x in torch.arange(-0.3, 0.8, 0.02) for y in torch.arange(-0.6, 0.6, 0.02)])
    with_wall = dataclasses.replace(plane, gaussians=joined(plane.gaussians, of_points(near, 0.03)))
    for model, expected in ((with_wall, 1), (plane, 0)):
        hidden = ErrorMaps(model, [photograph("a", 0.0)]).features(Viewpoint("new", camera_at(1.2)))["hidden"]
        assert hidden[8, 7] == expected


def joined(one: Gaussians, two: Gaussians) -> Gaussians:
    fields = [f.name for f in dataclasses.fields(one) if isinstance(getattr(one, f.name), torch.Tensor)]
    return dataclasses.replace(one, **{name: torch.cat([getattr(one, name), getattr(two, name)]) for name in fields})


def test_features_of_the_model_alone_are_those_of_other_functions(plane):
    view = Viewpoint("new", camera_at(0.1))
    shaken = dataclasses.replace(
        plane.gaussians, sh_dc=plane.gaussians.sh_dc + torch.randn(plane.gaussians.sh_dc.shape).mul(0.5)
    )
    model = dataclasses.replace(plane, gaussians=shaken, background=torch.tensor([0.2, 0.5, 0.9]))
    features, out = ErrorMaps(model).features(view), model.test_rendering(view)
    variance, covered = color_variance_map(out.splats)
    torch.testing.assert_close(features["colors"][covered], variance[covered].sqrt(), atol=2e-3, rtol=1e-3)
    splats = model.splats(model.gaussians.opacities, view)
    moments = render_moments(splats, Multiplier.dropout(0.2), background=model.background)
    torch.testing.assert_close(features["deviation"], moments.variance.mean(0).sqrt())
    torch.testing.assert_close(features["empty"], (1 - out.alpha).clamp_min(0))
    assert {*features} == {"empty", "contrast", "deviation", "colors"}


def test_photographs_that_contradict_each_other_raise_the_unit_in_proportion(plane):
    def unit(offset: float) -> float:
        shown = [photograph(n, x, lambda at, o=o: torch.full_like(at, GRAY + o)) for n, x, o in (
            ("a", -0.2, 0.0), ("b", 0.0, offset), ("c", 0.2, 0.0))]  # fmt: skip
        return ErrorMaps(plane, shown).unit

    assert unit(0.2) > 1.5 * unit(0.02) > 0
    assert ErrorMaps(plane, [photograph("a", -0.2)]).unit == 1  # nothing to compare with


def test_a_photograph_that_is_left_out_is_not_seen(plane):
    own = photograph("own", 0.0, lambda at: torch.full_like(at, GRAY))
    maps = ErrorMaps(plane, [own, photograph("b", 0.2, lambda at: torch.full_like(at, 0.9))])
    difference, features = maps.left_out(0)
    assert difference[:, 4:-4].min() > 0.35
    assert features["warp"][:, 4:-4].min() > 0.35
    assert maps.features(own)["warp"].max() < 0.02


def test_an_evaluation_expects_the_psnr_of_views_that_were_not_trained_on(plane, tmp_path):
    train, test = [photograph("a", -0.2), photograph("b", 0.3)], [photograph("c", 0.1)]
    new = [Viewpoint("between", camera_at(0.0))]
    views = {"train": train, "test": test, "between": new}
    seen = {view.name: view for view in evaluate(plane, views, pictures=tmp_path).views}
    assert math.isnan(seen["a"].psnr_expected)
    for view in (*test, *new):
        found, expected = seen[view.name], ErrorMaps(plane, train)(view)
        assert (found.psnr_expected, found.psnr_low, found.psnr_high) == (expected.psnr, *expected.interval)
        assert found.psnr_low < found.psnr_expected < found.psnr_high
    assert evaluate(plane, {"train": train}).views[0].psnr == seen["a"].psnr
