"""Exact scores and adaptive sampling, against the enumeration of all masks through the real renderer."""

import itertools
import json
import math
from functools import cached_property

import numpy as np
import pytest
import torch
from oracles import random_scene

from ca_reg import CAMonitor, CAScore, Reason
from ca_reg.result import summarize
from ca_reg.types import read_moments
from reference_trainer.render import render, splat
from reference_trainer.render.renderer import render_moments

BACKGROUND = torch.tensor([0.9, 0.1, 0.4], dtype=torch.float64)
THRESHOLD = 0.35  # of alpha: a part of the picture
RATES = [0.3, 0.5]
BITS = list(itertools.product([False, True], repeat=3))


class Model:
    """Gaussians of moderate opacity; up to eight are faint enough that no pixel ends early: 0.4^8 is above 1e-4."""

    def __init__(self, n, seed, width=13, height=9, size=0.35):
        self.scene = random_scene(n, width, height, seed, size=size)
        self.opacity = 0.1 + 0.5 * self.scene.opacities

    def render(self, opacity, view, background=BACKGROUND):
        scene = self.scene
        out = render(*scene[:3], opacity, scene.camera, colors=scene.colors, background=background)
        return out.image, out.alpha

    def moments(self, opacity, view, multiplier, background):
        splats = splat(*self.scene[:3], opacity, self.scene.camera, colors=self.scene.colors)
        return render_moments(splats, multiplier, background=BACKGROUND if background is None else background)

    @cached_property
    def all_renders(self):
        """Number of Gaussians kept, colors over black and alpha of every mask."""
        masks = torch.tensor(list(itertools.product([0.0, 1.0], repeat=len(self.opacity))), dtype=torch.float64)
        renders = [self.render(self.opacity * mask, None, torch.zeros(3, dtype=torch.float64)) for mask in masks]
        return masks.sum(1), torch.stack([x[0] for x in renders]), torch.stack([x[1] for x in renders])

    def enumerate(self, rate, neutral=False):
        """Variance map, mean alpha and score: sums over all masks, weighted by their probability."""
        kept, colors, alphas = self.all_renders
        probability = (1 - rate) ** kept * rate ** (len(self.opacity) - kept)
        alpha = torch.einsum("k,khw->hw", probability, alphas)
        behind = BACKGROUND[:, None, None]
        if neutral:
            behind = torch.einsum("k,kchw->chw", probability, colors) / alpha.clamp(min=1e-300)
        images = colors + (1 - alphas[:, None]) * behind
        mean = torch.einsum("k,kchw->chw", probability, images)
        variance = torch.einsum("k,kchw->chw", probability, (images - mean) ** 2).mean(0)
        return variance, alpha, variance[alpha > THRESHOLD].mean().item()


FEW = [Model(8, 3), Model(6, 17)]
MANY = Model(60, 5, size=0.12)


def rgb(image):
    return {"HWC": image.permute(1, 2, 0), "CHW": image}


# --- exact ---


@pytest.mark.parametrize("model", FEW, ids=["8", "6"])
@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize("rate", RATES)
def test_exact_equals_the_enumeration_of_all_masks(model, neutral, rate):
    score = CAScore.exact(model.moments, neutral=neutral, drop_rate=rate, threshold=THRESHOLD)
    result = score(model.opacity, None)
    variance, alpha, value = model.enumerate(rate, neutral)
    assert 10 < (alpha > THRESHOLD).sum() < alpha.numel() - 10
    torch.testing.assert_close(result.variance, variance, rtol=1e-10, atol=1e-15)
    assert torch.equal(result.visible, alpha > THRESHOLD)
    assert result.value == pytest.approx(value, rel=1e-10)
    assert result.std_error == 0.0
    assert result.reason is Reason.OK


