"""Shares and total effects, against the enumeration of all masks."""

import itertools
import math
from functools import partial

import pytest
import torch
from oracles import random_scene

from ca_reg import CAScore, OpacityNoise, Reason, attribute
from ca_reg.attribution import hanging, total_effects
from ca_reg.lists import ListMoments, PixelLists
from ca_reg.types import ExactMoments
from reference_trainer.render import splat
from reference_trainer.render.renderer import render_moments

HEIGHT, WIDTH = 3, 4
THRESHOLD = 0.2
CLOSE = {"rtol": 1e-12, "atol": 1e-16}
CASES = [(n, rate, neutral) for n, rate in ((1, 0.5), (3, 0.2), (8, 0.5), (8, 0.7)) for neutral in (False, True)]


class Scene:
    """n Gaussians that reach most pixels, at depths that do not follow their index."""

    def __init__(self, n, seed=0):
        g = torch.Generator().manual_seed(seed)
        self.n = n
        self.depth_order = torch.randperm(n, generator=g)
        self.falloff = torch.rand(HEIGHT * WIDTH, n, generator=g, dtype=torch.float64)  # in depth order
        self.falloff *= torch.rand(HEIGHT * WIDTH, n, generator=g) < 0.8
        self.falloff[::3] *= 0.05  # these are not visible
        self.opacity, self.colors, self.background = (
            torch.rand(*shape, generator=g, dtype=torch.float64) for shape in ((n,), (n, 3), (3,))
        )
        self.opacity = 0.5 + 0.49 * self.opacity
        self.moments = ListMoments(self.lists)

    def lists(self, opacity, view):
        pixels, ranks = (self.falloff > 0).nonzero().unbind(1)
        gaussians = self.depth_order[ranks]
        alphas = opacity.flatten()[gaussians] * self.falloff[pixels, ranks]
        return PixelLists(gaussians, pixels, alphas, self.colors, HEIGHT, WIDTH, self.background)

    def score(self, rate, neutral=False):
        return CAScore.exact(self.moments, drop_rate=rate, neutral=neutral, threshold=THRESHOLD)

    def draws(self, supports):
        """Colors over black (pixels, 3, ...) and alpha (pixels, ...) of every outcome, one axis per Gaussian in depth.

        ``supports`` are (values, probabilities) per Gaussian in depth order.
        """
        factors = torch.tensor(list(itertools.product(*(values for values, _ in supports))), dtype=torch.float64)
        alphas = factors * (self.opacity[self.depth_order] * self.falloff)[:, None]
        light, image = torch.ones_like(alphas[..., 0]), 0.0
        for i, color in enumerate(self.colors[self.depth_order]):
            image = image + (light * alphas[..., i])[:, None] * color[:, None]
            light = light * (1 - alphas[..., i])
        shape = [len(values) for values, _ in supports]
        return image.unflatten(-1, shape), (1 - light).unflatten(-1, shape)

    def images(self, supports, rate, neutral):
        """Renders of every outcome in the visible pixels, over the background of the score."""
        certain = [dropout(rate)] * self.n
        colors, alpha = (expectation(x, certain, self.n) for x in self.draws(certain))
        behind = colors / alpha.clamp(min=1e-300)[:, None] if neutral else self.background.expand(len(alpha), 3)
        colors, alphas = self.draws(supports)
        images = colors + (1 - alphas)[:, None] * spread_out(behind, self.n)
        assert 2 < (alpha > THRESHOLD).sum() < len(alpha) - 2
        return images[alpha > THRESHOLD]

    def value(self, supports, rate, neutral):
        """The score with these factors, by enumeration."""
        images = self.images(supports, rate, neutral)
        mean = spread_out(expectation(images, supports, self.n), self.n)
        return expectation((images - mean).square(), supports, self.n).mean()


def dropout(rate):
    return (0.0, 1.0), (rate, 1 - rate)


def spread_out(x, n):
    """Append an axis for each of n factors."""
    return x.reshape(*x.shape, *[1] * n)


def expectation(x, supports, count):
    """Average over the factors of the last ``count`` Gaussians, the axes at the end."""
    for _, probabilities in reversed(supports[len(supports) - count :]):
        x = x @ torch.tensor(probabilities, dtype=x.dtype)
    return x


@pytest.mark.parametrize(("n", "rate", "neutral"), CASES)
def test_shares_add_up_to_the_enumerated_score(n, rate, neutral):
    scene = Scene(n)
    shares, result = attribute(scene.score(rate, neutral), scene.moments.shares, scene.opacity, None)
    assert shares.shape == (n,)
    assert (shares >= 0).all()
    torch.testing.assert_close(shares.sum(), scene.value([dropout(rate)] * n, rate, neutral), **CLOSE)
    assert shares.sum().item() == pytest.approx(result.value, rel=1e-13, abs=1e-30)


