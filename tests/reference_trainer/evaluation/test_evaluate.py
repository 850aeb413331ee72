import dataclasses
import json
import math
import re

import pytest
import torch
from PIL import Image

from ca_reg import CAScore
from ca_reg.functional import Multiplier, opacity_noise
from reference_trainer.evaluation.evaluate import Evaluation, ViewScores, evaluate
from reference_trainer.evaluation.metrics import DepthErrors, psnr, ssim
from reference_trainer.evaluation.pictures import file_names, side_by_side
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import render
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.images import read_image
from reference_trainer.scenes.scene import Scene, View, Viewpoint


@pytest.fixture(scope="module")
def gaussians(tiny_scene: Scene) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    points = tiny_scene.points
    model = Gaussians.from_points(points.positions, points.colors, torch.full((150,), 0.25), sh_degree=1, opacity=0.9)
    return dataclasses.replace(model, sh_rest=0.3 * torch.randn(150, 3, 3, generator=g))


def of_scene(scene: Scene) -> dict[str, tuple[View, ...]]:
    return {"train": scene.train, "test": scene.test}


def scores(result: Evaluation, quantity: str) -> list[float]:
    return [getattr(view, quantity) for view in result.views]


def test_scores_are_those_of_the_rendered_views(tiny_scene, gaussians):
    model = TrainedModel(gaussians, tiny_scene.background, "dropout(0.2)")
    result = evaluate(model, of_scene(tiny_scene))
    views = [*tiny_scene.train, *tiny_scene.test]
    assert [(v.split, v.name) for v in result.views] == [("train" if v in tiny_scene.train else "test", v.name)
                                                          for v in views]  # fmt: skip
    for view, found in zip(views, result.views, strict=True):
        image = render(
            gaussians.means, gaussians.quaternions, gaussians.scales, 0.8 * gaussians.opacities, view.camera,
            sh=gaussians.sh, background=tiny_scene.background,
        ).image.clamp(0, 1)  # fmt: skip
        assert found.psnr == pytest.approx(psnr(image, view.image))
        assert found.ssim == pytest.approx(ssim(image, view.image))
        assert math.isnan(found.lpips)
    assert result.gaussians == 150
    assert result.perceptual_metric is None


def test_depth_is_held_against_the_truth_where_it_is_known(tiny_scene, gaussians):
    """Against a render whose colors are the depths of the centers, at every fifth pixel."""
    view = tiny_scene.test[0]
    known = torch.zeros_like(view.depth)
    known[::5, ::5] = view.depth[::5, ::5]
    model = TrainedModel(gaussians, tiny_scene.background, "dropout(0.2)")
    found, without = evaluate(
        model, {"test": [dataclasses.replace(view, depth=known), dataclasses.replace(view, depth=None)]}
    ).views
    lit = render(
        gaussians.means, gaussians.quaternions, gaussians.scales, 0.8 * gaussians.opacities, view.camera,
        colors=(gaussians.means @ view.camera.world_to_camera[2, :3] + view.camera.world_to_camera[2, 3])[:, None]
        .expand(-1, 3), background=torch.zeros(3),
    )  # fmt: skip
    pairs = [
        (lit.image[0, i, j].item() / lit.alpha[i, j].item() if lit.alpha[i, j] > 0 else 0.0, view.depth[i, j].item())
        for i in range(0, 24, 5) for j in range(0, 32, 5) if view.depth[i, j] > 0
    ]  # fmt: skip
    assert len(pairs) > 20
    assert found.depth_abs_rel == pytest.approx(sum(abs(d - t) / t for d, t in pairs) / len(pairs), rel=1e-4)
    assert found.depth_rmse == pytest.approx((sum((d - t) ** 2 for d, t in pairs) / len(pairs)) ** 0.5, rel=1e-4)
    assert found.depth_mae == pytest.approx(sum(abs(d - t) for d, t in pairs) / len(pairs), rel=1e-4)
    logs = [abs(math.log10(d / t)) for d, t in pairs if d > 0]
    assert found.depth_log10 == pytest.approx(sum(logs) / len(logs), rel=1e-4)
    assert all(math.isnan(getattr(without, f"depth_{name}")) for name in DepthErrors._fields)


