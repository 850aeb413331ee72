"""What holds for every input: ranges, identities, orders and shapes, on inputs that hypothesis makes up."""

from __future__ import annotations

import itertools
import math

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ca_reg import CAScore, GaussianDropout, OpacityNoise
from ca_reg import functional as F
from ca_reg.functional import Multiplier
from ca_reg.schedules import Constant, LinearRamp, StartStop

REPEATABLE = settings(max_examples=40, deadline=None, derandomize=True, database=None)

SHARES = st.floats(0, 1, allow_subnormal=False)
RATES = st.floats(0, 0.999)
SIGMAS = st.floats(0, 10)
SEEDS = st.integers(0, 2**31)
STEPS = st.integers(0, 10**6)


def tensors(shape, elements=SHARES):
    return arrays.arrays(np.float64, shape, elements=elements).map(torch.from_numpy)


OPACITIES = st.integers(0, 30).flatmap(tensors)


@st.composite
def pixels(draw, most=5):
    """Alphas (P, n) and colors (P, n, 3) of a few pixels, and their background."""
    p, n = draw(st.integers(1, 3)), draw(st.integers(1, most))
    return draw(tensors((p, n))), draw(tensors((p, n, 3))), draw(tensors(3))


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def composite(alphas, colors, background):
    """Front to back, in plain loops over the splats."""
    image, light = torch.zeros_like(colors[..., 0, :]), torch.ones_like(alphas[..., :1])
    for i in range(alphas.shape[-1]):
        image = image + light * alphas[..., i : i + 1] * colors[..., i, :]
        light = light * (1 - alphas[..., i : i + 1])
    return image + light * background


# Dropout and noise


@REPEATABLE
@given(OPACITIES, RATES, SEEDS, st.booleans())
def test_dropout_keeps_or_zeroes(opacity, p, seed, compensate):
    before = opacity.clone()
    state = torch.get_rng_state()
    dropped, keep = F.gaussian_dropout(opacity, p, compensate=compensate, generator=seeded(seed))
    assert torch.equal(opacity, before)
    assert torch.equal(torch.get_rng_state(), state)
    if p == 0:
        assert dropped is opacity
        return
    factor = 1 / (1 - p) if compensate else 1.0
    assert torch.equal(dropped, torch.where(keep, opacity * factor, 0.0))
    if not compensate:  # a second application of one mask changes nothing
        assert torch.equal(F.apply_dropout(dropped, keep), dropped)


@REPEATABLE
@given(OPACITIES, RATES, SIGMAS, SEEDS)
def test_a_column_gets_what_a_vector_gets(opacity, p, sigma, seed):
    column = opacity[:, None]
    pairs = [
        (F.gaussian_dropout(x, p, generator=seeded(seed))[0], F.opacity_noise(x, sigma, generator=seeded(seed))[0])
        for x in (opacity, column)
    ]
    means = [(F.scale_opacity(x, p), F.expected_opacity(x, sigma)) for x in (opacity, column)]
    for vector, matrix in [*zip(*pairs, strict=True), *zip(*means, strict=True)]:
        assert matrix.shape == column.shape
        assert matrix.dtype == vector.dtype == torch.float64
        torch.testing.assert_close(matrix[:, 0], vector, rtol=1e-14, atol=0)


@pytest.mark.parametrize("shape", [(3,), (3, 1)])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_each_gaussian_has_its_own_rate_in_every_shape_and_type(shape, dtype):
    rates, opacity = torch.tensor([0.0, 0.25, 0.5]), torch.full(shape, 0.5, dtype=dtype)
    kept = torch.tensor([True, False, True])
    scaled, raised = F.scale_opacity(opacity, rates), F.apply_dropout(opacity, kept, p=rates, compensate=True)
    assert (scaled.shape, scaled.dtype, raised.shape, raised.dtype) == (shape, dtype, shape, dtype)
    assert scaled.flatten().tolist() == [0.5, 0.375, 0.25]
    assert raised.flatten().tolist() == [0.5, 0.0, 1.0]
    for call in (
        lambda p: F.scale_opacity(opacity, p),
        lambda p: F.apply_dropout(opacity, kept, p=p, compensate=True),
        lambda p: F.draw_keep_mask(3, p),
    ):
        with pytest.raises(ValueError, match=r"\bp .*shape \(3,\)"):
            call(rates[:1])


@REPEATABLE
@given(tensors(20, st.floats(0, 1, width=32)), RATES, SIGMAS, SEEDS, st.permutations(range(20)))
def test_who_stands_where_does_not_matter(opacity, p, sigma, seed, order):
    keep = F.draw_keep_mask(20, p, generator=seeded(seed))
    noise = F.draw_opacity_noise(20, sigma, generator=seeded(seed))
    assert torch.equal(F.apply_dropout(opacity, keep)[order], F.apply_dropout(opacity[order], keep[order]))
    assert torch.equal(
        F.apply_opacity_noise(opacity, noise)[order], F.apply_opacity_noise(opacity[order], noise[order])
    )