@pytest.mark.parametrize(("n", "rate", "neutral"), CASES)
def test_a_share_is_what_a_factor_adds_to_what_is_known_from_those_in_front(n, rate, neutral):
    scene = Scene(n)
    shares = attribute(scene.score(rate, neutral), scene.moments.shares, scene.opacity, None).shares
    supports = [dropout(rate)] * n
    images = scene.images(supports, rate, neutral)
    known = [expectation(images, supports, n - k) for k in range(n + 1)]  # means, given the first k factors
    for k, gaussian in enumerate(scene.depth_order.tolist()):
        added = (known[k + 1] - known[k][..., None]).square()
        expected = expectation(added, supports[: k + 1], k + 1).mean()
        torch.testing.assert_close(shares[gaussian], expected, **CLOSE)


@pytest.mark.parametrize(("n", "rate", "neutral"), CASES)
def test_a_total_effect_is_what_the_score_loses_when_one_factor_is_fixed(n, rate, neutral):
    scene = Scene(n)
    effects, result = total_effects(scene.score(rate, neutral), scene.opacity, None)
    supports = [dropout(rate)] * n
    value = scene.value(supports, rate, neutral)
    assert result.value == pytest.approx(value.item(), rel=1e-12, abs=1e-30)
    for k, gaussian in enumerate(scene.depth_order.tolist()):
        fixed = [*supports[:k], ((1 - rate,), (1.0,)), *supports[k + 1 :]]
        loss = value - scene.value(fixed, rate, neutral)
        torch.testing.assert_close(effects[gaussian], loss, rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("regularizer", [None, OpacityNoise(0.5)])
def test_inference_mode_does_not_keep_the_gradient_away(regularizer):
    scene = Scene(4)
    score = CAScore.exact(scene.moments, regularizer=regularizer, threshold=THRESHOLD)
    expected = total_effects(score, scene.opacity, None)
    with torch.inference_mode():
        opacity = scene.opacity * 1.0
        assert torch.equal(total_effects(score, opacity, None).effects, expected.effects)


@pytest.mark.parametrize("neutral", [False, True])
def test_no_total_effect_is_below_the_share(neutral):
    scene = Scene(8, seed=2)
    shares, result = attribute(scene.score(0.5, neutral), scene.moments.shares, scene.opacity, None)
    effects = total_effects(scene.score(0.5, neutral), scene.opacity, None).effects
    assert (effects >= shares * (1 - 1e-12)).all()
    assert effects.sum() > 1.05 * result.value
    # Nothing lies behind the last one, so nobody could share with it.
    last = scene.depth_order[-1]
    torch.testing.assert_close(effects[last], shares[last], **CLOSE)


@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("layout", ["CHW", "HWC"])
def test_the_callables_are_asked_the_same(neutral, layout):
    scene, asked = Scene(5), []

    def turn(x, axes):
        return x.permute(axes) if x is not None and layout == "HWC" and x.ndim == 3 else x

    def moments_fn(opacity, view, multiplier, background):
        asked.append((opacity, view, multiplier.mean, multiplier.variance, background))
        out = scene.moments(opacity, view, multiplier, turn(background, (2, 0, 1)))
        return ExactMoments(turn(out.mean, (1, 2, 0)), turn(out.variance, (1, 2, 0)), out.alpha_mean)

    def shares_fn(opacity, view, multiplier, background, weights):
        asked.append((opacity, view, multiplier.mean, multiplier.variance, background))
        return scene.moments.shares(opacity, view, multiplier, turn(background, (2, 0, 1)), weights)

    score = CAScore.exact(moments_fn, p=0.2, neutral=neutral, threshold=THRESHOLD, layout=layout)
    opacity = scene.opacity[:, None].clone().requires_grad_()
    shares, result = attribute(score, shares_fn, opacity, "view")
    assert shares.sum().item() == pytest.approx(result.value, rel=1e-13)
    assert not shares.requires_grad
    assert len(asked) == (3 if neutral else 2)
    for a, b in zip(asked[-2], asked[-1], strict=True):
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b

    with torch.no_grad():
        effects = total_effects(score, opacity, "view").effects
    assert not effects.requires_grad
    assert opacity.grad is None
    plain = CAScore.exact(scene.moments, p=0.2, neutral=neutral, threshold=THRESHOLD)
    torch.testing.assert_close(effects, total_effects(plain, scene.opacity, None).effects, **CLOSE)


def test_total_effects_come_through_the_reference_renderer():
    gaussians = random_scene(30, 12, 9, 5, size=0.2)

    def moments_fn(opacity, view, multiplier, background):
        splats = splat(*gaussians[:3], opacity, gaussians.camera, colors=gaussians.colors)
        return render_moments(splats, multiplier, background=background)

    score = CAScore.exact(moments_fn, neutral=True, threshold=0.3)
    effects, result = total_effects(score, gaussians.opacities, None)
    _, _, multiplier, background = score.measure(gaussians.opacities, None)

    def value(variances):
        variance = moments_fn(gaussians.opacities, None, type(multiplier)(0.5, variances), background).variance
        return variance.mean(0)[result.visible].mean().item()

    assert (effects > 0).sum() > 10
    for i in (effects > 0).nonzero().flatten()[:10].tolist() + (effects == 0).nonzero().flatten()[:3].tolist():
        variances = torch.full((30,), 0.25, dtype=torch.float64)
        variances[i] = 0.0
        assert effects[i].item() == pytest.approx(result.value - value(variances), rel=1e-9, abs=1e-14)


@pytest.mark.parametrize("reason", [Reason.EMPTY, Reason.NOT_FINITE])
def test_without_a_value_all_are_zero_and_the_reason_says_why(reason):
    scene = Scene(4)

    def diverged(*arguments):
        moments = scene.moments(*arguments)
        return moments._replace(variance=moments.variance * math.nan)

    if reason is Reason.EMPTY:
        score = CAScore.exact(scene.moments, threshold=1.0)
    else:
        score = CAScore.exact(diverged, threshold=THRESHOLD)
    shares, result = attribute(score, scene.moments.shares, scene.opacity, None)
    effects, same = total_effects(score, scene.opacity, None)
    assert result.reason is same.reason is reason
    assert shares.tolist() == effects.tolist() == [0.0] * 4


@pytest.mark.parametrize("make", [CAScore, partial(CAScore.adaptive, relative_error=0.1)])
def test_a_sampled_score_cannot_be_attributed(make):
    scene = Scene(3)
    score = make(lambda opacity, view: None)
    for name, call in (
        ("attribute", lambda: attribute(score, scene.moments.shares, scene.opacity, None)),
        ("total_effects", lambda: total_effects(score, scene.opacity, None)),
    ):
        with pytest.raises(ValueError, match=f"{name} .*exact score, .*'(sampling|adaptive)'"):
            call()


def test_total_effects_need_a_gradient():
    scene = Scene(3)

    def constant(opacity, view, multiplier, background):
        return scene.moments(opacity, view, type(multiplier)(multiplier.mean, 0.25), background)

    def detached(opacity, view, multiplier, background):
        return ExactMoments(*(x.detach() for x in scene.moments(opacity, view, multiplier, background)))

    def elsewhere(opacity, view, multiplier, background):
        out = constant(opacity, view, multiplier, background)
        return out._replace(variance=out.variance * torch.ones(1, dtype=torch.float64, requires_grad=True))

    for moments_fn in (constant, detached, elsewhere):
        with pytest.raises(ValueError, match=r"gradient in multiplier\.variance"):
            total_effects(CAScore.exact(moments_fn, threshold=THRESHOLD), scene.opacity, None)


def test_bad_input():
    scene = Scene(3)
    score = scene.score(0.5)
    for call in (lambda o: attribute(score, scene.moments.shares, o, None), lambda o: total_effects(score, o, None)):
        with pytest.raises(ValueError, match="must be activated"):
            call(scene.opacity + 1)
        with pytest.raises(TypeError, match="floating-point"):
            call(torch.ones(3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"share.* shape \(3,\), got \(2,\)"):
        attribute(score, lambda *args: scene.moments.shares(*args)[:2], scene.opacity, None)


def test_what_hangs_is_seen_there_more_than_here_and_holds_much_of_the_score():
    """Against a loop over the Gaussians, each asked by itself."""
    g = torch.Generator().manual_seed(0)
    shares, there, here = (torch.rand(200, generator=g, dtype=torch.float64) ** 4 for _ in range(3))
    total = sum(shares.tolist())
    suspect = [seen > 1.5 * trained for seen, trained in zip(there.tolist(), here.tolist(), strict=True)]
    held = sum(share for share, one in zip(shares.tolist(), suspect, strict=True) if one) / total
    found = hanging(shares, there, here, ratio=1.5, together=0.99 * held, alone=0.01)
    one_by_one = [one and share / total > 0.01 for share, one in zip(shares.tolist(), suspect, strict=True)]
    assert 0 < sum(one_by_one) < sum(suspect) < 200
    assert found.tolist() == one_by_one
    assert not hanging(shares, there, here, ratio=1.5, together=1.01 * held, alone=0.01).any()
    assert not hanging(torch.zeros(3), torch.ones(3), torch.zeros(3), together=0.0, alone=0.0).any()  # no score


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"there": torch.ones(2)}, r"shape \(N,\), got \(3,\), \(2,\) and \(3,\)"),
        ({"ratio": -1.0}, "ratio .*at least 0"),
        ({"together": 1.0}, r"together and alone in \[0, 1\)"),
        ({"alone": -0.1}, r"together and alone in \[0, 1\)"),
    ],
)
def test_hanging_refuses_what_cannot_be(change, message):
    with pytest.raises(ValueError, match=message):
        hanging(**{"shares": torch.ones(3), "there": torch.ones(3), "here": torch.ones(3)} | change)
