"""Exact pixel moments, against the enumeration of all outcomes of the random factors."""

import itertools
import math

import numpy as np
import pytest
import torch

from ca_reg.functional import (
    Multiplier,
    alpha_moments,
    contributions,
    first_order_variance,
    neutral_background,
    pixel_moments,
)

EXACT = {"rtol": 1e-12, "atol": 1e-14}


def lists(pixels, n, *, channels=3, seed=0, dtype=torch.float64, low=0.0, high=0.99):
    """Random alphas (pixels, n), colors (pixels, n, channels) and backgrounds (pixels, channels)."""
    g = torch.Generator().manual_seed(seed)
    alphas = low + (high - low) * torch.rand(pixels, n, generator=g, dtype=dtype)
    return alphas, torch.rand(pixels, n, channels, generator=g, dtype=dtype), torch.rand(
        pixels, channels, generator=g, dtype=dtype
    )  # fmt: skip


def composite(alphas, colors, background):
    """Front to back from the definition: sum_i c_i alpha_i T_i + T_{n+1} b."""
    light, out = torch.ones_like(alphas.sum(-1)), 0.0
    for i in range(alphas.shape[-1]):
        out = out + (alphas[..., i] * light)[..., None] * colors[..., i, :]
        light = light * (1 - alphas[..., i])
    return out + light[..., None] * background


def enumerate_moments(alphas, colors, background, supports):
    """Mean and variance over every combination of the factors; ``supports`` are (values, probabilities) per splat."""
    factors = torch.tensor(list(itertools.product(*(s[0] for s in supports))), dtype=torch.float64)
    weight = torch.tensor(list(itertools.product(*(s[1] for s in supports))), dtype=torch.float64).prod(-1)
    samples = composite(alphas[:, None] * factors, colors[:, None], background[:, None])
    weight = weight[:, None]
    mean = (weight * samples).sum(1)
    return mean, (weight * (samples - mean[:, None]).square()).sum(1)


def bernoulli(p, scale=1.0):
    return (0.0, scale), (p, 1 - p)


def gauss_hermite(sigma, nodes=3):
    # A pixel is linear in each factor, so its square is a polynomial of degree 2: exact from 2 nodes on.
    x, w = np.polynomial.hermite_e.hermegauss(nodes)
    return 1 + sigma * x, w / math.sqrt(2 * math.pi)


def clamped(opacity, sigma):
    """Nodes of the clamped noise: Gauss-Legendre between the two kinks, the tails as point masses."""
    low, high = -1 / sigma, (1 / opacity - 1) / sigma
    x, w = np.polynomial.legendre.leggauss(24)
    z = low + (high - low) * (1 + x) / 2
    inner = (high - low) / 2 * w * np.exp(-z * z / 2) / math.sqrt(2 * math.pi)
    tails = [math.erfc(t / math.sqrt(2)) / 2 for t in (-low, high)]
    return [0.0, *(1 + sigma * z), 1 / opacity], [tails[0], *inner, tails[1]]


@pytest.mark.parametrize("n", [1, 2, 5, 12])
@pytest.mark.parametrize("compensate", [False, True])
def test_dropout_equals_the_enumeration_of_all_masks(n, compensate):
    for p in (0.2, 0.5, 0.9):
        alphas, colors, background = lists(8, n, seed=n)
        support = bernoulli(p, 1 / (1 - p) if compensate else 1.0)
        expected = enumerate_moments(alphas, colors, background, [support] * n)
        result = pixel_moments(alphas, colors, Multiplier.dropout(p, compensate=compensate), background=background)
        torch.testing.assert_close(result.mean, expected[0], **EXACT)
        torch.testing.assert_close(result.variance, expected[1], **EXACT)


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("sigma", [0.05, 0.8, 3.0])
def test_noise_equals_gauss_hermite_quadrature(n, sigma):
    alphas, colors, background = lists(8, n, seed=n)
    expected = enumerate_moments(alphas, colors, background, [gauss_hermite(sigma)] * n)
    result = pixel_moments(alphas, colors, Multiplier.opacity_noise(sigma), background=background)
    torch.testing.assert_close(result.mean, expected[0], **EXACT)
    torch.testing.assert_close(result.variance, expected[1], **EXACT)