@pytest.mark.parametrize("p", [0.0, 0.2])
def test_exact_drops_what_the_protocol_drops(p):
    score = CAScore.exact(FEW[0].moments, p=p, threshold=THRESHOLD)
    assert score(FEW[0].opacity, None).value == pytest.approx(FEW[0].enumerate(1 - (1 - p) / 2)[2], rel=1e-10)


def test_neutral_does_not_see_the_background_and_exact_does():
    def over(background):
        def moments(opacity, view, multiplier, behind):
            return MANY.moments(opacity, view, multiplier, background if behind is None else behind)

        return moments

    values = {
        neutral: [
            CAScore.exact(over(b), neutral=neutral, threshold=THRESHOLD)(MANY.opacity, None).value
            for b in (BACKGROUND, 1 - BACKGROUND)
        ]
        for neutral in (False, True)
    }
    assert values[True][0] == values[True][1]
    assert values[False][0] != pytest.approx(values[False][1], rel=0.01)


def test_neutral_is_zero_where_all_gaussians_agree():
    model = Model(20, 1)
    model.scene.colors[:] = BACKGROUND.flip(0)
    plain, neutral = (
        CAScore.exact(model.moments, neutral=n, threshold=THRESHOLD)(model.opacity, None) for n in (False, True)
    )
    assert plain.value > 1e-3
    assert neutral.value < 1e-30
    assert neutral.variance.max() < 1e-30  # also where next to nothing covers the pixel


def test_exact_says_what_it_is_and_what_does_not_apply():
    model = FEW[0]
    for neutral, method in ((False, "exact"), (True, "exact_neutral")):
        result = CAScore.exact(model.moments, neutral=neutral, threshold=THRESHOLD)(model.opacity, None)
        data = json.loads(json.dumps(result.as_dict()))
        assert data["method"] == result.method == method
        assert data["std_error"] == 0.0
        assert [data[name] for name in ("samples", "ddof", "seed", "relative_error", "max_samples")] == [None] * 5
        assert data["drop_rate"] == 0.5
        assert (result.expected_fraction, result.limit) == (1.0, (result.value, 0.0))


@pytest.mark.parametrize("layout", ["CHW", "HWC"])
@pytest.mark.parametrize("neutral", [False, True])
def test_exact_takes_both_layouts_mappings_and_numpy(layout, neutral):
    model = FEW[0]

    def moments(opacity, view, multiplier, background):
        if layout == "HWC" and background is not None and background.ndim == 3:
            background = background.permute(2, 0, 1)
        found = model.moments(opacity, view, multiplier, background)
        mean, variance = (rgb(x)[layout].numpy() for x in (found.mean, found.variance))
        return {"mean": mean, "variance": variance, "alpha_mean": found.alpha_mean[None].numpy()}

    result = CAScore.exact(moments, layout=layout, neutral=neutral, threshold=THRESHOLD)(model.opacity, None)
    assert result.value == pytest.approx(model.enumerate(0.5, neutral)[2], rel=1e-10)


def test_exact_needs_no_gradient_and_keeps_the_shape_of_the_opacities():
    model, shapes = FEW[0], []

    def moments(opacity, view, multiplier, background):
        assert not torch.is_grad_enabled()
        assert not opacity.requires_grad
        shapes.append(opacity.shape)
        return model.moments(opacity, view, multiplier, background)

    CAScore.exact(moments)(model.opacity[:, None].clone().requires_grad_(), None)
    assert shapes == [(8, 1)]


def test_exact_without_visible_pixels_or_with_broken_colors_is_a_reason():
    model = FEW[0]
    empty = CAScore.exact(model.moments, threshold=1.0)(model.opacity, None)
    assert empty.reason is Reason.EMPTY
    assert math.isnan(empty.value)
    assert math.isnan(empty.std_error)

    def broken(*arguments):
        found = model.moments(*arguments)
        return found._replace(variance=found.variance * math.nan)

    assert CAScore.exact(broken, threshold=THRESHOLD)(model.opacity, None).reason is Reason.NOT_FINITE