def test_outside_of_its_mask_a_view_does_not_count(tiny_scene, gaussians):
    view = tiny_scene.test[0]
    mask = torch.zeros(view.image.shape[1:])
    mask[8:20, 4:30] = 1
    spoiled = torch.where(mask == 1, view.image, 1 - view.image)  # what lies outside must not matter
    model, metric = TrainedModel(gaussians, tiny_scene.background), Brightness()
    masked = [dataclasses.replace(view, image=image, mask=mask) for image in (view.image, spoiled)]
    found, other = (evaluate(model, {"test": [each]}, perceptual=metric).views[0] for each in masked)
    image = model.test_rendering(view).image.clamp(0, 1)
    error = (image - view.image)[:, 8:20, 4:30].double().square().mean().item()
    assert found.psnr == other.psnr == pytest.approx(-10 * math.log10(error))
    white = [torch.where(mask == 1, x, 1.0) for x in (image, view.image)]
    assert found.ssim == other.ssim == pytest.approx(ssim(*white))
    assert found.lpips == other.lpips == pytest.approx(metric(*white), abs=1e-6)  # means of float32 numbers


def test_a_mask_that_leaves_nothing_leaves_no_quality(tiny_scene, gaussians):
    """Two white pictures are alike: a view that shows nothing of the object would raise the means."""
    view, model = tiny_scene.test[0], TrainedModel(gaussians, tiny_scene.background)
    hidden = dataclasses.replace(view, name="hidden", mask=torch.zeros_like(view.image[0]))
    both = evaluate(model, {"test": [view, hidden]}, perceptual=Brightness())
    alone = evaluate(model, {"test": [view]}, perceptual=Brightness())
    assert all(math.isnan(getattr(both.views[1], name)) for name in ("psnr", "ssim", "lpips", "psnr_expected"))
    assert all(both.mean("test", name) == alone.mean("test", name) for name in ("psnr", "ssim", "lpips"))
    assert both.views[1].ca == pytest.approx(both.views[0].ca, rel=0.5)  # needs no photograph


def test_images_are_scaled_for_the_test_and_co_adaptation_is_not(tiny_scene, gaussians):
    half = dataclasses.replace(gaussians, opacity_logits=torch.logit(0.5 * gaussians.opacities))
    plain = evaluate(TrainedModel(gaussians, tiny_scene.background), of_scene(tiny_scene))
    scaled = evaluate(TrainedModel(gaussians, tiny_scene.background, "dropout(0.5)"), of_scene(tiny_scene))
    halved = evaluate(TrainedModel(half, tiny_scene.background), of_scene(tiny_scene))
    for quantity in ("psnr", "ssim", "cv"):
        assert scores(scaled, quantity) == pytest.approx(scores(halved, quantity), rel=1e-4)
        assert scores(scaled, quantity) != pytest.approx(scores(plain, quantity), rel=1e-3)
    assert scores(scaled, "ca_half") == scores(plain, "ca_half")
    assert all(value > 0 for value in scores(plain, "ca"))


def test_images_get_the_expected_noise_and_co_adaptation_does_not(tiny_scene, gaussians):
    mean = opacity_noise(gaussians.opacities.double().repeat(20_000, 1).flatten()[:, None], 0.8,
                         generator=torch.Generator().manual_seed(1))[0].view(-1, 150).mean(0)  # fmt: skip
    drawn = dataclasses.replace(gaussians, opacity_logits=torch.logit(mean.float()))
    plain, scaled, sampled = (
        evaluate(model, of_scene(tiny_scene))
        for model in (
            TrainedModel(gaussians, tiny_scene.background),
            TrainedModel(gaussians, tiny_scene.background, "noise(0.8, scale=True)"),
            TrainedModel(drawn, tiny_scene.background),
        )
    )
    for quantity in ("psnr", "ssim", "cv"):
        assert scores(scaled, quantity) == pytest.approx(scores(sampled, quantity), rel=2e-3)
        assert scores(scaled, quantity) != pytest.approx(scores(plain, quantity), rel=1e-2)
    for quantity in ("ca", "ca_half", "ca_exact"):
        assert scores(scaled, quantity) == scores(plain, quantity)


def test_the_drop_rate_of_the_protocol_follows_the_training(tiny_scene, gaussians):
    trained = TrainedModel(gaussians, tiny_scene.background, "dropout(0.2)")
    assert trained.ca_score().settings.drop_rate == pytest.approx(0.6)  # half of the four fifths that training kept
    assert TrainedModel(gaussians, tiny_scene.background).ca_score().settings.drop_rate == 0.5
    assert trained.ca_score(drop_rate=0.3, samples=7, seed=4).settings.drop_rate == 0.3
    dropped, plain = (
        evaluate(m, of_scene(tiny_scene), samples=3) for m in (trained, dataclasses.replace(trained, regularizer=""))
    )
    assert scores(plain, "ca_half") == scores(plain, "ca")
    assert scores(dropped, "ca_half") == scores(plain, "ca")
    assert scores(dropped, "ca") != scores(plain, "ca")