def test_clamped_noise_equals_quadrature_with_its_own_factor_per_splat():
    opacities = [0.95, 0.3, 0.7]
    alphas, colors, background = lists(8, 3)
    expected = enumerate_moments(alphas, colors, background, [clamped(o, 0.8) for o in opacities])
    noise = Multiplier.clamped_noise(torch.tensor(opacities, dtype=torch.float64), 0.8)
    result = pixel_moments(alphas, colors, noise, background=background)
    torch.testing.assert_close(result.mean, expected[0], **EXACT)
    torch.testing.assert_close(result.variance, expected[1], **EXACT)


def test_a_mixture_of_regularizers_equals_its_enumeration():
    values, weights = gauss_hermite(0.5)
    both = [0.0, *values], [0.3, *(0.7 * weights)]
    supports = [bernoulli(0.2), gauss_hermite(0.8), both, ((1.0,), (1.0,)), bernoulli(0.4, 1 / 0.6), clamped(0.9, 0.5)]
    kinds = [
        Multiplier.dropout(0.2),
        Multiplier.opacity_noise(0.8),
        Multiplier.dropout(0.3) * Multiplier.opacity_noise(0.5),
        Multiplier(1.0, 0.0),
        Multiplier.dropout(0.4, compensate=True),
        Multiplier.clamped_noise(torch.tensor(0.9, dtype=torch.float64), 0.5),
    ]
    mixture = Multiplier(
        torch.tensor([float(k.mean) for k in kinds], dtype=torch.float64).expand(4, 6),
        torch.tensor([float(k.variance) for k in kinds], dtype=torch.float64).expand(4, 6),
    )
    alphas, colors, background = lists(4, 6, seed=3)
    expected = enumerate_moments(alphas, colors, background, supports)
    result = pixel_moments(alphas, colors, mixture, background=background)
    torch.testing.assert_close(result.mean, expected[0], **EXACT)
    torch.testing.assert_close(result.variance, expected[1], **EXACT)


def test_contributions_are_the_unrolled_recursion_and_sum_to_the_variance():
    alphas, colors, background = lists(6, 9)
    m, v = 0.7, 0.35
    behind, variance, front = background, torch.zeros_like(background), []
    for i in reversed(range(9)):
        a = alphas[:, i, None]
        own = v * a.square() * (colors[:, i] - behind).square()
        shrink = (1 - m * a).square() + v * a.square()
        front = [own, *(shrink * x for x in front)]
        variance = shrink * variance + own
        behind = m * a * colors[:, i] + (1 - m * a) * behind
    shares = contributions(alphas, colors, Multiplier(m, v), background=background)
    assert (shares >= 0).all()
    torch.testing.assert_close(shares, torch.stack(front, 1), **EXACT)
    torch.testing.assert_close(shares.sum(1), variance, **EXACT)
    result = pixel_moments(alphas, colors, Multiplier(m, v), background=background)
    torch.testing.assert_close(shares.sum(1), result.variance, **EXACT)


def test_accumulated_alpha_equals_its_product_form_and_the_enumeration():
    alphas, _, _ = lists(8, 10)
    result = alpha_moments(alphas, Multiplier.dropout(0.3))
    ones, black = torch.ones(8, 10, 1, dtype=torch.float64), torch.zeros(8, 1, dtype=torch.float64)
    mean, variance = enumerate_moments(alphas, ones, black, [bernoulli(0.3)] * 10)
    torch.testing.assert_close(result.mean, mean[..., 0], **EXACT)
    torch.testing.assert_close(result.variance, variance[..., 0], **EXACT)
    torch.testing.assert_close(result.mean, 1 - (1 - 0.7 * alphas).prod(-1), **EXACT)


