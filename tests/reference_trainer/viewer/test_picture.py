import math
import re
from dataclasses import replace

import pytest
import torch

from ca_reg import CAScore, Chain, GaussianDropout, OpacityNoise
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE
from reference_trainer.evaluation.pictures import heat_map
from reference_trainer.evaluation.shares import Heat, blend_weights, colored_by, mean_shares
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians, render_moments_of
from reference_trainer.scenes.scene import View, Viewpoint
from reference_trainer.viewer.picture import DisplayOptions, ViewerModel, with_photograph

CAMERA = Camera(torch.eye(4), 40.0, 40.0, 20.0, 15.0, 40, 30)
BESIDE = replace(CAMERA, world_to_camera=torch.eye(4).index_put((torch.tensor(0), torch.tensor(3)), torch.tensor(0.3)))


@pytest.fixture(scope="module")
def model():
    """A cloud in front of the camera, of opacities up to 1, trained with dropout."""
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(400, 3, generator=generator) * torch.tensor([2.0, 2.0, 1.0]) - torch.tensor([1.0, 1.0, -1.5])
    colors = torch.rand(400, 3, generator=generator)
    gaussians = Gaussians.from_points(positions, colors, torch.full((400,), 0.15), sh_degree=1)
    logits = torch.rand(400, generator=generator) * 6 - 1
    return TrainedModel(replace(gaussians, opacity_logits=logits), torch.rand(3, generator=generator), "dropout(0.2)")


def rendered_with(model, opacities, camera=CAMERA):
    return render_gaussians(model.gaussians, camera, model.background, opacities=opacities).image.clamp(0, 1)


def test_a_render_is_that_of_the_test(model):
    image, note, _ = ViewerModel(model, []).render(DisplayOptions(), CAMERA)
    torch.testing.assert_close(image, rendered_with(model, 0.8 * model.gaussians.opacities))
    assert note == ""


def test_the_expected_error_is_told_by_the_training_photographs(model):
    photograph = View("v", CAMERA, rendered_with(model, 0.5 * model.gaussians.opacities))
    shown = ViewerModel(model, [Viewpoint("", CAMERA)], train=[photograph])
    image, note, scale = shown.render(DisplayOptions("expected error"), CAMERA)
    found = ErrorMaps(model, [photograph])(Viewpoint("", CAMERA))
    torch.testing.assert_close(image, heat_map(found.error, float(scale[1])))
    assert f"expected {found.psnr:.1f} dB" in note
    alone = ViewerModel(model, []).render(DisplayOptions("expected error"), CAMERA)
    assert not torch.equal(alone.image, image)


def test_the_support_is_how_many_training_photographs_show_what_is_there(model):
    opaque = replace(model, gaussians=replace(model.gaussians, opacity_logits=torch.full((400,), 4.0)))
    photographs = [View(name, CAMERA, torch.zeros(3, 30, 40)) for name in "ab"]  # from where the page looks
    image, note, scale = ViewerModel(opaque, [], train=photographs).render(DisplayOptions("support"), CAMERA)
    covered = opaque.test_rendering(Viewpoint("", CAMERA)).alpha > 0.5
    assert covered.double().mean() > 0.5
    torch.testing.assert_close(image, heat_map(torch.where(covered, 2.0, torch.nan), 2.0))
    assert re.match("shown by no .* 0%, by one 0%", note)
    assert scale[:2] == ("0", "2")
    with pytest.raises(ValueError, match="photographs"):
        ViewerModel(opaque, []).render(DisplayOptions("support"), CAMERA)


@pytest.mark.parametrize("mask", [False, True])  # which an exact map has no use for
def test_the_co_adaptation_is_that_of_the_chosen_rate(model, mask):
    image, *_ = ViewerModel(model, []).render(DisplayOptions("co-adaptation", drop_rate=0.3, mask=mask), CAMERA)
    moments, _ = render_moments_of(model.gaussians, Multiplier.dropout(0.3), CAMERA, model.background)
    variance = moments.variance.mean(0).masked_fill(moments.alpha_mean <= 0.8, math.nan)
    torch.testing.assert_close(image, heat_map(variance, CA_PICTURE_RANGE), rtol=0, atol=0.02)  # a step of the colors