def test_the_exact_score_is_the_limit_of_many_samples(tiny_scene, gaussians):
    scene = dataclasses.replace(tiny_scene, train=tiny_scene.train[:1], test=())
    model = TrainedModel(gaussians, scene.background, "dropout(0.2)")
    (view,) = evaluate(model, of_scene(scene), samples=2).views
    score = model.exact_ca_score()
    result = score(gaussians.opacities, scene.train[0])
    assert view.ca_exact == result.value
    assert (result.drop_rate, result.threshold) == (pytest.approx(0.6), 0.8)
    adaptive = CAScore.adaptive(model.render, p=0.2, relative_error=0.03, max_samples=160)(
        gaussians.opacities, scene.train[0]
    )
    # 5 standard errors, themselves known to 27 %: false alarm below 1e-3, and the seed is fixed.
    assert abs(adaptive.value - result.value) < 5 * adaptive.std_error < 0.5 * result.value


def test_exact_scores_at_another_drop_rate_and_over_the_expected_color(tiny_scene, gaussians):
    view, model = tiny_scene.train[0], TrainedModel(gaussians, tiny_scene.background)
    other = dataclasses.replace(model, background=1 - tiny_scene.background)
    assert model.exact_ca_score(drop_rate=0.3).settings.drop_rate == 0.3
    plain, bright = (m.exact_ca_score()(gaussians.opacities, view).value for m in (model, other))
    neutral, same = (m.exact_ca_score(neutral=True)(gaussians.opacities, view) for m in (model, other))
    assert plain != bright
    assert neutral.method == "exact_neutral"
    assert neutral.value == same.value


def test_moments_use_only_the_bands_and_the_background_of_the_model(tiny_scene, gaussians):
    view, sure = tiny_scene.train[0], Multiplier(1.0, 0.0)
    faint = 0.1 * gaussians.opacities  # no pixel ends early
    model = TrainedModel(gaussians, torch.tensor([0.2, 0.7, 0.4]), sh_degree=0)
    moments = model.moments(faint, view, sure)
    torch.testing.assert_close(moments.mean, model.render(faint, view)[0], rtol=0, atol=1e-5)
    black = dataclasses.replace(model, background=torch.zeros(3))
    assert torch.equal(model.moments(faint, view, sure, torch.zeros(3)).mean, black.moments(faint, view, sure).mean)


def test_only_the_bands_of_the_model_are_used(tiny_scene, gaussians):
    gray = dataclasses.replace(gaussians, sh_rest=gaussians.sh_rest[:, :0])
    cut = evaluate(TrainedModel(gaussians, tiny_scene.background, sh_degree=0), of_scene(tiny_scene))
    assert scores(cut, "psnr") == scores(
        evaluate(TrainedModel(gray, tiny_scene.background), of_scene(tiny_scene)), "psnr"
    )
    assert scores(cut, "psnr") != scores(
        evaluate(TrainedModel(gaussians, tiny_scene.background), of_scene(tiny_scene)), "psnr"
    )


class Brightness:
    name = "brightness"

    def __call__(self, image: torch.Tensor, target: torch.Tensor) -> float:
        assert image.min() >= 0
        assert image.max() <= 1
        return float(image.mean() - target.mean())


def test_a_perceptual_metric_sees_clamped_images(tiny_scene, gaussians):
    bright = dataclasses.replace(gaussians, sh_dc=gaussians.sh_dc + 4)
    result = evaluate(TrainedModel(bright, tiny_scene.background), of_scene(tiny_scene), perceptual=Brightness())
    assert result.perceptual_metric == "brightness"
    assert all(value > 0 for value in scores(result, "lpips"))


def test_an_empty_model_has_no_co_adaptation_and_says_so(tiny_scene, gaussians):
    nothing = gaussians[torch.zeros(150, dtype=torch.bool)]
    result = evaluate(TrainedModel(nothing, tiny_scene.background), of_scene(tiny_scene))
    assert all(math.isnan(value) for value in scores(result, "ca"))
    assert all(math.isnan(value) for value in scores(result, "ca_exact"))
    assert all(math.isnan(value) for value in scores(result, "cv"))
    assert scores(result, "visible") == [0.0] * 6
    assert all(math.isfinite(value) for value in scores(result, "psnr"))


