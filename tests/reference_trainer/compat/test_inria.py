"""Exact moments of a live model of the INRIA family, against the enumeration of all masks in its own render."""

import itertools

import pytest
import torch
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render

from ca_reg import CAPenalty, CAScore, GaussianDropout, attribute
from ca_reg.functional import Multiplier
from ca_reg.integrations.inria import RasterizerHook, render_fn
from reference_trainer.compat.inria import InriaMoments
from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.render import render_moments, splat

N, BEHIND = 6, 2
BACKGROUND = torch.tensor([0.3, 0.1, 0.7])


def small_model(device="cpu"):
    """A few large Gaussians, one of which is behind the camera."""
    model = Model(N, seed=5, device=device)
    means, scales, _, opacities, _ = model.parameters()
    with torch.no_grad():
        scales += 1.0
        opacities.clamp_(-1.5, 2.0)
        means[BEHIND] -= 5 * model.camera.world_to_camera[2, :3]
    return model


def enumerated(render, opacity, camera, rate):
    """Mean and variance of the picture and the mean alpha over all masks, each rendered by itself."""
    first = second = alpha = 0.0
    for mask in itertools.product((0.0, 1.0), repeat=N):
        keep = torch.tensor(mask, device=opacity.device)
        probability = float(torch.where(keep > 0, 1 - rate, rate).prod())
        image, covered = (x.double() for x in render(opacity * keep[:, None], camera))
        first, second, alpha = (
            first + probability * image, second + probability * image.square(), alpha + probability * covered
        )  # fmt: skip
    return first, second - first.square(), alpha


def check_all_masks(theirs, moments, opacity, camera, rate=0.4):
    with torch.no_grad():
        expected = enumerated(theirs, opacity, camera, rate)
        found = moments(opacity, camera, Multiplier.dropout(rate), None)
    assert expected[1].max() > 1e-3
    for exact, mean in zip(found, expected, strict=True):
        torch.testing.assert_close(exact.double(), mean, rtol=1e-4, atol=2e-6)


@pytest.fixture
def made():
    """A model, its render function, and its exact moments."""
    model, rasterizer = small_model(), make_rasterizer()
    render = make_render(rasterizer)
    return model, render, InriaMoments(render, model, PIPE, BACKGROUND, rasterizer=rasterizer)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)], indirect=True)
def test_moments_are_those_of_all_masks(device):
    model, rasterizer = small_model(device), make_rasterizer()
    given = make_render(rasterizer), model, PIPE, BACKGROUND.to(device)
    theirs, moments = (make(*given, rasterizer=rasterizer) for make in (render_fn, InriaMoments))
    check_all_masks(theirs, moments, model.get_opacity.detach(), model.camera)


@pytest.mark.parametrize(
    "changes", [{"antialiasing": True}, {"kernel_size": 0.1}, {"scale_modifier": 0.7}, {"sh_degree": 1}]
)
def test_what_the_settings_ask_for_is_in_the_moments(changes, settings_of):
    """Of the stand-in with bands of which some are not active, the first one apart, and bfloat16 around it."""
    model = small_model()
    sh = torch.randn(N, 9, 3, generator=torch.Generator().manual_seed(1)) / 3
    rasterizer = rasterizer_module("a_rasterizer").GaussianRasterizer
    settings = settings_of(model.camera, bg=BACKGROUND, **changes)

    def render(camera, gaussians, pipe, background):
        image, _ = rasterizer(settings)(
            gaussians.get_xyz, torch.zeros(N, 3), gaussians.get_opacity, dc=sh[:, :1], shs=sh[:, 1:],
            scales=gaussians.get_scaling, rotations=gaussians.get_rotation,
        )  # fmt: skip
        return {"render": image}

    given = render, model, PIPE, BACKGROUND
    theirs, moments = (make(*given, rasterizer=rasterizer) for make in (render_fn, InriaMoments))
    with torch.autocast("cpu", torch.bfloat16):
        check_all_masks(theirs, moments, model.get_opacity.detach(), model.camera)


def test_shares_add_up_to_the_score(made):
    model, _, moments = made
    opacity = model.get_opacity
    shares, result = attribute(CAScore.exact(moments, threshold=0.1), moments.shares, opacity, model.camera)
    assert result.value > 1e-3
    assert shares.sum().item() == pytest.approx(result.value, rel=1e-5)
    assert (shares > 0).tolist() == [i != BEHIND for i in range(N)]