def test_the_neutral_background_is_the_mean_itself_and_equals_the_enumeration():
    alphas, colors, _ = lists(8, 10, high=0.3)
    dropout = Multiplier.dropout(0.4)
    neutral = neutral_background(alphas, colors, dropout)
    expected = enumerate_moments(alphas, colors, neutral, [bernoulli(0.4)] * 10)
    result = pixel_moments(alphas, colors, dropout, background=neutral)
    torch.testing.assert_close(expected[0], neutral, **EXACT)
    torch.testing.assert_close(result.mean, neutral, **EXACT)
    torch.testing.assert_close(result.variance, expected[1], **EXACT)
    # Compositing mean renders over one another converges to it: the fixed point, reached without the formula.
    color = torch.zeros_like(neutral)
    for _ in range(200):
        color = pixel_moments(alphas, colors, dropout, background=color).mean
    torch.testing.assert_close(color, neutral, **EXACT)


def test_over_the_neutral_background_only_disagreement_of_colors_counts():
    alphas, colors, background = lists(8, 10, high=0.1)
    alphas[0] = 0.0
    dropout = Multiplier.dropout(0.5)
    same = background[:, None].expand(8, 10, 3)
    neutral = neutral_background(alphas, same, dropout)
    torch.testing.assert_close(neutral[1:], background[1:])
    assert (neutral[0] == 0).all()
    assert pixel_moments(alphas, same, dropout, background=neutral).variance.max() < 1e-30
    assert pixel_moments(alphas, same, dropout).variance[1:].min() > 1e-6
    # A shift of all colors changes nothing.
    shifted = neutral_background(alphas, colors + 3, dropout)
    torch.testing.assert_close(
        pixel_moments(alphas, colors + 3, dropout, background=shifted).variance,
        pixel_moments(alphas, colors, dropout, background=neutral_background(alphas, colors, dropout)).variance,
    )


def test_the_first_order_form_is_right_for_one_splat_and_for_faint_ones_over_black():
    dropout = Multiplier.dropout(0.3)
    alphas, colors, _ = lists(8, 1)
    exact = pixel_moments(alphas, colors, dropout).variance
    torch.testing.assert_close(first_order_variance(alphas, colors, dropout), exact, **EXACT)
    alphas, colors, _ = lists(8, 10, low=0.5)
    errors = []
    for faint in (1e-2, 1e-3, 1e-4):
        exact = pixel_moments(faint * alphas, colors, dropout).variance
        errors.append((first_order_variance(faint * alphas, colors, dropout) / exact - 1).abs().max().item())
    # The error is itself of first order in alpha.
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.1)
    assert errors[2] == pytest.approx(errors[1] / 10, rel=0.1)


def test_without_randomness_it_is_plain_compositing():
    alphas, colors, background = lists(8, 10)
    mean, variance = pixel_moments(alphas, colors, Multiplier(1.0, 0.0), background=background)
    torch.testing.assert_close(mean, composite(alphas, colors, background), **EXACT)
    assert (variance == 0).all()
    for scaled in (0.8 * alphas, alphas * torch.linspace(0, 1, 10, dtype=torch.float64)):
        factor = Multiplier(scaled[0] / alphas[0], 0.0)
        mean = pixel_moments(alphas, colors, factor, background=background).mean
        torch.testing.assert_close(mean, composite(alphas * factor.mean, colors, background), **EXACT)