def test_what_is_not_moments_is_refused():
    image = torch.rand(3, 4, 5)
    with pytest.raises(TypeError, match="without variance"):
        read_moments({"mean": image})
    without_alpha = {"mean": image, "variance": image}
    assert read_moments(without_alpha).alpha_mean is None
    with pytest.raises(TypeError, match="a score needs alpha_mean"):
        CAScore.exact(lambda *arguments: without_alpha)(torch.rand(2), None)
    with pytest.raises(TypeError, match="without mean"):
        read_moments((image, image, image[0]))  # which is which cannot be told
    with pytest.raises(ValueError, match="one shape"):
        read_moments({"mean": image, "variance": image[:, 1:], "alpha_mean": image[0]})
    with pytest.raises(ValueError, match="alpha"):
        read_moments({"mean": image, "variance": image, "alpha_mean": image})


# --- many views ---


@pytest.mark.parametrize("neutral", [False, True])
def test_mean_over_views_of_exact_scores(neutral):
    def moments(opacity, view, *rest):
        return view.moments(opacity[: len(view.opacity)], None, *rest)

    score = CAScore.exact(moments, neutral=neutral, threshold=THRESHOLD)
    opacity = torch.full((8,), 0.5, dtype=torch.float64)
    results = [score.update(opacity, model) for model in FEW]
    summary = score.compute()
    assert summary == summarize(results)
    assert summary.value == pytest.approx((results[0].value + results[1].value) / 2)
    assert (summary.std_error, summary.samples, summary.method) == (0.0, None, results[0].method)


def test_methods_are_not_averaged_with_one_another():
    model = FEW[0]
    scores = [
        CAScore(model.render, threshold=THRESHOLD),
        CAScore.adaptive(model.render, relative_error=0.5, threshold=THRESHOLD),
        CAScore.exact(model.moments, threshold=THRESHOLD),
        CAScore.exact(model.moments, neutral=True, threshold=THRESHOLD),
    ]
    for pair in itertools.combinations([score(model.opacity, None) for score in scores], 2):
        with pytest.raises(ValueError, match=r"one set .*got 2"):
            summarize(pair)


def test_adaptive_views_are_averaged_though_they_took_different_numbers_of_renders():
    score = CAScore.adaptive(MANY.render, relative_error=0.08, threshold=THRESHOLD)
    results = [score.update(MANY.opacity, None) for _ in range(6)]
    assert len({result.samples for result in results}) > 1
    assert summarize(results) == score.compute()
    assert (score.compute().samples, score.compute().method, score.compute().max_samples) == (None, "adaptive", 256)


def test_a_monitor_logs_exact_scores(tmp_path):
    score = CAScore.exact(FEW[0].moments, threshold=THRESHOLD)
    with CAMonitor(score, tmp_path, views={"test": [None]}, every=1) as monitor:
        monitor(1, FEW[0].opacity)
    (line,) = (json.loads(x) for x in (tmp_path / "ca.jsonl").read_text().splitlines())
    assert line["ca/test"] == pytest.approx(FEW[0].enumerate(0.5)[2], rel=1e-10)
    assert (line["method"], line["samples"]) == ("exact", None)


# --- adaptive ---


class Recorder:
    """The renderer, with a record of what it was given and what it returned."""

    def __init__(self, model):
        self.model, self.opacities, self.images, self.alphas = model, [], [], []

    def __call__(self, opacity, view):
        image, alpha = self.model.render(opacity, view)
        self.opacities.append(opacity.clone())
        self.images.append(image.numpy())
        self.alphas.append(alpha.numpy())
        return image, alpha


def test_more_renders_continue_the_masks_of_fewer():
    runs = [Recorder(MANY) for _ in range(3)]
    CAScore(runs[0])(MANY.opacity, None, index=4)
    CAScore(runs[1], samples=40)(MANY.opacity, None, index=4)
    CAScore.adaptive(runs[2], relative_error=1e-9, max_samples=40, threshold=THRESHOLD)(MANY.opacity, None, index=4)
    masks = [torch.stack(run.opacities) for run in runs]
    assert torch.equal(masks[0], masks[2][1:6])
    assert torch.equal(masks[2][0], 0.5 * MANY.opacity)  # the expected render comes first
    assert torch.equal(masks[1], masks[2][1:])