def test_over_their_own_mean_the_background_is_the_scores(made):
    """A background of one's own takes the place of the one that render gives."""
    model, render, moments = made
    opacity = model.get_opacity.detach()
    black = InriaMoments(render, model, PIPE, torch.zeros(3), rasterizer=moments.rasterizer)
    scores = [CAScore.exact(x, neutral=True, threshold=0.1)(opacity, model.camera).value for x in (moments, black)]
    assert scores[0] == pytest.approx(scores[1], rel=1e-6)
    assert scores[0] > 1e-4


def test_weights_are_the_gradient_of_their_picture_in_a_color(made):
    model, render, moments = made
    render(model.camera, model, PIPE, BACKGROUND)["render"][0].sum().backward()
    weights = moments.weights(model.get_opacity, model.camera)
    torch.testing.assert_close(weights, model.parameters()[4].grad[:, 0].double(), rtol=1e-5, atol=1e-6)
    assert weights[BEHIND] == 0


def test_gradients_reach_what_the_model_trains(made):
    """So a penalty trains it, through its own activations."""
    model, _, moments = made
    multiplier = Multiplier.dropout(0.5)
    image, _, penalty = CAPenalty(moments, multiplier)(model.get_opacity, model.camera)
    (image.mean() + penalty).backward()
    found = [x.grad.clone() for x in model.parameters()]
    model_of_its_own = small_model()
    arguments = (getattr(model_of_its_own, f"get_{name}") for name in ("xyz", "rotation", "scaling", "opacity"))
    splats = splat(*arguments, model.camera, colors=model_of_its_own.get_features)
    mean, variance, _ = render_moments(splats, multiplier, background=BACKGROUND)
    (mean.mean() + variance.mean()).backward()
    for gradient, parameter in zip(found, model_of_its_own.parameters(), strict=True):
        torch.testing.assert_close(gradient, parameter.grad)


def test_a_hook_around_the_rasterizer_is_bypassed(made):
    model, render, moments = made
    given = model.get_opacity, model.camera, Multiplier.dropout(0.5), None
    plain = moments(*given)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=moments.rasterizer) as hook:
        hook.step(1)
        for training in (True, False):
            with torch.set_grad_enabled(training):
                hooked = moments(*given)
            assert all(torch.equal(a, b) for a, b in zip(plain, hooked, strict=True))
        assert hook.tally.regularized + hook.tally.scaled == 0
        render(model.camera, model, PIPE, BACKGROUND)
        assert hook.tally.regularized == 1


def test_what_has_no_moments_is_refused(made):
    model, render, moments = made
    given = model.get_opacity.detach(), model.camera, Multiplier.dropout(0.5), None

    def with_covariances(view, gaussians, pipe, background):
        return render(view, gaussians, pipe, background, cov3D_precomp=torch.zeros(N, 6))

    def twice(*arguments):
        return render(*arguments), render(*arguments)

    def moments_of(function):
        return InriaMoments(function, model, PIPE, BACKGROUND, rasterizer=moments.rasterizer)

    with pytest.raises(ValueError, match="compute_cov3D_python"):
        moments_of(with_covariances)(*given)
    with pytest.raises(RuntimeError, match="2 times, expected once"):
        moments_of(twice)(*given)
    with pytest.raises(ValueError, match=r"6 Gaussians, .*5 opacities"):
        moments(given[0][1:], *given[1:])


def test_an_argument_that_the_stand_in_does_not_know_is_ignored_with_a_warning():
    class Rasterizer(make_rasterizer()):
        def forward(
            self, means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, shadow_of_the_test
        ):
            return super().forward(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)

    model, shadow = small_model(), torch.ones(N)
    render = make_render(Rasterizer)
    moments = InriaMoments(
        lambda *given: render(*given, shadow_of_the_test=shadow), model, PIPE, BACKGROUND, rasterizer=Rasterizer
    )
    with pytest.warns(UserWarning, match="argument shadow_of_the_test"):
        moments(model.get_opacity.detach(), model.camera, Multiplier.dropout(0.5), None)