def test_padding_does_not_matter():
    alphas, colors, background = lists(8, 6)
    noise = Multiplier(torch.rand(8, 6, dtype=torch.float64), torch.rand(8, 6, dtype=torch.float64))
    where = torch.tensor([0, 1, 4, 5, 6, 9])
    wide = [torch.rand(8, 10, *x.shape[2:], dtype=torch.float64) for x in (colors, noise.mean, noise.variance)]
    padded = torch.zeros(8, 10, dtype=torch.float64)
    for x, y in zip((padded, *wide), (alphas, colors, noise.mean, noise.variance), strict=True):
        x[:, where] = y
    before = pixel_moments(alphas, colors, noise, background=background)
    after = pixel_moments(padded, wide[0], Multiplier(*wide[1:]), background=background)
    torch.testing.assert_close(after.mean, before.mean, **EXACT)
    torch.testing.assert_close(after.variance, before.variance, **EXACT)
    shares = contributions(padded, wide[0], Multiplier(*wide[1:]), background=background)
    torch.testing.assert_close(shares[:, where], contributions(alphas, colors, noise, background=background), **EXACT)
    neutral = neutral_background(padded, wide[0], Multiplier(wide[1], 0.0))
    torch.testing.assert_close(neutral, neutral_background(alphas, colors, noise), **EXACT)


def test_an_empty_list_shows_the_background():
    alphas, colors, background = lists(4, 0)
    dropout = Multiplier.dropout(0.5)
    mean, variance = pixel_moments(alphas, colors, dropout, background=background)
    assert torch.equal(mean, background)
    assert torch.equal(variance, torch.zeros_like(background))
    assert contributions(alphas, colors, dropout).shape == (4, 0, 3)
    assert torch.equal(alpha_moments(alphas, dropout).mean, torch.zeros(4, dtype=torch.float64))
    assert torch.equal(neutral_background(alphas, colors, dropout), torch.zeros_like(background))
    assert torch.equal(first_order_variance(alphas, colors, dropout), torch.zeros_like(background))


def test_shapes_without_a_pixel_axis_or_with_several_agree():
    alphas, colors, background = lists(6, 5)
    dropout = Multiplier.dropout(0.3)
    flat = pixel_moments(alphas, colors, dropout, background=background[0])
    grid = pixel_moments(alphas.view(2, 3, 5), colors.view(2, 3, 5, 3), dropout, background=background[0])
    torch.testing.assert_close(grid.variance.view(6, 3), flat.variance, **EXACT)
    one = pixel_moments(alphas[2], colors[2], dropout, background=background[0])
    torch.testing.assert_close(one.mean, flat.mean[2], **EXACT)
    torch.testing.assert_close(one.variance, flat.variance[2], **EXACT)


def test_channels_are_independent_and_colors_scale_and_shift():
    alphas, colors, background = lists(8, 7)
    dropout, order = Multiplier.dropout(0.3), [2, 0, 1]
    plain = pixel_moments(alphas, colors, dropout, background=background)
    turned = pixel_moments(alphas, colors[..., order], dropout, background=background[:, order])
    torch.testing.assert_close(turned.mean, plain.mean[:, order], **EXACT)
    torch.testing.assert_close(turned.variance, plain.variance[:, order], **EXACT)
    affine = pixel_moments(alphas, 2 - 3 * colors, dropout, background=2 - 3 * background)
    torch.testing.assert_close(affine.mean, 2 - 3 * plain.mean, **EXACT)
    torch.testing.assert_close(affine.variance, 9 * plain.variance, **EXACT)


def test_equal_colors_over_themselves_have_exactly_no_variance_in_float32():
    alphas, _, background = lists(50, 20, dtype=torch.float32)
    colors = background[:, None].expand(50, 20, 3)
    mean, variance = pixel_moments(alphas, colors, Multiplier.dropout(0.5), background=background)
    assert torch.equal(mean, background)
    assert (variance == 0).all()


def everything(alphas, colors, background, mean, variance):
    factor = Multiplier(mean, variance)
    neutral = neutral_background(alphas, colors, factor)
    return (
        *pixel_moments(alphas, colors, factor, background=background),
        contributions(alphas, colors, factor, background=neutral),
        first_order_variance(alphas, colors, factor),
    )


def test_all_arguments_are_differentiable():
    alphas, colors, background = lists(2, 4, channels=2, low=0.1, high=0.9)
    (mean, _, _), (variance, _, _) = (lists(2, 4, seed=seed, low=0.1) for seed in (1, 2))
    assert torch.autograd.gradcheck(
        everything, [x.requires_grad_() for x in (alphas, colors, background, mean, variance)]
    )