@pytest.mark.parametrize("target", [0.3, 0.08, 0.05])
def test_adaptive_stops_at_the_first_round_with_the_error_asked_for(target):
    recorder = Recorder(MANY)
    result = CAScore.adaptive(recorder, relative_error=target, threshold=THRESHOLD)(MANY.opacity, None)
    assert result.samples == len(recorder.images) - 1  # the first is the expected render
    assert result.samples % 8 == 0
    assert (result.samples == 16) == (target == 0.3)
    assert result.std_error <= target * result.value
    for fewer in range(16, result.samples, 8):
        before = CAScore.adaptive(MANY.render, relative_error=1e-9, max_samples=fewer, threshold=THRESHOLD)
        earlier = before(MANY.opacity, None)
        assert earlier.samples == fewer
        assert earlier.std_error > target * earlier.value


def test_adaptive_value_and_error_in_plain_numpy():
    recorder = Recorder(MANY)
    result = CAScore.adaptive(recorder, relative_error=0.2, threshold=THRESHOLD)(MANY.opacity, None)
    torch.testing.assert_close(recorder.opacities[0], 0.5 * MANY.opacity)
    region = recorder.alphas[0] > THRESHOLD  # of the expected render: no draw decides which pixels count
    images = np.stack(recorder.images[1:])
    variance = images.var(axis=0, ddof=1).mean(axis=0)
    assert 0 < region.sum() < region.size
    np.testing.assert_array_equal(result.visible.numpy(), region)
    np.testing.assert_allclose(result.variance.numpy(), variance, rtol=1e-10)
    assert result.value == pytest.approx(variance[region].mean(), rel=1e-12)
    assert result.expected_fraction == 1.0

    count = len(images)
    deviations = (images - recorder.images[0])[:, :, region].reshape(count, -1)
    squares = (deviations**2).mean(1)
    pairs = (deviations[1:] * deviations[:-1]).mean(1)
    expected = math.sqrt(squares.var(ddof=1) / count + 2 * (pairs**2).mean() / (count * (count - 1)))
    assert result.std_error == pytest.approx(expected, rel=1e-10)


def test_adaptive_gives_up_at_the_largest_number_and_says_how_far_it_came():
    result = CAScore.adaptive(MANY.render, relative_error=1e-6, max_samples=21, threshold=THRESHOLD)(MANY.opacity, None)
    assert result.samples == 21
    assert result.std_error > 1e-6 * result.value
    assert result.reason is Reason.OK


def test_adaptive_stops_at_once_where_there_is_nothing_to_refine():
    empty = CAScore.adaptive(MANY.render, relative_error=0.1, threshold=1.0)(MANY.opacity, None)
    assert (empty.samples, empty.reason) == (16, Reason.EMPTY)
    still = CAScore.adaptive(MANY.render, relative_error=0.1, threshold=THRESHOLD, drop_rate=0.0)(MANY.opacity, None)
    assert (still.samples, still.value, still.std_error) == (16, 0.0, 0.0)


def test_adaptive_approaches_the_exact_score_which_the_fixed_region_does_not():
    exact = CAScore.exact(MANY.moments, threshold=THRESHOLD)(MANY.opacity, None)
    adaptive = CAScore.adaptive(MANY.render, relative_error=0.04, threshold=THRESHOLD)(MANY.opacity, None)
    # 5 standard errors, themselves known to 27 %: false alarm below 1e-3, and the seed is fixed.
    assert abs(adaptive.value - exact.value) < 5 * adaptive.std_error
    assert (adaptive.visible != exact.visible).double().mean() < 0.1
    fixed = CAScore(MANY.render, samples=adaptive.samples, threshold=THRESHOLD)(MANY.opacity, None)
    assert fixed.visible.sum() < 0.8 * exact.visible.sum()


