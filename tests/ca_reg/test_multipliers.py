"""Moments of the random factor, against quadrature of its definition and against the package's own draws."""

import math

import numpy as np
import pytest
import torch

from ca_reg.functional import Multiplier, draw_keep_mask, opacity_noise

SIGMAS = [1e-3, 0.05, 0.3, 0.8, 1.0, 2.5, 10.0, 1e3]
OPACITIES = [1e-12, 1e-4, 0.1, 0.3, 0.4, 0.5, 0.8, 0.95, 0.99, 1 - 1e-4, 1 - 1e-12, 1.0]


def quadrature(opacity, sigma, clip):
    """E and Var of clamp(g o (1 + eps), 0, 1) / min(g o, 1) by Gauss-Legendre panels that end at every kink."""
    kinks = [-1.0, 1.0, -1 / sigma, (1 / opacity - 1) / sigma]
    panels = np.unique(np.clip([*kinks, *np.linspace(-12, 12, 25)], -12, 12))
    x, w = np.polynomial.legendre.leggauss(24)
    half = np.diff(panels)[:, None] / 2
    z = panels[:-1, None] + half * (1 + x)
    weight = half * w * np.exp(-z * z / 2) / math.sqrt(2 * math.pi)
    factor = np.clip(1 + sigma * (np.clip(z, -1, 1) if clip else z), 0, 1 / opacity) * max(opacity, 1.0)
    mean = (weight * factor).sum()
    return mean, (weight * (factor - mean) ** 2).sum()


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_clamped_noise_agrees_with_quadrature(clip, dtype, tolerance):
    opacity = torch.tensor(OPACITIES, dtype=dtype)
    for sigma in SIGMAS:
        expected = np.array([quadrature(o, sigma, clip) for o in opacity.double().tolist()])
        noise = Multiplier.clamped_noise(opacity, sigma, clip=clip)
        assert noise.mean.dtype == noise.variance.dtype == dtype
        np.testing.assert_allclose(noise.mean.numpy(), expected[:, 0], rtol=tolerance)
        np.testing.assert_allclose(noise.variance.numpy(), expected[:, 1], rtol=tolerance)


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
@pytest.mark.parametrize("gain", [1.25, 2.0, 100.0])
def test_clamped_noise_of_survivors_agrees_with_quadrature(gain, dtype, tolerance, clip):
    opacity = gain * torch.tensor(OPACITIES, dtype=dtype)
    for sigma in (0.05, 0.3, 0.8, 2.5):
        expected = np.array([quadrature(o, sigma, clip) for o in opacity.double().tolist()])
        noise = Multiplier.clamped_noise(opacity, sigma, clip=clip)
        np.testing.assert_allclose(noise.mean.numpy(), expected[:, 0], rtol=tolerance)
        # What the draws leave below 1 is a difference of numbers of the size of (gain o)^2.
        np.testing.assert_allclose(noise.variance.numpy(), expected[:, 1], rtol=tolerance, atol=4e-15 * gain**2)


@pytest.mark.parametrize("clip", [False, True])
def test_far_from_the_clamp_the_noise_is_the_plain_one(clip):
    small = torch.tensor([0.0, 1e-5], dtype=torch.float64)
    noise, plain = Multiplier.clamped_noise(small, 0.1, clip=clip), Multiplier.opacity_noise(0.1, clip=clip)
    torch.testing.assert_close(noise.mean, torch.ones_like(small), rtol=1e-13, atol=0)
    torch.testing.assert_close(noise.variance, torch.full_like(small, plain.variance), rtol=1e-13, atol=0)


def test_without_noise_nothing_is_random():
    noise = Multiplier.clamped_noise(torch.tensor([0.0, 0.5, 1.0]), 0.0)
    assert torch.equal(noise.mean, torch.ones(3))
    assert torch.equal(noise.variance, torch.zeros(3))
    assert Multiplier.opacity_noise(0.0, clip=True).variance == 0.0


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("sigma", [0.3, 0.8, 3.0])
def test_clamped_noise_describes_the_packages_own_draws(clip, sigma):
    n = 200_000
    for o in (0.05, 0.7, 1.0):
        opacity = torch.full((n,), o, dtype=torch.float64)
        noisy, _ = opacity_noise(opacity, sigma, clip=clip, generator=torch.Generator().manual_seed(7))
        factor, expected = noisy / opacity, Multiplier.clamped_noise(opacity[:1], sigma, clip=clip)
        scatter = (factor - expected.mean).square()
        # 5 standard errors each: false alarm 6e-7 a comparison, 2e-5 in all 36.
        assert (factor.mean() - expected.mean).abs() < 5 * factor.std() / math.sqrt(n)
        assert (scatter.mean() - expected.variance).abs() < 5 * scatter.std() / math.sqrt(n)


