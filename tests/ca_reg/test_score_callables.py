"""Renderers that are less tidy than a function: they reuse buffers, edit what they are given, and return NaN."""

import json
import math
from functools import partial

import numpy as np
import pytest
import torch

from ca_reg import CAMonitor, CAScore, Reason, attribute, error_map
from ca_reg.attribution import total_effects
from ca_reg.functional import Multiplier, alpha_moments, contributions, pixel_moments

N, HEIGHT, WIDTH = 7, 3, 4
G = torch.Generator().manual_seed(0)
FOOTPRINT = torch.rand(HEIGHT * WIDTH, N, generator=G, dtype=torch.float64)
COLORS = torch.rand(N, 3, generator=G, dtype=torch.float64)
OPACITY = 0.2 + 0.7 * torch.rand(N, generator=G, dtype=torch.float64)
SETTINGS = {"threshold": 0.3}
METHODS = {"sampling": CAScore, "adaptive": partial(CAScore.adaptive, relative_error=0.2)}
each_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def images(x):
    """(P, C) as (C, H, W)."""
    return x.T.reshape(-1, HEIGHT, WIDTH)


def blend(opacity, values):
    alphas = FOOTPRINT * opacity.flatten()
    weights = alphas * torch.cumprod(torch.nn.functional.pad(1 - alphas[:, :-1], (1, 0), value=1.0), 1)
    return images(weights @ values)


def render(opacity, view):
    return blend(opacity, COLORS), blend(opacity, torch.ones_like(COLORS))[0]


def moments(opacity, view, multiplier, background):
    behind = COLORS.new_zeros(3) if background is None else background
    behind = behind if behind.ndim == 1 else behind.flatten(1).T
    found = pixel_moments(FOOTPRINT * opacity, COLORS.expand(HEIGHT * WIDTH, N, 3), multiplier, background=behind)
    alpha = alpha_moments(FOOTPRINT * opacity, multiplier).mean
    return {"mean": images(found.mean), "variance": images(found.variance), "alpha_mean": alpha.view(HEIGHT, WIDTH)}


def shares(opacity, view, multiplier, background, weights):
    parts = contributions(FOOTPRINT * opacity, COLORS.expand(HEIGHT * WIDTH, N, 3), multiplier)
    return (parts.mean(-1) * weights.reshape(-1, 1)).sum(0)


def same(found, expected):
    assert expected.reason is Reason.OK
    assert torch.equal(found.variance, expected.variance)
    assert torch.equal(found.visible, expected.visible)
    assert (found.value, found.std_error) == (expected.value, expected.std_error)


# --- one output buffer for all calls ---


def into(*buffers):
    """Write results where the former ones stood, and return the buffers."""

    def write(*results):
        for buffer, result in zip(buffers, results, strict=True):
            buffer.copy_(result)
        return buffers if len(buffers) > 1 else buffers[0]

    return write


@each_method
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_reused_output_buffer_changes_nothing(method, dtype):
    write = into(torch.empty(3, HEIGHT, WIDTH, dtype=dtype), torch.empty(HEIGHT, WIDTH, dtype=dtype))

    def fresh(opacity, view):
        return tuple(x.to(dtype) for x in render(opacity, view))

    expected = method(fresh, **SETTINGS)(OPACITY, None)
    same(method(lambda o, v: write(*render(o, v)), **SETTINGS)(OPACITY, None), expected)


@each_method
@pytest.mark.parametrize("numpy", [False, True])
def test_an_alpha_pass_may_fill_the_buffer_of_the_image(method, numpy):
    write = into(torch.empty(3, HEIGHT, WIDTH, dtype=torch.float64))

    def rendered(values):
        return lambda opacity, view: (lambda x: x.numpy() if numpy else x)(write(blend(opacity, values)))

    score = method(rendered(COLORS), alpha_fn=rendered(torch.ones_like(COLORS)), **SETTINGS)
    same(score(OPACITY, None), method(render, **SETTINGS)(OPACITY, None))


@pytest.mark.parametrize("neutral", [False, True])
def test_moments_may_fill_the_same_buffers(neutral):
    write = into(*(torch.empty_like(x) for x in moments(OPACITY, None, Multiplier.dropout(0.5), None).values()))

    def reusing(*arguments):
        return dict(zip(("mean", "variance", "alpha_mean"), write(*moments(*arguments).values()), strict=True))

    expected = CAScore.exact(moments, neutral=neutral, **SETTINGS)(OPACITY, None)
    same(CAScore.exact(reusing, neutral=neutral, **SETTINGS)(OPACITY, None), expected)


# --- callables that edit their opacities in place ---


def spoiling(fn):
    def edits(opacity, *rest):
        result = fn(opacity, *rest)
        opacity.zero_()
        return result

    return edits


def white(opacity, view):
    return blend(opacity, torch.ones_like(COLORS))