def test_renders_of_different_sizes_are_refused():
    sizes = iter(range(4, 100))

    def render_fn(opacity, view):
        size = next(sizes)
        return torch.rand(3, size, 4), torch.ones(size, 4)

    with pytest.raises(ValueError, match="one size"):
        CAScore.adaptive(render_fn, relative_error=0.1)(torch.ones(3), None)


# --- how far a few renders are from the limit ---


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "ddof"), [(2, 0), (2, 1), (3, 0), (3, 2)])
def test_limit_is_the_exact_score_in_expectation(monkeypatch, samples, ddof):
    """Every tuple of masks once, each as likely as any other at rate 1/2: the mean is the expectation, exactly."""
    model = Model(3, 2, width=5, height=4)
    renders = {mask: model.render(model.opacity * torch.tensor(mask), None) for mask in BITS}

    def render_fn(opacity, view):
        return renders[tuple((opacity > 0).tolist())]

    score = CAScore(render_fn, samples=samples, ddof=ddof, threshold=-1.0)
    found = []
    for draws in itertools.product(BITS, repeat=samples):
        order = map(torch.tensor, draws)
        monkeypatch.setattr("ca_reg.functional.draw_keep_mask", lambda *args, order=order, **kwargs: next(order))
        found.append(score(model.opacity, None))
    exact = CAScore.exact(model.moments, threshold=-1.0)(model.opacity, None).value
    assert np.mean([result.limit.value for result in found]) == pytest.approx(exact, rel=1e-12)
    assert np.mean([result.value for result in found]) == pytest.approx(exact * found[0].expected_fraction, rel=1e-12)


def test_the_paper_s_protocol_finds_four_fifths():
    result = CAScore(MANY.render, threshold=THRESHOLD)(MANY.opacity, None)
    assert result.expected_fraction == 0.8
    unbiased = CAScore(MANY.render, threshold=THRESHOLD, ddof=1)(MANY.opacity, None)
    assert result.limit == pytest.approx((unbiased.value, unbiased.std_error), rel=1e-12)
    assert summarize([result]).expected_fraction == 0.8


# --- what does not go together ---


@pytest.mark.parametrize(
    ("make", "arguments", "error", "message"),
    [
        (CAScore, {"render_fn": None}, TypeError, "render_fn must be callable"),
        (CAScore, {"render_fn": MANY.render, "neutral": True}, TypeError, "neutral"),
        (CAScore, {"render_fn": MANY.render, "max_samples": 70}, TypeError, "max_samples"),
        (CAScore, {"render_fn": MANY.render, "samples": 3, "ddof": 3}, ValueError, "ddof .*below samples"),
        (CAScore, {"render_fn": MANY.render, "samples": 1}, ValueError, "samples .*at least 2"),
        (CAScore.exact, {"moments_fn": True}, TypeError, "moments_fn must be callable"),
        (CAScore.exact, {"moments_fn": MANY.moments, "samples": 5}, TypeError, "samples"),
        (CAScore.exact, {"moments_fn": MANY.moments, "drop_rate": 1.0}, ValueError, "drop_rate"),
        (CAScore.adaptive, {"render_fn": MANY.render}, TypeError, "relative_error"),
        (CAScore.adaptive, {"render_fn": MANY.render, "relative_error": 0.1, "ddof": 0}, TypeError, "ddof"),
        (CAScore.adaptive, {"render_fn": MANY.render, "relative_error": 0.0}, ValueError, "relative_error must be abo"),
        (CAScore.adaptive, {"render_fn": MANY.render, "relative_error": 0.1, "max_samples": 15}, ValueError, "16"),
    ],
)  # fmt: skip
def test_arguments_that_do_not_apply_are_refused(make, arguments, error, message):
    with pytest.raises(error, match=message):
        make(**arguments)