def test_the_co_adaptation_takes_the_noise_in(model):
    note = ViewerModel(model, []).render(DisplayOptions("co-adaptation", drop_rate=0.3, noise=0.4), CAMERA).note
    value = float(re.match(r"exact CA at drop rate 0\.3 with noise 0\.4 ([\d.]+)e-3", note)[1]) * 1e-3
    draws = Chain(GaussianDropout(0.3), OpacityNoise(0.4))
    score = CAScore.adaptive(model.render, regularizer=draws, relative_error=1e-3)
    sampled = score(model.gaussians.opacities, Viewpoint("", CAMERA))
    # Of 256 draws, the seed fixed; beyond 5 standard errors with a probability below 1e-5
    assert abs(value - sampled.value) < 5 * sampled.std_error + 0.005e-3
    assert sampled.std_error < 0.1 * value


def test_a_mask_stays_while_somebody_turns_and_grows_with_the_rate(model):
    shown, plain, kept = ViewerModel(model, []), model.gaussians.opacities, []
    for rate in (0.3, 0.6):
        look = DisplayOptions(drop_rate=rate, mask=True)
        image, *_ = shown.render(look, CAMERA)
        keep = shown.chosen(look).gaussians.opacities > 0
        # 400 draws: beyond 5 standard deviations with a probability below 1e-6; the seed is fixed
        assert abs(keep.float().mean().item() - (1 - rate)) < 5 * math.sqrt(rate * (1 - rate) / 400)
        torch.testing.assert_close(image, rendered_with(model, plain * keep))
        beside, *_ = shown.render(look, BESIDE)
        torch.testing.assert_close(beside, rendered_with(model, plain * keep, BESIDE))
        kept.append(keep)
    assert bool((kept[1] <= kept[0]).all())


def test_noise_is_a_draw_of_the_plain_opacities(model):
    noisy = ViewerModel(model, []).chosen(DisplayOptions(noise=0.1))
    factors = noisy.gaussians.opacities / model.gaussians.opacities
    inner = model.gaussians.opacities < 0.6  # which no draw within 6 standard deviations takes to 1
    # Standard error of a standard deviation from n draws: sigma / sqrt(2 n); beyond 5 of them below 1e-6, seed fixed
    n = int(inner.sum())
    assert abs(factors[inner].std().item() - 0.1) < 5 * 0.1 / math.sqrt(2 * n)
    assert abs(factors[inner].mean().item() - 1) < 5 * 0.1 / math.sqrt(n)


def test_those_that_co_adapt_most_are_hidden(model):
    views = [Viewpoint("", CAMERA), Viewpoint("", BESIDE)]
    shares, _ = mean_shares(model, views)
    values = torch.where(shares > 0, shares / blend_weights(model, views), 0)
    stay = values <= values.sort().values[299]
    assert stay.sum() == 300
    image, note, _ = ViewerModel(model, views).render(DisplayOptions(hidden=0.25), CAMERA)
    torch.testing.assert_close(image, rendered_with(model, 0.8 * model.gaussians.opacities * stay))
    assert note.startswith(f"{shares[~stay].sum() / shares.sum():.0%} of the exact CA")


def test_heat_is_brighter_where_more_co_adapts(model):
    shown = ViewerModel(model, [Viewpoint("", CAMERA)])
    image, _, scale = shown.render(DisplayOptions("heat"), CAMERA)
    assert scale[:2] == ("0.1", "10")
    gaussians, values = shown.chosen(DisplayOptions("heat")).gaussians, shown.heat.values
    inside = (values > shown.heat.mean / 10) & (values < shown.heat.mean * 10)
    brightness = gaussians.sh_dc[inside, 0].sum(1)[values[inside].argsort()]
    assert inside.sum() > 50
    assert bool((brightness.diff() >= -1e-6).all())  # along the color map, up to steps of its table
    torch.testing.assert_close(
        image, ViewerModel(replace(model, gaussians=gaussians), []).render(DisplayOptions(), CAMERA)[0]
    )


@pytest.mark.parametrize("mode", ["expected error", "support"])
def test_what_is_told_of_the_whole_model_needs_no_heat_to_hide_some(model, mode):
    photograph = View("v", CAMERA, rendered_with(model, 0.5 * model.gaussians.opacities))
    looks = (DisplayOptions(mode, hidden=hidden) for hidden in (0.0, 0.5))
    whole, most = (ViewerModel(model, [], train=[photograph]).render(look, CAMERA) for look in looks)
    assert torch.equal(whole.image, most.image)
    assert whole.note == most.note