def test_gradients_are_right_where_alpha_is_zero_or_one():
    # Alpha 0 is padding; behind alpha 1 with m = 1 and v = 0 nothing shows and every product is zero.
    alphas, colors, background = lists(2, 4, low=0.1)
    alphas[0, 1], alphas[1, 2] = 0.0, 1.0
    mean, variance = torch.full_like(alphas, 0.8), torch.full_like(alphas, 0.3)
    mean[1, 2], variance[1, 2] = 1.0, 0.0

    def total(a):
        return sum((x * torch.arange(1.0, 1 + x.numel()).view_as(x)).sum() for x in everything(a, *rest))

    rest = (colors, background, mean, variance)
    (gradient,) = torch.autograd.grad(total(alphas.requires_grad_()), alphas)
    for pixel, splat, step in ((0, 1, 1e-6), (1, 2, -1e-6)):
        near, far = alphas.detach().clone(), alphas.detach().clone()
        near[pixel, splat] += step
        far[pixel, splat] += 2 * step
        # One-sided, of second order in the step.
        slope = (4 * total(near) - total(far) - 3 * total(alphas.detach())) / (2 * step)
        assert gradient[pixel, splat].item() == pytest.approx(slope.item(), rel=1e-6)


@pytest.mark.parametrize("high", [0.99, 1e-2])
def test_float32_agrees_with_float64_on_lists_of_a_thousand(high):
    # Up to 0.99 the first few dozen splats decide; up to 0.01 all thousand do.
    n, low = 1000, 1e-4
    uniform, colors, background = lists(50, n, dtype=torch.float32, high=1.0)
    alphas = (low * (high / low) ** uniform).clamp(low, high)
    for kind in ("dropout", "noise", "clamped"):
        results = []
        for dtype in (torch.float32, torch.float64):
            factor = {
                "dropout": lambda: Multiplier.dropout(0.2),
                "noise": lambda: Multiplier.opacity_noise(0.8),
                "clamped": lambda d=dtype: Multiplier.clamped_noise(alphas.to(d), 0.8),
            }[kind]()
            results.append(
                pixel_moments(alphas.to(dtype), colors.to(dtype), factor, background=background.to(dtype))
            )  # fmt: skip
        # A product of n factors is off by at most a few n rounding errors; random ones add up to far less.
        tolerance = n * torch.finfo(torch.float32).eps
        for single, double in zip(*results, strict=True):
            assert single.dtype == torch.float32
            torch.testing.assert_close(single.double(), double, rtol=tolerance, atol=0)