@pytest.mark.parametrize("drop_rate", [0.0, 0.5])
@pytest.mark.parametrize(
    "make",
    [
        lambda f, **a: CAScore(f(render), **a),
        lambda f, **a: CAScore(f(render), alpha_fn=f(white), **a),
        lambda f, **a: CAScore.adaptive(f(render), relative_error=0.2, **a),
        lambda f, **a: CAScore.adaptive(f(render), alpha_fn=f(white), relative_error=0.2, **a),
        lambda f, **a: CAScore.exact(f(moments), **a),
        lambda f, **a: CAScore.exact(f(moments), neutral=True, **a),
    ],
    ids=["sampling", "sampling, alpha_fn", "adaptive", "adaptive, alpha_fn", "exact", "neutral"],
)
def test_a_callable_that_edits_its_opacities_reaches_nobody_else_s(make, drop_rate):
    opacity = OPACITY.clone()
    found = make(spoiling, drop_rate=drop_rate, **SETTINGS)(opacity, None)
    assert torch.equal(opacity, OPACITY)
    same(found, make(lambda f: f, drop_rate=drop_rate, **SETTINGS)(OPACITY, None))


def test_attribution_monitor_and_error_map_keep_the_opacities_too(tmp_path):
    opacity = OPACITY.clone()
    score = CAScore.exact(moments, **SETTINGS)
    assert torch.equal(attribute(score, spoiling(shares), opacity, None)[0], attribute(score, shares, OPACITY, None)[0])
    score = CAScore.exact(spoiling(moments), **SETTINGS)
    total_effects(score, opacity, None)
    with CAMonitor(
        score, tmp_path, views={"all": [0, 1]}, every=1, psnr=spoiling(lambda o, v: o.sum().item())
    ) as monitor:
        assert monitor(1, opacity)["psnr/all"] == pytest.approx(OPACITY.sum().item())
    assert error_map(spoiling(render), opacity, None, moments_fn=spoiling(moments)).psnr == pytest.approx(
        error_map(render, OPACITY, None, moments_fn=moments).psnr
    )
    assert torch.equal(opacity, OPACITY)


# --- NaN ---


def with_nan(where, colors, alpha):
    def fn(opacity, view):
        image, plane = (x.clone() for x in render(opacity, view))
        if colors:
            image[:, where] = math.nan
        if alpha:
            plane[where] = math.nan
        return image, plane

    return fn


ALL, HALF, ONE = torch.ones(3, 4, dtype=torch.bool), torch.arange(12).view(3, 4) < 6, torch.arange(12).view(3, 4) == 5


@each_method
@pytest.mark.parametrize("where", [ALL, HALF, ONE], ids=["all", "half", "one pixel"])
@pytest.mark.parametrize(("colors", "alpha"), [(True, True), (True, False), (False, True)])
def test_nan_in_a_render_is_not_finite(method, where, colors, alpha):
    result = method(with_nan(where, colors, alpha), threshold=0.0)(OPACITY, None)
    assert result.reason is Reason.NOT_FINITE
    assert math.isnan(result.value)
    assert math.isnan(result.std_error)


@each_method
def test_nan_in_a_single_render_is_not_finite(method):
    calls = []

    def fn(opacity, view):
        calls.append(None)
        return with_nan(ONE, False, len(calls) == 3)(opacity, view)

    assert method(fn, **SETTINGS)(OPACITY, None).reason is Reason.NOT_FINITE


@each_method
def test_nan_where_nothing_is_covered_does_not_count(method):
    """Renderers that divide colors by alpha return 0 / 0 there."""

    def fn(opacity, view):
        image, alpha = render(opacity, view)
        image[:, ONE], alpha[ONE] = math.nan, 0.0
        return image, alpha

    assert method(fn, threshold=0.2)(OPACITY, None).reason is Reason.OK
    nothing = method(lambda o, v: (torch.full((3, 4, 4), math.nan), torch.zeros(4, 4)))
    assert nothing(OPACITY, None).reason is Reason.NOT_FINITE  # not one color is finite


@pytest.mark.parametrize("name", ["mean", "variance", "alpha_mean"])
@pytest.mark.parametrize("where", [ALL, HALF, ONE], ids=["all", "half", "one pixel"])
@pytest.mark.parametrize("neutral", [False, True])
def test_nan_in_exact_moments_is_not_finite(name, where, neutral):
    def fn(*arguments):
        found = moments(*arguments)
        found[name][..., where] = math.nan
        return found

    result = CAScore.exact(fn, neutral=neutral, threshold=0.0)(OPACITY, None)
    assert (result.reason, math.isnan(result.value)) == (Reason.NOT_FINITE, True)


# --- what an empty region and rare drops are to adaptive scores ---


@pytest.mark.parametrize("make", [CAScore, partial(CAScore.adaptive, relative_error=0.1)])
def test_a_batch_of_another_length_is_refused(make):
    class OneForAll:
        def __call__(self, opacity, view):
            return torch.rand(3, 4, 5), torch.ones(4, 5)

        def render_batch(self, opacities, view):
            return torch.rand(1, 3, 4, 5), torch.ones(1, 4, 5)

    with pytest.raises(ValueError, match=r"\d sets .*got 1"):
        make(OneForAll())(torch.full((9,), 0.5), None)


