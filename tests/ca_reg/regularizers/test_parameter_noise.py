"""Scale and SH noise against loops over the paper's formula, and the statistics of their draws."""

import numpy as np
import pytest
import torch

from ca_reg import Chain, GaussianDropout, OpacityNoise, Params
from ca_reg.regularizers import parse
from ca_reg.regularizers.noise import ParameterNoise, ScaleNoise, SHNoise
from ca_reg.schedules import StartStop

KINDS = [(ScaleNoise, "scales", (3,)), (SHNoise, "sh", (9, 3))]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def params(n: int, dtype=torch.float32) -> Params:
    g = seeded(7)
    return Params(
        torch.rand(n, generator=g).to(dtype),
        scales=torch.rand(n, 3, generator=g).to(dtype) + 0.1,
        sh=torch.randn(n, 9, 3, generator=g).to(dtype),
    )


@pytest.mark.parametrize(("kind", "field", "shape"), KINDS)
def test_each_number_is_multiplied_by_one_plus_its_own_noise(kind, field, shape):
    x = params(5, torch.float64)
    noise = kind(0.9)
    out = noise(x, generator=seeded())
    before, after, drawn = (y.numpy() for y in (getattr(x, field), getattr(out, field), noise.noise))
    assert drawn.shape == (5, *shape)
    below_zero = 0
    for index in np.ndindex(*before.shape):
        literal = before[index] * (np.float32(1) + drawn[index])  # the draw is float32
        below_zero += literal < 0 < before[index]
        # A scale enters a covariance by its square alone.
        assert after[index] == pytest.approx(abs(literal) if field == "scales" else literal, rel=1e-12)
    assert below_zero > 0
    assert all(getattr(out, name) is getattr(x, name) for name in x._fields if name != field)


@pytest.mark.parametrize(("kind", "field", "shape"), KINDS)
def test_the_noise_is_normal_with_the_given_deviation(kind, field, shape):
    """Mean, variance and share beyond one deviation within 4.5 standard errors: a false alarm in 1 of 50,000 seeds."""
    noise = kind(0.3)
    noise(params(20_000), generator=seeded(3))
    drawn = noise.noise.double().flatten() / 0.3
    n = drawn.numel()
    assert abs(drawn.mean()) < 4.5 / n**0.5
    assert abs(drawn.var() - 1) < 4.5 * (2 / n) ** 0.5
    assert abs((drawn.abs() > 1).double().mean() - 0.3173) < 4.5 * (0.3173 * 0.6827 / n) ** 0.5
    clipped = kind(0.3, clip=True)
    clipped(params(20_000), generator=seeded(3))
    assert torch.equal(clipped.noise, noise.noise.clamp(-torch.tensor(0.3), torch.tensor(0.3)))


@pytest.mark.parametrize(("kind", "field", "shape"), KINDS)
def test_draws_replay_and_follow_their_generator_alone(kind, field, shape):
    noise, x = kind(), params(6)
    state = torch.get_rng_state()
    first = noise(x, generator=seeded())
    assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(getattr(noise(x, drawn=noise.last), field), getattr(first, field))
    assert torch.equal(getattr(noise(x, generator=seeded()), field), getattr(first, field))
    assert not torch.equal(getattr(noise(x, generator=seeded(1)), field), getattr(first, field))
    assert noise.keep is None


@pytest.mark.parametrize(("kind", "field", "shape"), KINDS)
def test_nothing_is_drawn_without_noise_or_in_evaluation(kind, field, shape):
    x, generator = params(6), seeded()
    state = generator.get_state()
    late = kind(StartStop(0.5, start=10))
    for noise, step in ((kind(0.0), 0), (kind(0.5).eval(), 0), (late, 9)):
        assert noise(x._replace(step=step), generator=generator) == x._replace(step=step)
        assert noise.noise is None
    assert torch.equal(generator.get_state(), state)
    late(x._replace(step=10), generator=generator)
    assert late.noise is not None


@pytest.mark.parametrize(("kind", "field", "shape"), KINDS)
def test_bad_input_is_refused(kind, field, shape):
    with pytest.raises(ValueError, match=r"sigma .*at least 0"):
        kind(-0.1)
    with pytest.raises(ValueError, match=f"needs {field}"):
        kind()(torch.full((4,), 0.5))
    assert kind().alpha_factor(params(4)) is None
    assert not kind.drops


def test_the_defaults_are_those_with_the_paper_s_best_psnr():
    chain = parse("scale_noise + sh_noise")
    assert [member.sigma for member in chain] == [0.2, 0.1]


def test_opacity_noise_is_of_the_same_kind():
    """And is what it was: clamped, with a draw of the shape (N,)."""
    opacity = torch.tensor([[0.9], [0.5]])
    noise = OpacityNoise(3.0)
    out = noise(opacity, generator=seeded(2))
    assert isinstance(noise, ParameterNoise)
    assert noise.noise.shape == (2,)
    torch.testing.assert_close(out[:, 0], (opacity[:, 0] * (1 + noise.noise)).clamp(0, 1))


def test_gradients_pass_to_what_is_perturbed():
    x = params(4, torch.float64)
    scales = x.scales.clone().requires_grad_()
    chain = Chain(GaussianDropout(0.5), ScaleNoise(0.9))
    out = chain(x._replace(scales=scales), generator=seeded())
    out.scales.sum().backward()
    factor = 1 + list(chain)[1].noise.double()
    torch.testing.assert_close(scales.grad, factor * factor.sign())