def test_dropout_describes_the_packages_own_masks():
    n, p = 200_000, 0.3
    keep = draw_keep_mask(n, p, generator=torch.Generator().manual_seed(7)).double()
    for compensate, factor in ((False, keep), (True, keep / (1 - p))):
        expected = Multiplier.dropout(p, compensate=compensate)
        scatter = (factor - expected.mean).square()
        # 5 standard errors: false alarm 6e-7 a comparison.
        assert abs(factor.mean() - expected.mean) < 5 * factor.std() / math.sqrt(n)
        assert abs(scatter.mean() - expected.variance) < 5 * scatter.std() / math.sqrt(n)


def test_the_clipped_draw_keeps_the_variance_of_a_clipped_normal():
    inside = math.erf(1 / math.sqrt(2))
    closed = inside - 2 * math.exp(-0.5) / math.sqrt(2 * math.pi) + (1 - inside)
    assert Multiplier.opacity_noise(2.0, clip=True).variance == pytest.approx(4 * closed, rel=1e-14)


def test_the_product_has_the_moments_of_the_product():
    # Two-point factors with given mean and spread, all four combinations.
    first, second = Multiplier(0.7, 0.3**2), Multiplier(torch.tensor([1.2, 0.0]).double(), 0.5**2)
    outcomes = torch.stack([(0.7 + s * 0.3) * (second.mean + t * 0.5) for s in (-1, 1) for t in (-1, 1)])
    product = first * second
    torch.testing.assert_close(product.mean, outcomes.mean(0), rtol=1e-14, atol=0)
    torch.testing.assert_close(product.variance, outcomes.var(0, correction=0), rtol=1e-14, atol=0)


def test_a_product_with_small_variances_does_not_cancel():
    tiny = Multiplier(1.0, 1e-20) * Multiplier(1.0, 2e-20)
    assert tiny.variance == pytest.approx(3e-20, rel=1e-14)
    same = Multiplier.dropout(0.3) * Multiplier(1.0, 0.0)
    assert (same.mean, same.variance) == (0.7, 0.3 * 0.7)


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("gain", [1.0, 1.7])
def test_clamped_noise_is_differentiable(gain, clip):
    # Away from the kinks that the clipped draw has at g o = 1 / (1 + sigma), and the factor at g o = 1.
    opacity = torch.tensor([0.05, 0.3, 0.5, 0.8, 0.97], dtype=torch.float64, requires_grad=True)

    def moments(o):
        noise = Multiplier.clamped_noise(gain * o, 0.8, clip=clip)
        return noise.mean, noise.variance

    assert torch.autograd.gradcheck(moments, (opacity,))


@pytest.mark.parametrize("clip", [False, True])
def test_the_gradient_at_an_opacity_of_one_is_that_from_below(clip):
    opacity = torch.tensor([1.0, 1 - 1e-9], dtype=torch.float64, requires_grad=True)
    noise = Multiplier.clamped_noise(opacity, 0.8, clip=clip)
    for moment in (noise.mean, noise.variance):
        (gradient,) = torch.autograd.grad(moment.sum(), opacity, retain_graph=True)
        torch.testing.assert_close(gradient[0], gradient[1], rtol=1e-6, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sigma", [1e-6, 0.8, 10.0])
def test_gradients_stay_finite_at_the_ends_of_the_range(sigma, dtype):
    opacity = torch.tensor([0.0, 1e-38, 1e-7, 1.0], dtype=dtype, requires_grad=True)
    noise = Multiplier.clamped_noise(opacity, sigma)
    assert noise.mean.isfinite().all()
    (noise.mean + noise.variance).sum().backward()
    assert opacity.grad.isfinite().all()


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Multiplier.dropout(1.0), ValueError, r"\[0, 1\)"),
        (lambda: Multiplier.opacity_noise(-0.1), ValueError, "sigma must be finite"),
        (lambda: Multiplier.opacity_noise(1e200), ValueError, "finite"),
        (lambda: Multiplier.clamped_noise(torch.tensor([-0.2]), 0.1), ValueError, "opacity must be activated"),
        (lambda: Multiplier.clamped_noise(torch.tensor([torch.nan]), 0.1), ValueError, "opacity must be activated"),
        (lambda: Multiplier.clamped_noise(torch.tensor([1]), 0.1), TypeError, "floating-point"),
        (lambda: Multiplier.clamped_noise(torch.tensor([0.5]), math.inf), ValueError, "sigma must be finite"),
        (lambda: Multiplier(-1.0, 0.0), ValueError, "mean of a multiplier"),
        (lambda: Multiplier(1.0, torch.tensor([0.1, -0.1])), ValueError, "variance of a multiplier"),
        (lambda: Multiplier(torch.tensor(math.nan), 0.0), ValueError, "mean of a multiplier"),
        (lambda: Multiplier("1", 0.0), TypeError, "real number"),
    ],
)
def test_wrong_arguments_are_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