def test_an_empty_region_is_empty_whatever_the_masks():
    """Expected alpha 0.72 everywhere, which a good part of the renders exceeds: they must not make a region."""

    def fn(opacity, view):
        light = torch.cumprod(1 - opacity, 0)
        weights = opacity * torch.cat([torch.ones(1), light[:-1]])
        return (weights * torch.linspace(0, 1, 8)).sum().expand(3, 2, 2), (1 - light[-1]).expand(2, 2)

    opacity = torch.full((8,), 2 * (1 - 0.28 ** (1 / 8)))
    for seed in range(10):
        result = CAScore.adaptive(fn, relative_error=0.1, threshold=0.8, seed=seed)(opacity, None)
        assert (result.reason, result.visible.any().item()) == (Reason.EMPTY, False)
    assert CAScore.adaptive(fn, relative_error=0.1, threshold=0.7)(opacity, None).reason is Reason.OK


def test_renders_that_do_not_differ_are_not_taken_for_certainty():
    """Where hardly anything is dropped, the first renders are often all the same."""

    def fn(opacity, view):
        return (opacity * torch.linspace(0, 1, 20)).mean().expand(3, 2, 2), torch.ones(2, 2)

    results = [
        CAScore.adaptive(fn, drop_rate=0.002, relative_error=0.9, seed=seed)(torch.ones(20), None) for seed in range(6)
    ]
    # P(16 renders without a drop) = 0.998^320 = 0.53 for each seed: in 6 seeds there is one but for a chance of 1 %.
    assert max(result.samples for result in results) > 16
    assert all(result.value > 0 and result.std_error > 0 for result in results)
    never = CAScore.adaptive(fn, drop_rate=1e-9, relative_error=0.5)(torch.ones(20), None)
    assert (never.value, never.samples, never.as_dict()["std_error"]) == (0.0, 256, None)


# --- numbers of numpy ---


@pytest.mark.parametrize("kind", [np.float32, np.float16, np.float64])
@each_method
def test_numbers_of_numpy_are_kept(method, kind):
    score = method(render, drop_rate=kind(0.25), threshold=kind(0.5))
    for found in (score.update(OPACITY, None), score.compute()):
        data = json.loads(json.dumps(found.as_dict()))
        assert (data["drop_rate"], data["threshold"]) == (0.25, 0.5)
    from_p = method(render, p=kind(0.5))
    assert json.loads(json.dumps(from_p(OPACITY, None).as_dict()))["drop_rate"] == 0.75


# --- callables that return something else ---


@pytest.mark.parametrize("depth", [5.0, 255.0])
@each_method
def test_a_depth_map_in_the_place_of_the_alpha_is_refused(depth, method):
    def with_depth(opacity, view):
        image, alpha = render(opacity, view)
        return image, depth * alpha / alpha.amax()

    with pytest.raises(ValueError, match=f"alpha .*up to {depth:g}"):
        method(with_depth, **SETTINGS)(OPACITY, None)


def test_an_expected_alpha_above_1_is_refused():
    def with_depth(*arguments):
        return {**moments(*arguments), "alpha_mean": torch.full((HEIGHT, WIDTH), 5.0)}

    with pytest.raises(ValueError, match=r"alpha .*\[0, 1\]"):
        CAScore.exact(with_depth)(OPACITY, None)


@each_method
def test_images_up_to_255_have_no_score_but_a_reason(method):
    def bright(opacity, view):
        image, alpha = render(opacity, view)
        return 255 * image, alpha

    score = method(bright, **SETTINGS)
    result = score.update(OPACITY, None)
    assert math.isnan(result.value)
    assert result.reason is score.compute().reason is Reason.OUT_OF_RANGE
    assert "0..255" in str(result.reason)


def test_the_largest_variance_of_colors_in_0_to_1_is_a_score():
    """One Gaussian, kept or not: 0 or 1. The population variance over two renders is 0 or 1/4, the unbiased one 1/2."""
    flip = torch.ones(1)
    for ddof in (0, 1):
        score = CAScore(
            lambda o, _: (o.reshape(1, 1, 1).expand(3, 2, 2), torch.ones(2, 2)), samples=2, ddof=ddof, threshold=0.0
        )
        results = [score(flip, None, index=i) for i in range(20)]
        assert max(result.value for result in results) == pytest.approx(0.25 * (1 + ddof))
        assert all(result.reason is Reason.OK or result.value == 0 for result in results)


@each_method
def test_a_renderer_that_ignores_the_opacities_is_noticed(method):
    score = method(lambda opacity, view: render(OPACITY, view), **SETTINGS)
    result = score.update(OPACITY, None)
    assert result.value == 0
    assert result.reason is score.compute().reason is Reason.NO_EFFECT
    assert "opacities" in str(result.reason)


def test_a_score_of_0_without_dropout_is_one():
    assert CAScore(render, **SETTINGS, drop_rate=0.0)(OPACITY, None).reason is Reason.OK
