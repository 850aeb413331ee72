"""The mean of clamped noise against the package's own draws, their gradients, and the module that uses it."""

import math

import pytest
import torch
from torch import nn

from ca_reg import Draw, GaussianDropout, OpacityNoise
from ca_reg.functional import expected_opacity, opacity_noise, scale_opacity
from ca_reg.schedules import LinearRamp

OPACITY = torch.tensor([0.02, 0.3, 0.6, 0.9, 0.999, 1.0], dtype=torch.float64)
DRAWS = 100_000


def rows_of(regularizer, opacity):
    """Regularized opacities of many independent draws, shape (DRAWS, N)."""
    return regularizer(opacity.repeat(DRAWS)).view(DRAWS, -1)


def assert_mean(draws, expected):
    """Five standard errors: false alarm 6e-7 a comparison, and there are six in a call."""
    error = draws.std(0) / math.sqrt(DRAWS)
    assert ((draws.mean(0) - expected).abs() <= 5 * error).all()


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("sigma", [0.1, 0.8, 3.0])
def test_it_is_the_mean_of_the_packages_own_draws(sigma, clip):
    generator = torch.Generator().manual_seed(3)
    draws = rows_of(lambda o: opacity_noise(o, sigma, clip=clip, generator=generator)[0], OPACITY)
    expected = expected_opacity(OPACITY, sigma, clip=clip)
    assert_mean(draws, expected)
    assert (expected[-1] - OPACITY[-1]).abs() > 50 * draws[:, -1].std() / math.sqrt(DRAWS)  # the plain one is refuted


@pytest.mark.parametrize("clip", [False, True])
def test_its_gradient_is_the_mean_gradient_of_the_draws(clip):
    generator, inside = torch.Generator().manual_seed(4), OPACITY[:-1]  # at 1 the clamp has a kink
    many, leaf = inside.repeat(DRAWS).requires_grad_(), inside.clone().requires_grad_()
    opacity_noise(many, 0.8, clip=clip, generator=generator)[0].sum().backward()
    expected_opacity(leaf, 0.8, clip=clip).sum().backward()
    assert_mean(many.grad.view(DRAWS, -1), leaf.grad)
    assert (leaf.grad < 1).any()
    assert (leaf.grad > 0).all()


def test_the_mean_under_dropout_and_noise_scales_last():
    """In the order of the trainer, dropout first."""
    torch.manual_seed(5)
    draws = rows_of(nn.Sequential(GaussianDropout(0.4), OpacityNoise(0.8)), OPACITY)
    mean = scale_opacity(expected_opacity(OPACITY, 0.8), 0.4)
    assert_mean(draws, mean)
    other = expected_opacity(scale_opacity(OPACITY, 0.4), 0.8)
    assert ((draws.mean(0) - other).abs() > 20 * draws.std(0) / math.sqrt(DRAWS)).any()


@pytest.mark.parametrize("compensate", [False, True])
def test_modules_with_the_noise_first_return_their_own_mean(compensate):
    torch.manual_seed(6)
    chain = nn.Sequential(OpacityNoise(0.8, scale=True), GaussianDropout(0.4, compensate=compensate))
    draws = rows_of(chain, OPACITY)
    assert_mean(draws, chain.eval()(OPACITY))


def test_dropout_and_noise_commute_in_training():
    noise, dropout = OpacityNoise(0.8), GaussianDropout(0.4)
    one = dropout(noise(OPACITY))
    assert torch.equal(noise(dropout(OPACITY, drawn=dropout.last), drawn=noise.last), one)


def test_the_module_scales_at_the_present_sigma_and_only_in_evaluation():
    noise = OpacityNoise(LinearRamp(0.0, 0.8, 0, 100), clip=True, scale=True)
    assert noise.eval()(OPACITY) is OPACITY
    noise.set_step(50)
    assert torch.equal(noise(OPACITY), expected_opacity(OPACITY, 0.4, clip=True))
    assert noise.noise is None
    drawn, plain = (
        module.train()(OPACITY, generator=torch.Generator().manual_seed(7))
        for module in (OpacityNoise(0.8, scale=True), OpacityNoise(0.8))
    )
    assert torch.equal(drawn, plain)
    assert "scale=True" in repr(noise)
    with pytest.raises(ValueError, match="eval"):
        noise.eval()(OPACITY, drawn=Draw(torch.zeros(6)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_shape_and_type_stay(dtype):
    column = OPACITY.to(dtype)[:, None]
    expected = expected_opacity(column, 0.8)
    assert (expected.shape, expected.dtype) == (column.shape, dtype)
    torch.testing.assert_close(expected[:, 0], expected_opacity(column[:, 0], 0.8))
    assert expected.min() >= 0
    assert expected.max() <= 1
    assert expected_opacity(column, 0.0) is column
    assert expected_opacity(torch.empty(0), 0.8).shape == (0,)


@pytest.mark.parametrize(
    ("opacity", "sigma", "error", "message"),
    [
        (torch.rand(3, 2), 0.8, ValueError, "shape"),
        (torch.tensor(0.5), 0.8, ValueError, "shape"),
        (torch.ones(3, dtype=torch.int64), 0.8, TypeError, "floating-point"),
        ([0.5], 0.8, TypeError, "tensor"),
        (torch.tensor([1.5]), 0.8, ValueError, "opacity must be activated"),
        (OPACITY, -0.1, ValueError, "sigma .*at least 0"),
        (OPACITY, math.nan, ValueError, "sigma must be finite"),
        (OPACITY, "0.8", TypeError, "real number"),
    ],
)
def test_what_makes_no_sense_is_refused(opacity, sigma, error, message):
    with pytest.raises(error, match=message):
        expected_opacity(opacity, sigma)