def test_no_gradient_and_no_global_random_number(tiny_scene, gaussians):
    state = torch.get_rng_state()
    leaves = gaussians.map(lambda x: x.clone().requires_grad_())
    one = evaluate(TrainedModel(leaves, tiny_scene.background), of_scene(tiny_scene))
    assert torch.equal(torch.get_rng_state(), state)
    assert leaves.means.grad is None
    again = evaluate(TrainedModel(gaussians, tiny_scene.background), of_scene(tiny_scene))
    assert scores(one, "ca") == scores(again, "ca")


def of(name: str, split: str, value: float) -> ViewScores:
    return ViewScores(name, split, *[value] * 16, "", value, value, value)


def test_means_leave_out_what_does_not_exist():
    views = [of("a", "test", 1.0), of("b", "test", math.nan), of("c", "test", 4.0), of("d", "train", math.inf)]
    result = Evaluation(views, 10, None)
    assert result.mean("test", "ca") == 2.5
    assert math.isnan(result.mean("train", "psnr"))
    assert math.isnan(result.mean("validation", "psnr"))


def test_the_error_of_the_mean_is_that_of_independent_views(tiny_scene, gaussians):
    model = TrainedModel(gaussians, tiny_scene.background)
    result = evaluate(model, of_scene(tiny_scene))
    score = model.ca_score()  # counts views by itself, and knows the error of their mean
    for view in tiny_scene.test:
        score.update(gaussians.opacities, view)
    summary = score.compute()
    assert result.mean("test", "ca") == pytest.approx(summary.value)
    assert result.mean("test", "ca_std_error") == pytest.approx(summary.std_error)
    assert result.as_dict()["mean"]["test"]["ca_std_error"] == result.mean("test", "ca_std_error")


def test_a_view_without_a_score_has_no_part_in_the_error_and_one_without_an_error_leaves_it_open():
    views = [dataclasses.replace(of("v", "test", 1.0), ca_std_error=error) for error in (3.0, 4.0)]
    empty = of("empty", "test", math.nan)
    assert Evaluation([*views, empty], 10, None).mean("test", "ca_std_error") == 2.5
    unknown = dataclasses.replace(views[0], ca_std_error=math.nan)
    assert math.isnan(Evaluation([*views, unknown], 10, None).mean("test", "ca_std_error"))


def test_as_dict_is_plain_data():
    result = Evaluation([of("a", "test", 1.0), of("b", "train", 3.0)], 10, "lpips")
    data = json.loads(json.dumps(result.as_dict()))
    assert data == result.as_dict()
    assert data["mean"]["test"]["ssim"] == 1.0
    assert data["mean"]["train"]["ca_half"] == 3.0
    assert [view["name"] for view in data["views"]] == ["a", "b"]


def test_views_of_the_same_name_in_two_folders_keep_their_pictures(tiny_scene, gaussians, tmp_path):
    names = ["a/r_0.png", "b/r_0.png", "b/r_0_panel.jpg"]
    train = tuple(dataclasses.replace(v, name=n) for v, n in zip(tiny_scene.train, names, strict=True))
    scene = dataclasses.replace(tiny_scene, train=train, test=())
    result = evaluate(TrainedModel(gaussians, scene.background), of_scene(scene), samples=2, pictures=tmp_path)
    files = [tmp_path / "train" / f"{name}.png" for name in file_names(names)]
    assert len(list((tmp_path / "train").iterdir())) == 6
    for file, view, scores in zip(files, train, result.views, strict=True):
        assert psnr(read_image(file)[0], view.image) == pytest.approx(scores.psnr, abs=0.05)  # 8 bits instead of floats


def test_every_view_gets_its_pictures(tiny_scene, gaussians, tmp_path, said):
    """Also where names differ after a dot only, as in photographs named after the time of day."""
    names = ["12.30.01.jpg", "12.30.02.jpg", "sub/deep.png"]
    train = tuple(dataclasses.replace(v, name=n) for v, n in zip(tiny_scene.train, names, strict=True))
    scene = dataclasses.replace(tiny_scene, train=train, test=tiny_scene.test[:1])
    evaluate(TrainedModel(gaussians, scene.background), of_scene(scene), samples=2, pictures=tmp_path)
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*"))
    stems = ["test/test_0", "train/12.30.01", "train/12.30.02", "train/deep"]
    assert found == sorted(f"{stem}{end}.png" for stem in stems for end in ("", "_panel"))
    with Image.open(tmp_path / "train" / "deep.png") as image, Image.open(tmp_path / "train/deep_panel.png") as panel:
        assert image.size == (32, 24)
        assert panel.width >= 4 * 32
    members = [*(f"train {name}" for name in names), "test test_0"]
    assert [re.sub(r", about \d+ s left$", "", text) for text in said] == [
        f"[{number}/4] {member}" for number, member in enumerate(members, start=1)
    ]
    assert ["left" in text for text in said] == [False, True, True, True]


