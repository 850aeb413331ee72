"""Streaming moments and the jackknife, against numpy on all the renders at once in float64."""

import itertools
import math

import numpy as np
import pytest
import torch

from ca_reg._accumulate import Deviations, RenderMoments, jackknife_error, merge


def pooled(renders, visible, groups):
    moments = [RenderMoments() for _ in range(min(groups, len(renders)))]
    for k, (image, seen) in enumerate(zip(renders, visible, strict=True)):
        moments[k % len(moments)].add(image, seen)
    return moments, merge(moments)


@pytest.mark.parametrize("count", [2, 5, 8, 21])
def test_variance_of_almost_equal_float32_renders(count):
    # The trap: E[x^2] - E[x]^2 in float32 is wrong by several times the variance here, and often negative.
    renders = 0.9 + 1e-4 * torch.randn(count, 3, 11, 13, generator=torch.Generator().manual_seed(count))
    seen = torch.ones(count, 11, 13, dtype=torch.bool)
    _, total = pooled(renders, seen, groups=8)
    expected = renders.double().numpy().var(axis=0).mean(0)
    # float64 carries 16 digits, of which the ratio 0.9 / 1e-4 takes four.
    np.testing.assert_allclose((total.scatter / count).numpy(), expected, rtol=1e-11)
    np.testing.assert_allclose(total.mean.numpy(), renders.double().numpy().mean(0), rtol=1e-14)
    naive = renders.square().mean(0) - renders.mean(0).square()
    assert (naive.mean(0).numpy() / expected - 1).__abs__().max() > 0.5


def test_visible_pixels_are_the_intersection():
    seen = torch.rand(20, 11, 13, generator=torch.Generator().manual_seed(0)) > 0.05
    _, total = pooled(torch.rand(20, 3, 11, 13), seen, groups=8)
    assert torch.equal(total.visible, seen.all(0))
    assert total.visible.any()
    assert not total.visible.all()


@pytest.mark.parametrize(("count", "groups"), [(3, 8), (5, 8), (8, 8), (9, 8), (21, 8), (24, 8)])
def test_jackknife_agrees_with_leaving_the_renders_out(count, groups):
    generator = torch.Generator().manual_seed(count)
    renders = torch.rand(count, 3, 5, 6, generator=generator, dtype=torch.float64)
    seen = torch.rand(count, 5, 6, generator=generator) > 0.02
    moments, total = pooled(renders, seen, groups)

    x, region = renders.numpy(), seen.all(0).numpy()

    def value(which):
        return x[which].var(axis=0, ddof=1).mean(0)[region].mean()

    members = [np.arange(count) % len(moments) == g for g in range(len(moments))]
    ratios = np.array([count / own.sum() for own in members])
    left_out = np.array([value(~own) for own in members])
    pseudo = ratios * value(np.ones(count, dtype=bool)) - (ratios - 1) * left_out
    center = (pseudo / ratios).sum()
    expected = math.sqrt(np.mean((pseudo - center) ** 2 / (ratios - 1)))
    assert jackknife_error(moments, total) == pytest.approx(expected, rel=1e-10)


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
    moments, total = pooled(torch.rand(2, 3, 4, 4), torch.ones(2, 4, 4, dtype=torch.bool), 8)
    assert math.isnan(jackknife_error(moments, total))


@pytest.mark.parametrize("groups", [1, 2])
def test_renders_of_different_sizes_are_refused(groups):
    renders = [torch.rand(3, 4, 4), torch.rand(3, 4, 5)]
    with pytest.raises(ValueError, match="one size"):
        pooled(renders, [torch.ones(r.shape[1:], dtype=torch.bool) for r in renders], groups)
