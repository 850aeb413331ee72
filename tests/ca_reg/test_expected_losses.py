"""Expected pixel losses, against quadrature, simulation and the enumeration of all masks."""

import itertools
import math

import numpy as np
import pytest
import torch

from ca_reg.functional import Multiplier, expected_absolute_error, expected_squared_error, pixel_moments

ROUNDING = 1 / (255 * math.sqrt(12))


def cases(count=40, seed=0):
    """Means, variances and targets, float64, from residuals far below the standard deviation to far above."""
    g = torch.Generator().manual_seed(seed)
    mean, target = torch.rand(2, count, generator=g, dtype=torch.float64)
    return mean, 10 ** (-6 * torch.rand(count, generator=g, dtype=torch.float64)), target


def folded(d, s):
    """E |d + s z| by Gauss-Legendre on either side of the kink."""
    x, w = np.polynomial.legendre.leggauss(120)
    kink = min(max(-d / s, -12.0), 12.0)
    total = 0.0
    for low, high in ((-12.0, kink), (kink, 12.0)):
        z = low + (high - low) * (1 + x) / 2
        density = np.exp(-z * z / 2) / math.sqrt(2 * math.pi)
        total += (high - low) / 2 * float((w * density * np.abs(d + s * z)).sum())
    return total


def enumerate_dropout(pixels, n, p, high, residual, seed=0):
    """Every render of lists of n splats with the probability of its mask, their moments, and a target nearby."""
    g = torch.Generator().manual_seed(seed)
    alphas = high * torch.rand(pixels, n, generator=g, dtype=torch.float64)
    colors = torch.rand(pixels, n, 3, generator=g, dtype=torch.float64)
    background = torch.rand(pixels, 3, generator=g, dtype=torch.float64)
    masks = torch.tensor(list(itertools.product([0.0, 1.0], repeat=n)), dtype=torch.float64)
    light, renders = torch.ones(len(masks), pixels, 1, dtype=torch.float64), 0.0
    for i in range(n):
        alpha = masks[:, i, None, None] * alphas[None, :, i, None]
        renders = renders + alpha * light * colors[:, i]
        light = light * (1 - alpha)
    renders = renders + light * background
    moments = pixel_moments(alphas, colors, Multiplier.dropout(p), background=background)
    target = moments.mean + residual * torch.randn(pixels, 3, generator=g, dtype=torch.float64)
    probability = (p ** (1 - masks) * (1 - p) ** masks).prod(-1)[:, None, None]
    return renders, probability, *moments, target


@pytest.mark.parametrize("n", [1, 6])
def test_the_squared_error_equals_the_enumeration_of_all_masks(n):
    renders, probability, mean, variance, target = enumerate_dropout(50, n, 0.3, 0.99, 0.2)
    expected = (probability * (renders - target).square()).sum(0)
    torch.testing.assert_close(expected_squared_error(mean, variance, target), expected, rtol=1e-12, atol=1e-15)


def test_the_absolute_error_equals_quadrature_of_a_normal_pixel():
    mean, variance, target = cases()
    for min_std in (ROUNDING, 0.1):
        expected = [
            folded(d, math.sqrt(v + min_std**2))
            for d, v in zip((mean - target).tolist(), variance.tolist(), strict=True)
        ]
        result = expected_absolute_error(mean, variance, target, min_std=min_std)
        torch.testing.assert_close(result, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-15)
    default = expected_absolute_error(mean, variance, target)
    assert torch.equal(default, expected_absolute_error(mean, variance, target, min_std=ROUNDING))


def test_the_absolute_error_is_the_mean_over_draws_of_a_normal_pixel(generator):
    # False alarm: 10 cells at 5 standard errors, below 1e-5.
    mean, variance, target = cases(10)
    s = (variance + ROUNDING**2).sqrt()
    draws = (mean + s * torch.randn(100_000, 10, generator=generator, dtype=torch.float64) - target).abs()
    error = draws.std(0) / math.sqrt(len(draws))
    assert ((draws.mean(0) - expected_absolute_error(mean, variance, target)).abs() <= 5 * error).all()


def test_without_variance_it_is_the_absolute_error_of_the_mean():
    mean, _, target = cases()
    result = expected_absolute_error(mean, torch.zeros_like(mean), target, min_std=1e-6)
    torch.testing.assert_close(result, (mean - target).abs(), rtol=1e-14, atol=0)


def test_without_residual_it_is_the_mean_absolute_deviation():
    mean, variance, _ = cases()
    expected = (2 / math.pi * (variance + ROUNDING**2)).sqrt()
    torch.testing.assert_close(expected_absolute_error(mean, variance, mean), expected, rtol=1e-14, atol=0)


def test_the_floor_adds_at_most_what_is_said():
    mean, variance, target = cases()
    for d in (0.0, 1e-4, 1e-3, 0.1):
        for v in (torch.zeros_like(variance), variance):
            added = expected_absolute_error(mean + d, v, mean) - expected_absolute_error(
                mean + d, v, mean, min_std=1e-12
            )
            assert (added >= -1e-15).all()
            assert (added <= ROUNDING * math.sqrt(2 / math.pi) * (1 + 1e-12)).all()
    at_zero = expected_absolute_error(target, torch.zeros_like(variance), target)
    torch.testing.assert_close(at_zero * 255, torch.full_like(target, 0.2303), rtol=1e-3, atol=0)


