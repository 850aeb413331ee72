"""SE-GS's perturbation against numpy and scipy, Gaussian by Gaussian."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ca_reg import Chain, Draw, GaussianDropout, Params
from ca_reg.regularizers.segs import SEGSNoise


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def params(n: int, step: int = 2_000) -> Params:
    g = seeded(3)
    return Params(
        0.05 + 0.9 * torch.rand(n, generator=g, dtype=torch.float64),
        means=5 * torch.randn(n, 3, generator=g, dtype=torch.float64),
        scales=torch.exp(torch.randn(n, 3, generator=g, dtype=torch.float64) - 3),
        quaternions=3 * torch.randn(n, 4, generator=g, dtype=torch.float64),
        step=step,
    )


def matrices(quaternions) -> np.ndarray:
    return Rotation.from_quat(quaternions.numpy()[:, [1, 2, 3, 0]]).as_matrix()  # scipy has xyzw


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_an_opacity_that_is_1_in_16_bits_does_not_drown_the_others(dtype):
    x = params(12, step=4_000)
    x = x._replace(opacities=x.opacities.index_fill(0, torch.tensor(3), 1.0).to(dtype))
    noisy, exact = (SEGSNoise()(x._replace(opacities=o), generator=seeded(5)).opacities for o in (x[0], x[0].double()))
    torch.testing.assert_close(noisy.double(), exact, rtol=0, atol=8 * torch.finfo(dtype).eps)


def test_all_is_as_in_the_source():
    x, step = params(12, step=4_000), 4_000
    out = SEGSNoise()(x, generator=seeded(5))
    ratio = 0.08 * (0.02 / 0.08) ** ((step - 2_000) / 7_500)
    g = seeded(5)

    def noisy(raw):
        amplitude = [max(np.mean([abs(row[k]) for row in raw]), 1.0) for k in range(raw.shape[1])]
        return raw + torch.randn(raw.shape, generator=g).double().numpy() * ratio * np.array(amplitude)

    opacity, scales = x.opacities.numpy()[:, None], x.scales.numpy()
    means = noisy(x.means.numpy())
    logits = noisy(np.log(opacity / (1 - opacity)))
    log_scales = noisy(np.log(scales))
    six = noisy(matrices(x.quaternions)[:, :2].reshape(-1, 6))
    np.testing.assert_allclose(out.means, means, rtol=1e-6)
    np.testing.assert_allclose(out.opacities, 1 / (1 + np.exp(-logits[:, 0])), rtol=1e-6)
    np.testing.assert_allclose(out.scales, np.exp(log_scales), rtol=1e-6)
    found = matrices(out.quaternions)
    for i in range(12):
        a, b = six[i, :3], six[i, 3:]
        a = a / math.sqrt(a @ a)
        b = b - (a @ b) * a
        b = b / math.sqrt(b @ b)
        np.testing.assert_allclose(found[i], np.stack([a, b, np.cross(a, b)]), atol=1e-6)


def test_the_noise_lasts_from_start_to_stop():
    generator = seeded()
    state = generator.get_state()
    for step in (0, 1_999, 9_500):
        x = params(4, step)
        noise = SEGSNoise()
        assert noise(x, generator=generator) is x
    assert torch.equal(generator.get_state(), state)
    for step in (2_000, 9_499):
        x = params(4, step)
        assert not torch.equal(SEGSNoise()(x, generator=generator).means, x.means)
    assert SEGSNoise().eval()(x) is x


def test_the_noise_is_normal_with_the_ratio():
    """Mean and variance of the noise of the scales within 4.5 standard errors: a false alarm in 1 of 100,000 seeds."""
    noise, x = SEGSNoise(), params(20_000)
    noise(x, generator=seeded(6))
    drawn = (noise.last.value[2] / (0.08 * x.scales.log().abs().mean(0))).flatten()
    assert abs(drawn.mean()) < 4.5 / drawn.numel() ** 0.5
    assert abs(drawn.var() - 1) < 4.5 * (2 / drawn.numel()) ** 0.5


def test_draws_replay_and_follow_their_generator_alone():
    noise, x, state = SEGSNoise(), params(6), torch.get_rng_state()
    first = noise(x, generator=seeded())
    assert torch.equal(state, torch.get_rng_state())
    for again in (noise(x, drawn=noise.last), noise(x, generator=seeded())):
        assert all(torch.equal(getattr(again, f), getattr(first, f)) for f in (*noise.needs, "opacities"))
    assert not torch.equal(noise(x, generator=seeded(1)).means, first.means)


def test_gradients_are_those_of_differences():
    x, noise = params(5), SEGSNoise()
    drawn = noise.draw(x, seeded())
    leaves = [t.clone().requires_grad_() for t in x[:4]]

    def replay(*raw):
        return noise.replay(Params(*raw), drawn)[:4]

    assert torch.autograd.gradcheck(replay, leaves)


def test_opacities_of_0_and_1_stay_and_have_finite_gradients():
    opacity = torch.tensor([0.0, 1.0, 0.5], dtype=torch.float64, requires_grad=True)
    x, noise = params(3)._replace(opacities=opacity), SEGSNoise()
    out = noise.replay(x, Draw(noise.draw(x, seeded()).value)).opacities
    out.sum().backward()
    assert out[:2].tolist() == [0.0, 1.0]
    assert bool(opacity.grad.isfinite().all())


def test_what_dropout_has_dropped_stays_dropped():
    chain = Chain(GaussianDropout(0.5), SEGSNoise())
    out = chain(params(40), generator=seeded())
    assert torch.equal(out.opacities == 0, ~chain.keep)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match=r"stop .*after start"):
        SEGSNoise(start=9_500)
    with pytest.raises(ValueError, match=r"values .*above 0"):
        SEGSNoise(last=0.0)
    with pytest.raises(ValueError, match="means, scales, quaternions"):
        SEGSNoise()(torch.full((3,), 0.5))
    assert SEGSNoise().alpha_factor(params(3)) is None
