"""Opacity noise, against its closed-form moments."""

import math

import pytest
import torch

from ca_reg.functional import apply_opacity_noise, draw_opacity_noise, opacity_noise

OPACITY = torch.tensor([0.1, 0.4, 0.7, 1.0, 0.25, 0.0], dtype=torch.float64)


def clipped_variance():
    """E[clip(x, -1, 1)^2] of a standard normal x, in closed form."""
    inside = math.erf(1 / math.sqrt(2))
    density = math.exp(-0.5) / math.sqrt(2 * math.pi)
    return (inside - 2 * density) + (1 - inside)


@pytest.mark.parametrize(("clip", "variance"), [(False, 1.0), (True, clipped_variance())])
def test_noise_has_the_stated_variance(clip, variance):
    n, sigma = 400_000, 0.4
    noise = draw_opacity_noise(n, sigma, clip=clip, generator=torch.Generator().manual_seed(1)).double() / sigma
    # 5 standard deviations of a mean and of a mean square (kurtosis at most 3): false alarm 6e-7 a comparison.
    assert abs(noise.mean().item()) < 5 * math.sqrt(variance / n)
    assert abs(noise.square().mean().item() - variance) < 5 * math.sqrt(2 / n) * variance


def test_the_clipped_draw_is_the_other_one_clipped():
    plain, clipped = (
        draw_opacity_noise(1000, 0.8, clip=clip, generator=torch.Generator().manual_seed(5)) for clip in (False, True)
    )
    assert (plain.abs() > 0.8).any()
    torch.testing.assert_close(clipped, plain.clamp(-0.8, 0.8))


def test_noise_multiplies_and_the_result_stays_in_range():
    noise = torch.tensor([0.5, -0.5, 1.0, 0.1, -3.0, 2.0])
    expected = [min(max(o * (1 + e), 0.0), 1.0) for o, e in zip(OPACITY.tolist(), noise.double().tolist(), strict=True)]
    torch.testing.assert_close(apply_opacity_noise(OPACITY, noise), torch.tensor(expected, dtype=torch.float64))
    assert OPACITY[0] == 0.1


def test_gradient_is_the_factor_inside_the_range_and_zero_outside():
    opacity = OPACITY.clone().requires_grad_()
    noise = torch.tensor([0.5, -0.5, 1.0, 0.5, -3.0, 2.0])
    apply_opacity_noise(opacity, noise).sum().backward()
    torch.testing.assert_close(opacity.grad, torch.tensor([1.5, 0.5, 0.0, 0.0, 0.0, 3.0], dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_noise_does_not_depend_on_the_dtype_which_is_kept(dtype):
    noisy, noise = opacity_noise(OPACITY.to(dtype), 0.3, generator=torch.Generator().manual_seed(3))
    assert noisy.dtype == dtype
    assert torch.equal(noise, draw_opacity_noise(6, 0.3, generator=torch.Generator().manual_seed(3)))


def test_a_generator_leaves_the_global_state_alone_and_zero_draws_nothing():
    before = torch.get_rng_state()
    opacity_noise(OPACITY, 0.3, generator=torch.Generator().manual_seed(0))
    out, noise = opacity_noise(OPACITY, 0.0)
    assert out is OPACITY
    assert noise is None
    assert torch.equal(torch.get_rng_state(), before)


def test_a_column_of_opacities_behaves_like_a_vector():
    noise = draw_opacity_noise(6, 0.3)
    column = apply_opacity_noise(OPACITY[:, None], noise)
    assert column.shape == (6, 1)
    assert torch.equal(column[:, 0], apply_opacity_noise(OPACITY, noise))


@pytest.mark.parametrize("sigma", [-0.1, float("nan"), float("inf")])
def test_sigmas_outside_the_range_are_refused(sigma):
    with pytest.raises(ValueError, match=r"sigma .*finite"):
        opacity_noise(OPACITY, sigma)


def test_noise_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"noise .*shape \(6,\)"):
        apply_opacity_noise(OPACITY, torch.zeros(6, 1))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_short_opacities_are_rounded_once(dtype):
    # Rounding 1 + noise as well had made the error of some up to twice the half unit in the last place.
    generator = torch.Generator().manual_seed(0)
    opacity = torch.rand(2000, generator=generator).to(dtype)
    noise = 0.3 * torch.randn(2000, generator=generator)
    expected = (opacity.double() * (1 + noise.double())).clamp(0, 1).to(dtype)
    differs = apply_opacity_noise(opacity, noise) != expected
    assert differs.double().mean() < 0.001  # ties of the float32 product