def test_monte_carlo_converges_to_the_variance_at_the_rate_of_one_half():
    p, pixels, n = 0.4, 300, 8
    alphas, colors, background = lists(pixels, n, low=0.05, high=0.6, channels=1)
    exact = pixel_moments(alphas, colors, Multiplier.dropout(p), background=background)
    keep = torch.rand(1024, pixels, n, generator=torch.Generator().manual_seed(11), dtype=torch.float32) >= p
    samples = composite(alphas * keep, colors, background)
    counts, errors = [16, 32, 64, 128, 256], []
    for k in counts:
        estimates = samples.view(1024 // k, k, pixels, 1).var(1)
        errors.append((estimates / exact.variance - 1).square().mean().sqrt().item())
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # 60 other seeds gave slopes of -0.509 +- 0.007, with the offset because the squared error falls like 1 / (K - 1).
    # The nearer end of the band is 5.9 standard deviations away: false alarm below 1e-8.
    assert abs(slope + 0.5) < 0.05
    # All 1,024 samples of all pixels: 5 standard errors, false alarm 6e-7 each.
    z = (samples.mean(0) - exact.mean) / (exact.variance / 1024).sqrt()
    assert abs(z.mean().item()) < 5 / math.sqrt(pixels)
    ratio = (samples - exact.mean).square().mean(0) / exact.variance
    assert abs(ratio.mean().item() - 1) < 5 * ratio.std().item() / math.sqrt(pixels)


def test_the_renderers_clamp_moves_a_noisy_sample_by_at_most_a_99th_of_the_range():
    g = torch.Generator().manual_seed(0)
    opacity = 1 - torch.rand(20_000, 6, generator=g, dtype=torch.float64) ** 3
    falloff = 1 - 0.1 * torch.rand(20_000, 6, generator=g, dtype=torch.float64) ** 3
    _, colors, background = lists(20_000, 6)
    noisy = (opacity * (1 + 0.8 * torch.randn(20_000, 6, generator=g, dtype=torch.float64))).clamp(0, 1)
    rendered = composite((noisy * falloff).clamp(max=0.99), colors.round(), background.round())
    modelled = composite((opacity * falloff).clamp(max=0.99) * (noisy / opacity), colors.round(), background.round())
    worst = (rendered - modelled).abs().max()
    assert 0.9 / 99 < worst <= (1 + 1e-12) / 99


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"alphas": torch.full((4, 5), 1.1)}, ValueError, r"in \[0, 1\]"),
        ({"alphas": torch.full((4, 5), -0.1)}, ValueError, r"in \[0, 1\]"),
        ({"alphas": torch.full((4, 5), torch.nan)}, ValueError, r"in \[0, 1\]"),
        ({"alphas": torch.tensor(0.5)}, ValueError, "scalar"),
        ({"alphas": torch.ones(4, 5, dtype=torch.int64)}, TypeError, "floating-point"),
        ({"alphas": [0.5]}, TypeError, "alphas .*torch tensor"),
        ({"colors": torch.rand(4, 6, 3)}, ValueError, "shape of alphas"),
        ({"colors": torch.rand(4, 5)}, ValueError, "shape of alphas"),
        ({"colors": torch.rand(4, 5, 3, dtype=torch.float64)}, TypeError, "same dtype"),
        ({"colors": 1.0}, TypeError, "colors .*torch tensor"),
        ({"background": torch.rand(2)}, ValueError, "background must have shape"),
        ({"background": torch.rand(1, 3)}, ValueError, "background must have shape"),
        ({"background": 1.0}, TypeError, "background .*tensor"),
        ({"multiplier": Multiplier(torch.ones(4), 0.0)}, ValueError, "mean .*broadcast"),
        ({"multiplier": Multiplier(1.0, torch.ones(2, 4, 5))}, ValueError, "variance .*broadcast"),
    ],
)
def test_wrong_arguments_are_refused(change, error, message):
    good = {"alphas": torch.rand(4, 5), "colors": torch.rand(4, 5, 3), "multiplier": Multiplier.dropout(0.2)}
    with pytest.raises(error, match=message):
        pixel_moments(**(good | change))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("function", [pixel_moments, contributions, neutral_background, first_order_variance])
def test_colors_that_are_not_finite_are_refused_in_the_padding_too(function, bad):
    alphas, colors, _ = lists(3, 5)
    alphas[1, 4], colors[1, 4, 2] = 0.0, bad
    with pytest.raises(ValueError, match=r"colors .*finite"):
        function(alphas, colors, Multiplier.dropout(0.3))


def test_a_background_that_is_not_finite_is_refused():
    alphas, colors, _ = lists(3, 5)
    with pytest.raises(ValueError, match=r"background .*finite"):
        pixel_moments(alphas, colors, Multiplier.dropout(0.3), background=torch.tensor([0.0, math.nan, 0.0]).double())


def test_finite_colors_whose_sum_overflows_are_no_mistake():
    alphas, colors = torch.tensor([0.5, 0.5]), torch.tensor([[3e38], [3e38]])
    assert pixel_moments(alphas, colors, Multiplier.dropout(0.5)).mean.item() == pytest.approx(0.4375 * 3e38)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_short_dtypes_are_refused(dtype):
    with pytest.raises(TypeError, match=r"got torch\.b?float16; .*\.float"):
        alpha_moments(torch.full((5,), 0.5, dtype=dtype), Multiplier.dropout(0.5))