def test_photographs_are_not_needed_for_co_adaptation(tiny_scene, gaussians):
    model = TrainedModel(gaussians, tiny_scene.background, "dropout(0.2)")
    bare = evaluate(model, {"orbit": [Viewpoint("v", view.camera) for view in tiny_scene.train]}, samples=4, seed=3)
    full = evaluate(model, {"orbit": tiny_scene.train}, samples=4, seed=3, perceptual=Brightness())
    for one, other in zip(bare.views, full.views, strict=True):
        depths = (f"depth_{name}" for name in DepthErrors._fields)
        needing = {name: getattr(one, name) for name in ("psnr", "ssim", "lpips", *depths)}
        assert all(math.isnan(x) for x in needing.values())
        assert all(math.isfinite(getattr(other, name)) for name in needing)
        same = dataclasses.replace(other, name="v", **needing)
        assert repr(one) == repr(same)  # where nan is nan


def test_the_neutral_score_is_that_of_a_background_of_expected_color(tiny_scene, gaussians):
    """Sampled: 400 masks, every render over the mean color of its pixel; std error of the score below 2 %."""
    model = TrainedModel(gaussians, tiny_scene.background, "dropout(0.2)")
    generator = torch.Generator().manual_seed(0)
    opacities, view = gaussians.opacities, tiny_scene.train[0]
    colors, alphas = [], []
    for _ in range(400):
        keep = (torch.rand(150, generator=generator) >= 0.6).float()
        image, alpha = dataclasses.replace(model, background=torch.zeros(3)).render(opacities * keep, view)
        colors.append(image)
        alphas.append(alpha)
    color, alpha = torch.stack(colors), torch.stack(alphas)
    behind = color.mean(0) / alpha.mean(0).clamp(min=1e-6)
    variance = (color + (1 - alpha)[:, None] * behind).var(0).mean(0)
    visible = model.exact_ca_score()(opacities, view).visible
    (found,) = evaluate(model, {"train": [view]}).views
    assert found.ca_neutral == pytest.approx(variance[visible].mean().item(), rel=0.08)
    assert found.covered == pytest.approx(model.render(0.8 * opacities, view)[1].mean().item(), rel=1e-5)


def test_a_camera_that_sees_nothing_has_a_reason(tiny_scene, gaussians):
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ tiny_scene.train[0].camera.world_to_camera
    camera = dataclasses.replace(tiny_scene.train[0].camera, world_to_camera=away)
    (view,) = evaluate(TrainedModel(gaussians, tiny_scene.background), {"orbit": [Viewpoint("a", camera)]}).views
    assert all(math.isnan(x) for x in (view.ca, view.ca_exact, view.ca_neutral, view.cv))
    assert (view.visible, view.covered) == (0, 0)
    assert view.ca_reason == "EMPTY"


def test_a_panel_has_no_value_in_its_titles_where_there_is_none(gaussians, tmp_path):
    """Of a score where no pixel is covered, and of a photograph of which no pixel counts."""
    scene = synthetic_scene(width=200, height=16, points=9)  # wider than any title
    view = dataclasses.replace(scene.test[0], mask=torch.zeros(16, 200))
    evaluate(TrainedModel(gaussians[:1], scene.background), {"test": [view]}, pictures=tmp_path)
    panel = read_image(tmp_path / "test" / f"{file_names([view.name])[0]}_panel.png")[0]
    titles = ["photograph", "render", "error", "expected error", "exact CA"]
    titled = side_by_side([torch.zeros(3, 16, 200)] * len(titles), titles)
    assert panel.shape[2] == titled.shape[2]
    assert torch.equal(panel[:, :20], titled[:, :20])


def test_the_pictures_of_a_viewpoint(tiny_scene, gaussians, tmp_path):
    views = {"orbit": [Viewpoint("000", tiny_scene.train[0].camera)]}
    evaluate(TrainedModel(gaussians, tiny_scene.background), views, pictures=tmp_path)
    assert sorted(path.name for path in (tmp_path / "orbit").iterdir()) == ["000.png", "000_panel.png"]
    with Image.open(tmp_path / "orbit/000_panel.png") as panel, Image.open(tmp_path / "orbit/000.png") as picture:
        assert picture.size == (32, 24)
        assert panel.width > 4 * 32 + 3 * 4  # as wide as the labels
        assert panel.height == 24 + 20 + 30  # a line of text above, a color bar with its numbers below