def test_it_keeps_the_bounds_that_hold_for_every_distribution():
    mean, variance, target = cases(500)
    d, squares = (mean - target).abs(), variance + ROUNDING**2
    result = expected_absolute_error(mean, variance, target)
    assert (result >= d * (1 - 1e-14)).all()
    assert (result <= (d.square() + squares).sqrt() * (1 + 1e-14)).all()
    renders, probability, mean, variance, target = enumerate_dropout(200, 6, 0.3, 0.99, 0.1)
    exact = (probability * (renders - target).abs()).sum(0)
    assert (exact >= (mean - target).abs() * (1 - 1e-12)).all()
    assert (exact <= expected_squared_error(mean, variance, target).sqrt() * (1 + 1e-12)).all()


def test_the_gradients_are_the_closed_forms():
    mean, variance, target = (x.requires_grad_() for x in cases())
    result = expected_absolute_error(mean, variance, target)
    by_mean, by_variance, by_target = torch.autograd.grad(result.sum(), (mean, variance, target))
    s = (variance + ROUNDING**2).sqrt()
    z = (mean - target) / s
    torch.testing.assert_close(by_mean, 1 - 2 * torch.special.ndtr(-z), rtol=1e-12, atol=1e-14)
    assert torch.equal(by_target, -by_mean)
    density = (-z.square() / 2).exp() / math.sqrt(2 * math.pi)
    torch.testing.assert_close(by_variance, density / s, rtol=1e-10, atol=1e-30)


@pytest.mark.parametrize("loss", [expected_squared_error, expected_absolute_error])
def test_gradients_match_finite_differences(loss):
    mean, variance, target = cases(8)
    inputs = [x.requires_grad_() for x in (mean, 0.01 + variance, target)]
    assert torch.autograd.gradcheck(loss, inputs)
    assert torch.autograd.gradgradcheck(loss, inputs)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_stay_finite_without_variance_and_far_from_the_target(dtype):
    d = torch.tensor([0.0, 1e-30, 1e-10, 1e-3, 0.1, 1.0, 1e6, 1e20], dtype=dtype)
    d = torch.cat([d, -d])
    for v in (0.0, 1e-30, 1.0):
        mean, variance = d.clone().requires_grad_(), torch.full_like(d, v, requires_grad=True)
        result = expected_absolute_error(mean, variance, torch.zeros_like(d))
        by_mean, by_variance = torch.autograd.grad(result.sum(), (mean, variance))
        assert result.isfinite().all()
        assert (result >= d.abs()).all()
        assert (by_mean.abs() <= 1).all()
        assert (by_mean * d >= 0).all()
        assert (by_variance >= 0).all()
        assert by_variance.max() == pytest.approx(1 / math.sqrt(2 * math.pi * (v + ROUNDING**2)), rel=1e-5)
        far = d.abs() >= 1e6
        assert torch.equal(result[far], d[far].abs())
        assert torch.equal(by_mean[far], d[far].sign())
        assert (by_variance[far] < 1e-30).all()


def test_no_gradient_is_denormal():
    """Processors take many times as long for such numbers, and most pixels of a photograph are far from the target."""
    d, variance = torch.linspace(0, 1, 20_001), torch.zeros(20_001, requires_grad=True)
    mean = d.clone().requires_grad_()
    expected_absolute_error(mean, variance, torch.zeros_like(d)).sum().backward()
    for gradient in (mean.grad, variance.grad):
        assert ((gradient == 0) | (gradient >= torch.finfo(torch.float32).tiny)).all()


@pytest.mark.parametrize(
    ("residual", "pixelwise", "total", "without"), [(0.05, 0.18, 0.07, 0.50), (0.2, 0.09, 0.01, 0.10)]
)
def test_the_error_of_the_normal_approximation_is_as_stated(residual, pixelwise, total, without):
    # The numbers of the docstring, with a margin; the absolute error of the mean misses at least ``without``.
    renders, probability, mean, variance, target = enumerate_dropout(400, 8, 0.2, 0.99, residual)
    exact = (probability * (renders - target).abs()).sum(0)
    approximate = expected_absolute_error(mean, variance, target)
    assert (approximate / exact - 1).abs().mean() <= pixelwise
    assert (approximate / exact).max() <= 3
    assert (exact / approximate).max() <= 3
    assert abs(approximate.sum() / exact.sum() - 1) <= total
    assert 1 - (mean - target).abs().sum() / exact.sum() >= without


def test_float32_agrees_with_float64():
    exact = expected_absolute_error(*cases(500))
    single = expected_absolute_error(*(x.float() for x in cases(500)))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("loss", [expected_squared_error, expected_absolute_error])
def test_wrong_tensors_are_refused(loss):
    image = torch.rand(3, 4, 5)
    with pytest.raises(ValueError, match=r"target .*shape of mean"):
        loss(image, image, image[0])
    with pytest.raises(ValueError, match=r"variance .*shape of mean"):
        loss(image, image.mean(0), image)
    with pytest.raises(TypeError, match=r"target .*floating-point"):
        loss(image, image, torch.zeros(3, 4, 5, dtype=torch.uint8))
    with pytest.raises(TypeError, match=r"variance .*torch tensor"):
        loss(image, 0.1, image)


@pytest.mark.parametrize("min_std", [0.0, -0.1, 1e-25, math.nan])
def test_a_floor_that_is_none_is_refused(min_std):
    image = torch.rand(3, 4, 5)
    with pytest.raises(ValueError, match="min_std must be"):
        expected_absolute_error(image, image, image, min_std=min_std)
