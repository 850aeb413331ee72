"""The rates of density-based dropout against loops over all pairs."""

import pytest
import torch
from clouds import KINDS, cloud, mean_distance, params, rank

from ca_reg import Chain, OpacityNoise
from ca_reg.regularizers.surroundings import DensityDropout


@pytest.mark.parametrize("k", [1, 3, 7])
@pytest.mark.parametrize("kind", KINDS)
def test_rates_follow_from_the_rank_of_the_density(kind, k):
    points = cloud(kind)
    expected = 0.2 + 0.3 * rank(-mean_distance(points, k))
    rates = DensityDropout(k=k).rates(params(points))
    torch.testing.assert_close(rates, torch.from_numpy(expected), rtol=1e-12, atol=0)
    torch.testing.assert_close(rates.mean(), torch.tensor(0.35, dtype=rates.dtype))


def test_test_time_is_that_of_the_paper_and_the_multiplier_exact():
    x = params(cloud("spread"))
    rule = DensityDropout()
    rates = rule.rates(x)
    torch.testing.assert_close(rule.expected(x).opacities, x.opacities * (1 - rates))
    raised, multiplier = rule.alpha_factor(x)
    torch.testing.assert_close(raised.opacities * multiplier.mean, x.opacities * (1 - rates))
    torch.testing.assert_close(multiplier.variance, rates * (1 - rates))
    assert DensityDropout(scale=False).expected(x) is x
    torch.testing.assert_close(DensityDropout(compensate=True).alpha_factor(x)[0].opacities, x.opacities / (1 - rates))


def test_the_test_time_value_does_not_depend_on_the_steps_before():
    first, second = params(cloud("spread"), step=10), params(cloud("duplicates"), step=20)
    rule = DensityDropout()
    fresh = rule.expected(second).opacities
    rule.draw(first)
    assert torch.equal(rule.rates(second), rule.rates(first))  # in training they are those of step 10
    assert torch.equal(rule.expected(second).opacities, fresh)
    chain = Chain(rule, OpacityNoise(0.8, scale=True))
    noisy = OpacityNoise(0.8, scale=True).expected(second).opacities
    torch.testing.assert_close(chain.expected(second).opacities, noisy * fresh / second.opacities)
    assert torch.equal(rule.rates(second), rule.rates(first))  # and the next draw is what it would have been


def test_a_test_time_value_without_what_it_needs_is_an_error_with_a_name():
    with pytest.raises(ValueError, match="DensityDropout needs means"):
        Chain(DensityDropout()).eval()(torch.ones(3))


@pytest.mark.parametrize("bad", [{"low": -0.1}, {"high": 1.0}, {"k": 0}, {"every": 0}])
def test_what_is_refused(bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))} must be"):
        DensityDropout(**bad)
