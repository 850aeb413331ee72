"""Soft masks against numpy's arithmetic of the formula, and their moments against adaptive integration over u."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from ca_reg import Chain, GaussianDropout, Params
from ca_reg.regularizers import parse
from ca_reg.regularizers.concrete import ConcreteDropout, SoftDropout, concrete_moments


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def with_logits(n: int, dtype=torch.float32) -> Params:
    g = seeded(4)
    logits = torch.randn(n, generator=g).to(dtype) * 2
    scales = torch.rand(n, 3, generator=g).to(dtype) + 0.1
    return Params(torch.rand(n, generator=g).to(dtype), scales=scales, learned={"dropout_logits": logits})


def uniform(n: int, seed: int) -> np.ndarray:
    """The u or q that a generator of this seed gives."""
    return torch.rand(n, generator=seeded(seed)).double().numpy()


def test_concrete_is_the_paper_s_formula():
    x = with_logits(7, torch.float64)
    out = ConcreteDropout()(x, generator=seeded(5))
    for i, u in enumerate(uniform(7, 5)):
        p = 1 / (1 + math.exp(-float(x.learned["dropout_logits"][i])))
        z = 1 / (1 + math.exp(-(math.log(p) - math.log(1 - p) + math.log(u) - math.log(1 - u)) / 0.1))
        assert float(out.opacities[i]) == pytest.approx(float(x.opacities[i]) * (1 - z), rel=1e-4, abs=1e-12)


@pytest.mark.parametrize("by_size", [False, True])
def test_soft_is_the_formula_of_ugod(by_size):
    x = with_logits(40, torch.float64)
    soft = SoftDropout(0.3, by_size=by_size, temperature=0.2)
    out = soft(x, generator=seeded(6))
    sizes = [max(of) for of in x.scales.tolist()]
    seen = set()
    for i, q in enumerate(uniform(40, 6)):
        smaller = sum(size < sizes[i] for size in sizes)
        u = 0.6 * (smaller + 0.5) / 40 if by_size else 0.3
        omega = 1 - 1 / (1 + math.exp(-(math.log(u / (1 - u)) + math.log(q / (1 - q))) / 0.2))
        seen.add(omega < 0.2)
        assert float(out.opacities[i]) == pytest.approx(float(x.opacities[i]) * min(max(omega, 0.2), 0.8), rel=1e-4)
    assert seen == {False, True}
    assert soft.needs == (("scales",) if by_size else ())


# Moments


@pytest.mark.parametrize("temperature", [0.05, 0.1, 0.2, 0.7])
@pytest.mark.parametrize("floor", [0.0, 0.2])
def test_moments_are_the_integrals_over_u(temperature, floor):
    logits = torch.tensor([-6.0, -2.0, -0.3, 0.0, 0.7, 3.0, 6.0], dtype=torch.float64)
    mean, variance = concrete_moments(logits, temperature, floor)
    for i, a in enumerate(logits.tolist()):

        def integral(power, a=a):
            def integrand(v):  # over the logistic variable v = logit u
                z = 1 / (1 + math.exp(min(max(-(a + v) / temperature, -700), 700)))
                density = math.exp(-abs(v)) / (1 + math.exp(-abs(v))) ** 2
                return min(max(1 - z, floor), 1 - floor) ** power * density

            kinks = [-a] if floor == 0 else [-a - temperature * math.log(4), -a, -a + temperature * math.log(4)]
            edges = sorted([-50 - abs(a), *(-a + temperature * k for k in (-20, 20)), *kinks, 50 + abs(a)])
            return sum(quad(integrand, *ends, epsabs=1e-13, epsrel=1e-12, limit=200)[0] for ends in pairwise(edges))

        first, second = integral(1), integral(2)
        assert float(mean[i]) == pytest.approx(first, rel=1e-9)
        assert float(variance[i]) == pytest.approx(second - first**2, rel=1e-8, abs=1e-11)


def test_moments_tend_to_those_of_dropout():
    p = torch.tensor([0.1, 0.5, 0.8], dtype=torch.float64)
    mean, variance = concrete_moments(p.logit(), 1e-4)
    torch.testing.assert_close(mean, 1 - p, rtol=1e-4, atol=0)
    torch.testing.assert_close(variance, p * (1 - p), rtol=1e-3, atol=0)


def test_moments_are_differentiable_and_the_same_for_a_number():
    logits = torch.tensor([-3.0, -0.4, 0.8, 2.5], dtype=torch.float64, requires_grad=True)
    for floor in (0.0, 0.2):
        assert torch.autograd.gradcheck(lambda a, f=floor: concrete_moments(a, 0.1, f), logits)
        of_tensor = tuple(m[2].item() for m in concrete_moments(logits, 0.1, floor))
        assert concrete_moments(0.8, 0.1, floor) == pytest.approx(of_tensor, rel=1e-12)


def test_moments_of_extreme_rates_do_not_cancel():
    """Float32 against float64; a difference of two means of squares would leave nothing of a variance of 1e-7."""
    logits = torch.tensor([-16.0, -9.0, 9.0, 16.0])
    for low, high in zip(concrete_moments(logits, 0.1), concrete_moments(logits.double(), 0.1), strict=True):
        torch.testing.assert_close(low.double(), high, rtol=1e-5, atol=0)


@pytest.mark.parametrize("rule", [ConcreteDropout(), SoftDropout(0.3), SoftDropout(0.3, by_size=True)])
def test_the_test_time_value_and_the_multiplier_are_mean_and_variance_of_the_draws(rule):
    """Each of 2 x 60 within 4.5 standard errors: a false alarm in 1 of 1,200 seeds; the seed is fixed."""
    x = with_logits(60, torch.float64)
    generator = seeded(8)
    factors = torch.stack([rule.regularize(x, generator).opacities / x.opacities for _ in range(1_000)])
    same, multiplier = rule.alpha_factor(x)
    assert same is x
    assert rule.renders_mean
    mean, variance = (
        torch.as_tensor(m, dtype=torch.float64).expand(60) for m in (multiplier.mean, multiplier.variance)
    )
    torch.testing.assert_close(rule.eval()(x).opacities, x.opacities * mean)
    rule.train()
    assert bool(((factors.mean(0) - mean).abs() <= 4.5 * (variance / 1_000).sqrt()).all())
    spread = (factors - factors.mean(0)).square()
    assert bool(((spread.mean(0) - variance).abs() <= 4.5 * spread.std(0) / 1_000**0.5 + 1e-6).all())


# As modules


@pytest.mark.parametrize("rule", [ConcreteDropout(), SoftDropout(by_size=True)])
def test_draws_replay_and_follow_their_generator_alone(rule):
    x, state = with_logits(9), torch.get_rng_state()
    first = rule(x, generator=seeded())
    assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(rule(x, drawn=rule.last).opacities, first.opacities)
    assert torch.equal(rule(x, generator=seeded()).opacities, first.opacities)
    assert not torch.equal(rule(x, generator=seeded(1)).opacities, first.opacities)
    assert rule.keep is None
    assert not rule.drops


def test_the_rates_learn_from_draws_and_from_the_expectation():
    x = with_logits(5, torch.float64)
    opacities, logits = x.opacities.clone().requires_grad_(), x.learned["dropout_logits"].clone().requires_grad_()
    rule = ConcreteDropout(temperature=0.7)
    drawn = rule.draw(x, seeded())

    def render(o, a):
        y = Params(o, learned={"dropout_logits": a})
        return rule.replay(y, drawn).opacities, rule.expected(y).opacities

    assert torch.autograd.gradcheck(render, (opacities, logits))


def test_a_draw_at_the_end_of_the_interval_is_harmless():
    """``torch.rand`` gives 0 in one of 17 million draws, whose logit is infinite."""
    x = with_logits(1)
    logits = x.learned["dropout_logits"].clone().requires_grad_()
    rule = ConcreteDropout()
    drawn = rule.draw(x)._replace(value=torch.tensor([-math.inf]))
    out = rule.replay(x._replace(learned={"dropout_logits": logits}), drawn).opacities
    out.sum().backward()
    assert torch.equal(out, x.opacities)
    assert torch.equal(logits.grad, torch.zeros(1))


def test_a_chain_multiplies_the_means():
    x = with_logits(6, torch.float64)
    chain = Chain(GaussianDropout(0.5), SoftDropout(0.3)).eval()
    torch.testing.assert_close(chain(x).opacities, 0.5 * SoftDropout(0.3).eval()(x).opacities)


def test_arguments_are_checked_and_constants_are_the_sources():
    concrete, soft = parse("concrete + soft")
    assert concrete.temperature == 0.1
    assert concrete.learns["dropout_logits"].start == pytest.approx(math.log(0.1 / 0.9))
    assert (soft.temperature, soft.floor) == (0.1, 0.2)
    with pytest.raises(ValueError, match=r"needs learned\['dropout_logits'\]"):
        concrete(torch.full((3,), 0.5))
    for bad, message in (
        (lambda: ConcreteDropout(0.0), r"p must be in \(0, 1\)"),
        (lambda: SoftDropout(1.0), r"u must be in \(0, 1\)"),
        (lambda: SoftDropout(0.6, by_size=True), r"u must be in \(0, 0.5\]"),
        (lambda: ConcreteDropout(temperature=0.0), "temperature must be above 0"),
        (lambda: SoftDropout(floor=0.5), r"in \[0, 0.5\)"),
    ):
        with pytest.raises(ValueError, match=message):
            bad()