@REPEATABLE
@given(st.integers(0, 200), RATES, RATES, SEEDS)
def test_a_higher_rate_drops_the_same_and_more(n, p, q, seed):
    low, high = sorted((p, q))
    more = F.draw_keep_mask(n, low, generator=seeded(seed))
    fewer = F.draw_keep_mask(n, high, generator=seeded(seed))
    assert bool((fewer <= more).all())
    longer = F.draw_keep_mask(n + 50, low, generator=seeded(seed))
    assert longer.shape == (n + 50,)


@REPEATABLE
@given(OPACITIES, SIGMAS, SEEDS, st.booleans())
def test_noisy_opacities_are_opacities(opacity, sigma, seed, clip):
    noisy, noise = F.opacity_noise(opacity, sigma, clip=clip, generator=seeded(seed))
    if sigma == 0:
        assert noisy is opacity
        return
    assert bool(((noisy >= 0) & (noisy <= 1)).all())
    assert bool((noisy[opacity == 0] == 0).all())
    if clip and len(opacity):
        assert noise.abs().max() <= np.float32(sigma)
    louder = noise >= 0
    assert bool((noisy[louder] >= opacity[louder]).all())
    assert bool((noisy[~louder] <= opacity[~louder]).all())


@REPEATABLE
@given(st.lists(SHARES, min_size=1, max_size=6).map(torch.tensor), st.floats(0.01, 0.99), st.booleans())
def test_the_mean_over_all_masks(opacity, p, compensate):
    opacity, mean = opacity.double(), torch.zeros(len(opacity), dtype=torch.float64)
    for mask in itertools.product((True, False), repeat=len(opacity)):
        keep = torch.tensor(mask)
        weight = math.prod(1 - p if kept else p for kept in mask)
        mean += weight * F.apply_dropout(opacity, keep, p=p, compensate=compensate)
    torch.testing.assert_close(mean, opacity if compensate else F.scale_opacity(opacity, p), rtol=1e-12, atol=1e-300)


@REPEATABLE
@given(OPACITIES, RATES, RATES)
def test_scaling_twice_is_scaling_once(opacity, p, q):
    twice = F.scale_opacity(F.scale_opacity(opacity, p), q)
    torch.testing.assert_close(twice, opacity * ((1 - p) * (1 - q)), rtol=1e-14, atol=0)
    assert bool((F.scale_opacity(opacity, max(p, q)) <= F.scale_opacity(opacity, min(p, q))).all())


@REPEATABLE
@given(OPACITIES, SIGMAS, st.booleans())
def test_expected_opacities_are_opacities_in_the_same_order(opacity, sigma, clip):
    mean = F.expected_opacity(opacity, sigma, clip=clip)
    assert bool(((mean >= 0) & (mean <= 1 + 1e-15)).all())
    assert bool((mean.sort().values.diff() >= 0).all())
    in_order = F.expected_opacity(opacity.sort().values, sigma, clip=clip)
    assert bool((in_order.diff() >= -1e-15).all())  # clamp(o (1 + e)) grows with o for every e, so its mean does


# Moments


