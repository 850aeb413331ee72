"""Scores whose draws are those of a regularizer, against enumeration of its masks."""

import contextlib
import itertools

import pytest
import torch
from torch import nn

from ca_reg import CAMonitor, CAScore, Chain, Draw, GaussianDropout, IndependentDropout, Params, Regularizer
from ca_reg.lists import ListMoments, PixelLists
from ca_reg.regularizers import parse
from ca_reg.regularizers.noise import ScaleNoise
from ca_reg.schedules import LinearRamp

OPACITY = torch.tensor([0.7, 0.5, 0.9], dtype=torch.float64)
MEANS = torch.tensor([[0.0, 0, 1], [0, 0, 2], [0, 0, 3]], dtype=torch.float64)
COLORS = torch.eye(3, dtype=torch.float64)


class ByDepth(IndependentDropout):
    needs = ("means",)

    def rates(self, x):
        return 0.2 * x.means[:, 2]


class Pair(Regularizer):
    """Drops the first two together, half of the time."""

    def draw(self, x, generator=None):
        keep = (
            torch.tensor([True] * 3) if torch.rand(1, generator=generator) < 0.5 else torch.tensor([False, False, True])
        )
        return Draw(keep, keep)

    def replay(self, x, draw):
        return x._replace(opacities=x.opacities * draw.keep)


def render(opacity, view):
    """One pixel: three splats in front of black."""
    o = opacity.reshape(-1)
    weights = o * torch.cat([torch.ones(1, dtype=o.dtype), torch.cumprod(1 - o, 0)[:-1]])
    return (weights @ COLORS).view(3, 1, 1), weights.sum().view(1, 1)


def lists(opacity, view):
    return PixelLists(torch.arange(3), torch.zeros(3, dtype=torch.int64), opacity.reshape(-1), COLORS, 1, 1)


def variance_over(masks, probabilities):
    images = torch.stack([render(OPACITY * mask, None)[0] for mask in masks])
    weights = torch.tensor(probabilities, dtype=torch.float64).view(-1, 1, 1, 1)
    mean = (weights * images).sum(0)
    return (weights * (images - mean) ** 2).sum(0).mean().item()


@pytest.mark.parametrize("shape", [(3,), (3, 1)])
def test_an_exact_score_has_the_rates_of_the_regularizer(shape):
    rates = ByDepth().rates(Params(OPACITY, means=MEANS))
    masks = [torch.tensor(m) for m in itertools.product([False, True], repeat=3)]
    probabilities = [torch.where(m, 1 - rates, rates).prod().item() for m in masks]
    score = CAScore.exact(ListMoments(lists), regularizer=ByDepth(), threshold=0.1)
    result = score(Params(OPACITY.reshape(shape), means=MEANS), None)
    assert result.value == pytest.approx(variance_over(masks, probabilities), rel=1e-12)
    assert (result.drop_rate, result.regularizer) == (None, "ByDepth(compensate=False, scale=True)")


def test_sampled_scores_draw_what_the_regularizer_draws():
    score = CAScore(render, regularizer=Pair(), samples=2000, threshold=0.1, ddof=1)
    exact = variance_over([torch.tensor([True] * 3), torch.tensor([False, False, True])], [0.5, 0.5])
    result = score(OPACITY, None)
    # The variance of a fair coin from 2000 throws: relative error below 1/2000 plus 4 (mean - 1/2)^2, five standard
    # deviations of which are 1.3 %. False alarm below 1e-6, and the seed is fixed.
    assert result.value == pytest.approx(exact, rel=0.015)
    independent = CAScore.exact(ListMoments(lists), drop_rate=0.5, threshold=0.1)(OPACITY, None).value
    assert abs(result.value - independent) > 0.05 * independent  # the neighbors' company shows


@pytest.mark.parametrize("given", [OPACITY, Params(OPACITY), Params(OPACITY[:, None])])
def test_a_score_is_taken_at_the_step_of_the_regularizer(given):
    dropout = GaussianDropout(LinearRamp(0.0, 0.5, 0, 100))
    dropout.set_step(50)
    expected = CAScore.exact(ListMoments(lists), drop_rate=0.25, threshold=0.1)(OPACITY, None).value
    score = CAScore.exact(ListMoments(lists), regularizer=dropout, threshold=0.1)
    assert score(given, None).value == expected
    assert score(Params(OPACITY, step=1), None).value < expected  # a step that is given counts


def test_a_monitor_takes_what_its_score_takes(tmp_path):
    score = CAScore.exact(ListMoments(lists), regularizer=ByDepth(), threshold=0.1)
    x = Params(OPACITY.clone().requires_grad_(), means=MEANS)

    def psnr(opacity, view):
        torch.testing.assert_close(opacity, OPACITY)  # not scaled: p does not apply
        return 30.0

    with CAMonitor(score, tmp_path, views={"test": [None]}, every=1, psnr=psnr) as monitor:
        record = monitor(1, x)
        assert (record["ca/test"], record["psnr/test"], record["gaussians"]) == (score(x, None).value, 30.0, 3)
        with pytest.raises(ValueError, match=r"ByDepth needs means.*Params\("):
            monitor(2, OPACITY)


