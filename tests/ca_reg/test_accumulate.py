"""Streaming moments and the jackknife, against numpy on all the renders at once in float64."""

import itertools
import math

import numpy as np
import pytest
import torch

from ca_reg._accumulate import Deviations, RenderMoments


def pooled(renders, groups):
    moments = RenderMoments(groups)
    for image in renders:
        moments.add(image)
    return moments


def two_passes(renders):
    return renders.double().numpy().var(axis=0).mean(0)


def draws(count, seed=0):
    return torch.randn(count, 3, 11, 13, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("groups", [1, 8])
@pytest.mark.parametrize("count", [2, 5, 8, 21, 256])
def test_variance_of_almost_equal_float32_renders(count, groups):
    # The trap: E[x^2] - E[x]^2 in float32 is wrong by several times the variance here, and often negative.
    renders = 0.9 + 1e-4 * draws(count)
    expected = two_passes(renders)
    variance = pooled(renders, groups).variance(0)
    assert variance.dtype == torch.float64
    # Rounding is 1.2e-7; the first render is at most a few standard deviations from the mean, whose square it costs.
    np.testing.assert_allclose(variance.numpy(), expected, rtol=1e-5)
    naive = renders.square().mean(0) - renders.mean(0).square()
    assert (naive.mean(0).numpy() / expected - 1).__abs__().max() > 0.5


@pytest.mark.parametrize("groups", [1, 8])
@pytest.mark.parametrize("spread", [1e-6, 1e-3, 1.0])
def test_variance_of_float64_renders(groups, spread):
    renders = 0.9 + spread * draws(40).double()
    # One rounding of the renders is 1.1e-16, of up to 0.9 + 4 spread: the deviations are exact below that.
    np.testing.assert_allclose(pooled(renders, groups).variance(0).numpy(), two_passes(renders), rtol=1e-13)


@pytest.mark.parametrize("groups", [1, 8])
@pytest.mark.parametrize("count", [5, 64, 1000])
def test_variance_where_only_the_first_render_differs(count, groups):
    """The worst case: the square of the mean deviation is count - 1 times the variance."""
    renders = torch.rand(1, 3, 11, 13, generator=torch.Generator().manual_seed(1)).expand(count, -1, -1, -1).clone()
    renders[0] += 0.1 * draws(1)[0]
    variance = pooled(renders, groups).variance(0).numpy()
    assert (variance >= 0).all()
    np.testing.assert_allclose(variance, two_passes(renders), rtol=count**2 * 1.2e-7)


def test_equal_renders_have_no_variance_at_all():
    moments = pooled(torch.rand(1, 3, 11, 13).expand(20, -1, -1, -1), 8)
    assert not moments.variance(0).any()
    assert moments.jackknife_error(torch.ones(11, 13, dtype=torch.bool)) == 0


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_is_summed_in_float32(kind):
    renders = torch.rand(12, 3, 11, 13, generator=torch.Generator().manual_seed(0)).to(kind)
    np.testing.assert_allclose(pooled(renders, 8).variance(0).numpy(), two_passes(renders), rtol=1e-5)


def test_a_buffer_that_the_renderer_fills_again_is_copied():
    renders, buffer, moments = draws(6), torch.empty(3, 11, 13), RenderMoments(4)
    for image in renders:
        moments.add(buffer.copy_(image))
    np.testing.assert_allclose(moments.variance(0).numpy(), two_passes(renders), rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "groups"), [(3, 8), (5, 8), (8, 8), (9, 8), (21, 8), (24, 8)])
def test_jackknife_agrees_with_leaving_the_renders_out(count, groups, dtype):
    generator = torch.Generator().manual_seed(count)
    renders = 0.9 + 1e-3 * torch.rand(count, 3, 5, 6, generator=generator, dtype=torch.float64).to(dtype)
    visible = torch.rand(5, 6, generator=generator) > 0.3

    x, region, groups = renders.double().numpy(), visible.numpy(), min(groups, count)

    def value(which):
        return x[which].var(axis=0, ddof=1).mean(0)[region].mean()

    members = [np.arange(count) % groups == g for g in range(groups)]
    ratios = np.array([count / own.sum() for own in members])
    left_out = np.array([value(~own) for own in members])
    pseudo = ratios * value(np.ones(count, dtype=bool)) - (ratios - 1) * left_out
    center = (pseudo / ratios).sum()
    expected = math.sqrt(np.mean((pseudo - center) ** 2 / (ratios - 1)))
    # What is left of the values when their differences are taken, some 1 % of them each.
    error = pooled(renders, groups).jackknife_error(visible)
    assert error == pytest.approx(expected, rel={torch.float32: 1e-4, torch.float64: 1e-9}[dtype])


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_autocast_does_not_reduce_the_precision_of_the_jackknife(kind):
    """The sums of 32 renders over the pixels of a row have products above 65504, the largest number of float16."""
    renders = torch.randint(0, 2, (256, 1, 1, 1), generator=torch.Generator().manual_seed(0)).float()
    moments, visible = pooled(renders.expand(-1, 3, 2, 2000), 8), torch.ones(2, 2000, dtype=torch.bool)
    with torch.autocast("cpu", dtype=kind):
        error = moments.jackknife_error(visible)
    assert error == moments.jackknife_error(visible) > 0


@pytest.mark.parametrize(("n", "count"), [(3, 3), (2, 4), (1, 5)])
def test_the_squared_error_of_an_adaptive_score_is_its_variance_on_average(n, count):
    """Over all tuples of masks at rate 1/2, exactly. With one Gaussian every mask is equally far from the mean."""
    generator = torch.Generator().manual_seed(n)
    parts = torch.rand(n, 3, 4, 5, generator=generator, dtype=torch.float64)
    renders = torch.stack([torch.einsum("n,nchw->chw", torch.tensor(mask).double(), parts)
                           for mask in itertools.product([0.0, 1.0], repeat=n)])  # fmt: skip
    visible = torch.rand(4, 5, generator=generator) > 0.4
    values, squares = [], []
    for which in itertools.product(range(2**n), repeat=count):
        deviations = Deviations(renders.mean(0), visible)
        for k in which:
            deviations.add(renders[k])
        values.append(renders[list(which)].var(dim=0, unbiased=True).mean(0)[visible].mean().item())
        squares.append(deviations.std_error() ** 2)
    assert np.mean(squares) == pytest.approx(np.var(values), rel=1e-10)


def test_two_renders_have_no_error_estimate():
    assert math.isnan(pooled(torch.rand(2, 3, 4, 4), 8).jackknife_error(torch.ones(4, 4, dtype=torch.bool)))


@pytest.mark.parametrize("groups", [1, 2])
def test_renders_of_different_sizes_are_refused(groups):
    renders = [torch.rand(3, 4, 4), torch.rand(3, 4, 5)]
    with pytest.raises(ValueError, match="one size"):
        pooled(renders, groups)