@REPEATABLE
@given(pixels(), st.floats(0.01, 0.99))
def test_moments_are_those_of_all_masks(pixel, p):
    alphas, colors, background = pixel
    n = alphas.shape[-1]
    masks = torch.tensor(list(itertools.product((1.0, 0.0), repeat=n)), dtype=torch.float64)
    weights = (masks * (1 - p) + (1 - masks) * p).prod(1)
    renders = torch.stack([composite(alphas * mask, colors, background) for mask in masks])
    mean = torch.einsum("m,mpc->pc", weights, renders)
    variance = torch.einsum("m,mpc->pc", weights, (renders - mean).square())
    found = F.pixel_moments(alphas, colors, Multiplier.dropout(p), background=background)
    torch.testing.assert_close(found.mean, mean, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(found.variance, variance, rtol=1e-9, atol=1e-14)


@REPEATABLE
@given(pixels(20), RATES, st.floats(0, 3))
def test_moments_stay_in_their_bounds(pixel, p, sigma):
    alphas, colors, background = pixel
    dropout = Multiplier.dropout(p)
    mean, variance = F.pixel_moments(alphas, colors, dropout, background=background)
    assert bool(((mean >= -1e-12) & (mean <= 1 + 1e-12)).all())
    assert bool(((variance >= 0) & (variance <= mean * (1 - mean) + 1e-12)).all())  # Bhatia-Davis, values in [0, 1]
    shares = F.contributions(alphas, colors, dropout, background=background)
    assert bool((shares >= 0).all())
    torch.testing.assert_close(shares.sum(-2), variance, rtol=1e-12, atol=1e-300)
    assert bool((F.first_order_variance(alphas, colors, Multiplier.opacity_noise(sigma)) >= 0).all())


@REPEATABLE
@given(pixels(8), RATES, tensors(3))
def test_a_common_color_behind_moves_the_mean_alone(pixel, p, shift):
    alphas, colors, background = pixel
    here = F.pixel_moments(alphas, colors, Multiplier.dropout(p), background=background)
    there = F.pixel_moments(alphas, colors + shift, Multiplier.dropout(p), background=background + shift)
    torch.testing.assert_close(there.mean, here.mean + shift, rtol=0, atol=1e-12)
    torch.testing.assert_close(there.variance, here.variance, rtol=1e-9, atol=1e-12)


@REPEATABLE
@given(pixels(8), RATES, st.integers(0, 5))
def test_padding_changes_nothing(pixel, p, count):
    alphas, colors, background = pixel
    padded = torch.nn.functional.pad(alphas, (0, count)), torch.nn.functional.pad(colors, (0, 0, 0, count), value=0.7)
    for function in (F.pixel_moments, F.contributions):
        plain = function(alphas, colors, Multiplier.dropout(p), background=background)
        longer = function(*padded, Multiplier.dropout(p), background=background)
        if function is F.contributions:
            plain, longer = (plain,), (longer[..., : alphas.shape[-1], :],)
        for a, b in zip(plain, longer, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-300)


@REPEATABLE
@given(pixels(8), RATES)
def test_the_neutral_background_is_neutral(pixel, p):
    alphas, colors, _ = pixel
    background = F.neutral_background(alphas, colors, Multiplier.dropout(p))
    mean, variance = F.pixel_moments(alphas, colors, Multiplier.dropout(p), background=background)
    torch.testing.assert_close(mean, background, rtol=1e-9, atol=1e-9)
    same = colors[..., :1, :].expand_as(colors)  # splats of one color agree, whatever is left out
    background = F.neutral_background(alphas, same, Multiplier.dropout(p))
    _, variance = F.pixel_moments(alphas, same, Multiplier.dropout(p), background=background)
    assert float(variance.max()) < 1e-24


@REPEATABLE
@given(tensors((4, 7)), RATES)
def test_alpha_is_a_white_pixel_over_black(alphas, p):
    white = torch.ones(4, 7, 3, dtype=torch.float64)
    pixel = F.pixel_moments(alphas, white, Multiplier.dropout(p))
    for whole, alone in zip(pixel, F.alpha_moments(alphas, Multiplier.dropout(p)), strict=True):
        torch.testing.assert_close(whole, alone[:, None].expand(4, 3), rtol=1e-14, atol=0)


@REPEATABLE
@given(RATES, SIGMAS, RATES)
def test_multipliers_commute(p, sigma, q):
    one, two, three = Multiplier.dropout(p), Multiplier.opacity_noise(sigma), Multiplier.dropout(q, compensate=True)
    for a, b in ((one * two, two * one), ((one * two) * three, one * (two * three))):
        assert a.mean == pytest.approx(b.mean, rel=1e-12)
        assert a.variance == pytest.approx(b.variance, rel=1e-12, abs=1e-300)


@REPEATABLE
@given(OPACITIES, SIGMAS, st.booleans())
def test_clamped_noise_has_the_bounds_of_what_it_multiplies(opacity, sigma, clip):
    noise = Multiplier.clamped_noise(opacity, sigma, clip=clip)
    mean = opacity * noise.mean
    assert bool((opacity.square() * noise.variance <= mean * (1 - mean) + 1e-12).all())  # Bhatia-Davis again


# Color variance


@REPEATABLE
@given(pixels(8))
def test_color_variance_is_the_weighted_variance(pixel):
    weights, colors, _ = pixel
    order = torch.randperm(weights.shape[-1], generator=seeded(0))
    cv = F.color_variance(weights, colors)
    assert bool(((cv.variance >= 0) & (cv.variance <= 0.25 + 1e-12)).all())  # Popoviciu, colors in [0, 1]
    torch.testing.assert_close(F.color_variance(weights[:, order], colors[:, order]).variance, cv.variance)
    torch.testing.assert_close(F.color_variance(weights * 0.125, colors).variance, cv.variance)
    for i in range(len(weights)):
        expected = 0.0
        if float(weights[i].sum()) > 0:
            mean = np.average(colors[i], axis=0, weights=weights[i])
            expected = np.average((colors[i].numpy() - mean) ** 2, axis=0, weights=weights[i]).mean()
        assert float(cv.variance[i]) == pytest.approx(expected, rel=1e-9, abs=1e-12)


# Expected losses


@REPEATABLE
@given(tensors(10), tensors(10, st.floats(0, 1)), tensors(10))
def test_expected_losses_are_ordered(mean, variance, target):
    square = F.expected_squared_error(mean, variance, target)
    absolute = F.expected_absolute_error(mean, variance, target)
    floor = 1e-3
    assert bool((square >= variance).all())
    assert bool((absolute >= (mean - target).abs() - 1e-12).all())  # Jensen
    assert bool((absolute.square() <= square + floor).all())  # Jensen once more; the smallest deviation is the floor
    torch.testing.assert_close(F.expected_absolute_error(target, variance, mean), absolute, rtol=1e-12, atol=1e-14)
    more = F.expected_absolute_error(mean, variance + 0.1, target)
    assert bool((more > absolute - 1e-12).all())


# Schedules


@REPEATABLE
@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), STEPS, st.integers(1, 10**6), STEPS, STEPS)
def test_a_ramp_goes_one_way_between_its_ends(start, end, first, length, step, later):
    ramp = LinearRamp(start, end, first, first + length)
    step, later = sorted((step, later))
    low, high = sorted((start, end))
    slack = 1e-12 * max(abs(start), abs(end))
    assert low - slack <= ramp(step) <= high + slack
    assert (ramp(later) - ramp(step)) * (1 if end >= start else -1) >= -slack
    assert (ramp(first), ramp(first + length)) == (start, end)
    assert ramp(first + length + step) == end