def test_a_score_does_not_ask_for_the_mode_of_the_regularizer():
    values = {
        CAScore(render, regularizer=rule, threshold=0.1, seed=1)(OPACITY, None).value
        for rule in (GaussianDropout(0.5), Chain(GaussianDropout(0.5)), Chain(GaussianDropout(0.5)).eval())
    }
    assert len(values) == 1
    assert values.pop() > 0


def test_what_a_score_cannot_render_is_refused():
    with pytest.raises(TypeError, match=r"ca_reg\.Regularizer, got Dropout: .*ca_reg\.Chain"):
        CAScore(render, regularizer=nn.Dropout(0.5))
    score = CAScore(render, regularizer=Chain(nn.Dropout(0.5)))
    with pytest.raises(TypeError, match=r"Dropout .*argument generator.*generator=None"):
        score(OPACITY, None)
    score = CAScore(render, regularizer=Chain(GaussianDropout(0.5), ScaleNoise(0.5)), threshold=0.1)
    with pytest.raises(ValueError, match="Chain changes other"):
        score(Params(OPACITY, scales=torch.ones(3, 3)), None)
    for rates in ({"p": torch.tensor([0.1, 0.2, 0.3])}, {"drop_rate": torch.tensor([0.1, 0.2, 0.3])}):
        with pytest.raises(TypeError, match=f"{next(iter(rates))} .*number, got Tensor"):
            CAScore(render, **rates)


def test_an_adaptive_score_takes_the_region_of_the_expected_image():
    score = CAScore.adaptive(render, regularizer=ByDepth(), relative_error=0.2, threshold=0.1)
    result = score(Params(OPACITY, means=MEANS), None)
    exact = CAScore.exact(ListMoments(lists), regularizer=ByDepth(), threshold=0.1)(Params(OPACITY, means=MEANS), None)
    assert abs(result.value - exact.value) < 5 * result.std_error + 0.6 * exact.value  # a single pixel: docs/studies.md


def test_the_protocol_is_the_score_of_uniform_dropout():
    plain = CAScore(render, drop_rate=0.6, threshold=-1.0, samples=7)(OPACITY, None)
    same = CAScore(render, regularizer=GaussianDropout(0.6), threshold=-1.0, samples=7)(OPACITY, None)
    assert plain.value == same.value


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (CAScore, {"regularizer": ByDepth(), "p": 0.2}, "draws of a regularizer"),
        (CAScore, {"regularizer": ByDepth(), "drop_rate": 0.5}, "do not apply"),
        (CAScore, {"regularizer": ByDepth()}, r"ByDepth needs means .* Params\(opacities, means"),
        (CAScore.adaptive, {"regularizer": Pair(), "relative_error": 0.1}, r"sample with CAScore\(render_fn\)"),
    ],
)
def test_what_does_not_go_together_is_refused(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(render, **arguments)(OPACITY, None)


@pytest.mark.parametrize("text", ["density", "geometry", "d2gs", "d2gs(literal=True)"])
def test_a_score_measures_the_model_that_it_is_given_whatever_it_has_scored_before(text):
    """Of as many Gaussians and a few steps earlier, which a training would not measure again."""

    def moments(opacity, view, multiplier, background):
        variance = (multiplier.variance * torch.arange(50)).mean().expand(3, 4, 4)
        return {"mean": variance, "variance": variance / 100, "alpha_mean": torch.ones(4, 4)}

    generator = torch.Generator().manual_seed(0)
    models = [Params(torch.ones(50), torch.randn(50, 3, generator=generator), view_matrix=torch.eye(4), step=step)
              for step in (1000, 1010)]  # fmt: skip
    scores = [CAScore.exact(moments, regularizer=parse(text)) for _ in range(2)]
    values = [scores[0](model, None).value for model in models]
    assert values[1] == scores[1](models[1], None).value != values[0]


@pytest.mark.parametrize(
    "text", ["density", "geometry", "clustered(0.4)", "drop_anchors(0.1)", "dropout(0.3) + density"]
)
@pytest.mark.parametrize("kind", [CAScore, CAScore.exact], ids=["sampled", "exact"])
def test_a_score_with_the_regularizer_of_a_training_does_not_change_its_masks(text, kind):
    """Nor does it read what training measured: the means have moved since."""

    def renderer(opacity, view, *moments):
        image = opacity[:48].reshape(3, 4, 4)
        return {"mean": image, "variance": 0 * image, "alpha_mean": image[0]} if moments else (image, image[0])

    def masks(scores):
        rule, generator = parse(text), torch.Generator().manual_seed(0)
        score, found = kind(renderer, regularizer=rule, threshold=0.0), []
        means = torch.rand(60, 3, generator=generator)
        for step in range(600, 610):
            means = means + 0.2 * torch.randn(60, 3, generator=generator)
            x = Params(torch.full((60,), 0.9), means=means, step=step)
            found.append(rule(x, generator=generator).opacities)
            if scores:
                with contextlib.suppress(ValueError):  # not all have independent factors, for an exact score
                    score(Params(x.opacities, means=means), None)
        return torch.stack(found)

    plain = masks(scores=False)
    assert (plain == 0).any()
    assert torch.equal(masks(scores=True), plain)