def test_heat_that_cannot_be_measured_is_refused(model):
    faint = replace(model, gaussians=replace(model.gaussians, opacity_logits=model.gaussians.opacity_logits - 9))
    for look in (DisplayOptions("heat"), DisplayOptions(hidden=0.1)):
        with pytest.raises(ValueError, match="the 1 views"):
            ViewerModel(faint, [Viewpoint("", CAMERA)]).render(look, CAMERA)


def test_depth_is_that_of_walls():
    """A near wall on the left, a far one on the right, nothing below."""
    x, y = torch.meshgrid(torch.linspace(-3, 3, 61), torch.linspace(-3, 0, 31), indexing="ij")
    z = torch.where(x < 0, 2.0, 6.0)
    points = torch.stack([x * z / 2, y * z / 2, z], -1).reshape(-1, 3)
    gaussians = Gaussians.from_points(
        points, torch.rand(len(points), 3), 0.05 * points[:, 2], sh_degree=0, opacity=0.95
    )
    thin = replace(gaussians, log_scales=gaussians.log_scales - torch.tensor([0.0, 0, 8]))
    image, _, (far, near, _) = ViewerModel(TrainedModel(thin, torch.ones(3)), []).render(
        DisplayOptions("depth"), CAMERA
    )
    assert (float(near), float(far)) == pytest.approx((2, 6), rel=0.02)
    assert image[:, 5, 5].sum() > image[:, 5, 35].sum() + 1
    torch.testing.assert_close(image[:, 25:], torch.full((3, 5, 40), 0.5))  # gray
    nothing = replace(thin, opacity_logits=thin.opacity_logits - 99)
    assert (
        ViewerModel(TrainedModel(nothing, torch.ones(3)), [])
        .render(DisplayOptions("depth"), CAMERA)
        .note.startswith("nothing")
    )


def test_a_view_without_a_score_says_why_in_words(model):
    faint = replace(model, gaussians=replace(model.gaussians, opacity_logits=model.gaussians.opacity_logits - 99))
    note = ViewerModel(faint, []).render(DisplayOptions("co-adaptation"), CAMERA).note
    assert note.startswith("no pixel counts")
    assert "('" not in note


def test_the_gray_of_a_map_comes_with_its_share_and_its_reason(model):
    image, note, scale = ViewerModel(model, []).render(DisplayOptions("co-adaptation", drop_rate=0.8), CAMERA)
    moments, _ = render_moments_of(model.gaussians, Multiplier.dropout(0.8), CAMERA, model.background)
    gray = moments.alpha_mean <= 0.8
    assert 0 < gray.float().mean() < 1
    torch.testing.assert_close(image[:, gray], torch.full_like(image[:, gray], 0.5), rtol=0, atol=0.01)
    assert re.search(f", {gray.double().mean():.0%} of .*not covered", note)
    assert "gray, not covered" in scale[2]


def test_two_models_beside_each_other_have_one_scale_of_heat(model):
    pale = replace(model, gaussians=replace(model.gaussians, sh_dc=0.3 * model.gaussians.sh_dc))
    first, second = ViewerModel(model, [view := Viewpoint("", CAMERA)]), Heat.of(pale, [view])
    beside = ViewerModel(pale, [view], first).chosen(DisplayOptions("heat"))
    expected = colored_by(pale.gaussians, second.values, 0.1 * first.heat.mean, 10 * first.heat.mean)
    assert second.mean != pytest.approx(first.heat.mean, rel=0.5)  # or the scales would be one by accident
    torch.testing.assert_close(beside.gaussians.sh_dc, expected.sh_dc)


def test_a_photograph_lies_where_its_camera_saw_it():
    """The color of a photograph is a smooth function of the direction, which a turned camera sees at other pixels."""

    def world(camera):
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        local = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
        seen = torch.nn.functional.normalize(local, dim=-1) @ camera.world_to_camera[:3, :3]
        return (seen.permute(2, 0, 1) + 1) / 2

    c, s = math.cos(0.1), math.sin(0.1)
    turned = torch.tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    page = replace(CAMERA.resized(80, 60), world_to_camera=turned, fx=160.0, fy=160.0)  # rolled, half the field of view
    view = View("", CAMERA, world(CAMERA))
    black = torch.zeros(3, 60, 80)
    torch.testing.assert_close(with_photograph(black, page, view, 0.5), 0.5 * world(page), rtol=0, atol=0.002)
    wider = replace(page, fx=20.0, fy=20.0)  # which sees beyond it
    over = with_photograph(black, wider, view, 1.0)
    assert not over[:, 0].any()
    torch.testing.assert_close(over[:, 30, 40], world(wider)[:, 30, 40], rtol=0, atol=0.02)