@REPEATABLE
@given(RATES, STEPS, st.none() | st.integers(1, 10**6), STEPS)
def test_a_rate_that_starts_and_stops(rate, start, length, step):
    schedule = StartStop(rate, start, None if length is None else start + length)
    assert schedule(step) == (rate if start <= step < (math.inf if length is None else start + length) else 0.0)
    assert Constant(rate)(step) == rate


# Modules and the score


@REPEATABLE
@given(OPACITIES.filter(len), RATES, SIGMAS, SEEDS)
def test_modules_replay_and_do_nothing_in_evaluation(opacity, p, sigma, seed):
    dropout, noise = GaussianDropout(p), OpacityNoise(sigma)
    first = dropout(opacity, generator=seeded(seed))
    if dropout.keep is not None:
        assert torch.equal(dropout(opacity, drawn=dropout.last), first)
        assert torch.equal(dropout.mask_radii(torch.ones(len(opacity))) > 0, dropout.keep)
    first = noise(opacity, generator=seeded(seed))
    if noise.noise is not None:
        assert torch.equal(noise(opacity, drawn=noise.last), first)
    assert torch.equal(dropout.eval()(opacity), F.scale_opacity(opacity, p))
    assert noise.eval()(opacity) is opacity


@REPEATABLE
@given(st.floats(0, 0.9), st.integers(2, 20), st.integers(0, 1), st.floats(0.1, 1.0), SEEDS, st.floats(-2, 2))
def test_a_score_is_a_variance(drop_rate, samples, ddof, gain, seed, offset):
    generator = seeded(seed)
    colors = torch.rand(3, 20, generator=generator, dtype=torch.float64) / 20
    opacity = torch.rand(20, generator=generator, dtype=torch.float64)

    renders = []

    def score(gain, offset):
        def render(opacity, view):
            renders.append(gain * (colors @ opacity) + offset)
            return renders[-1][:, None, None].expand(3, 2, 2), torch.ones(2, 2)

        return CAScore(render, samples=samples, ddof=ddof, drop_rate=drop_rate, seed=seed)(opacity, None).value

    plain = score(1.0, 0.0)
    assert len(renders) == samples
    expected = np.var(torch.stack(renders).numpy(), axis=0, ddof=ddof).mean()
    assert plain == pytest.approx(expected, rel=1e-9, abs=1e-20)
    assert score(gain, offset) == pytest.approx(gain**2 * plain, rel=1e-6, abs=1e-12)


@REPEATABLE
@given(
    st.floats(allow_nan=True), st.integers(-3, 40), st.integers(-3, 40), st.floats(allow_nan=True), st.integers(-2, 5)
)
def test_settings_of_a_score_are_refused_or_kept(drop_rate, samples, ddof, threshold, seed):
    sensible = 0 <= drop_rate < 1 and samples >= 2 and 0 <= ddof < samples and math.isfinite(threshold) and seed >= 0

    def make():
        return CAScore(
            lambda opacity, view: None, drop_rate=drop_rate, samples=samples, ddof=ddof, threshold=threshold, seed=seed
        )

    if not sensible:
        with pytest.raises(ValueError, match="must be"):
            make()
        return
    kept = make().settings
    assert (kept.drop_rate, kept.samples, kept.ddof, kept.threshold, kept.seed) == (
        drop_rate, samples, ddof, threshold, seed
    )  # fmt: skip
