"""The modules against their functional twins, and the state they keep."""

import copy
import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import nn

from ca_reg import CAScore, Chain, Draw, GaussianDropout, OpacityNoise, Params, functional
from ca_reg.schedules import Constant, LinearRamp, StartStop

OPACITY = torch.linspace(0.05, 0.95, 40)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("shape", [(40,), (40, 1)])
@pytest.mark.parametrize("compensate", [False, True])
def test_dropout_is_its_functional_twin(shape, compensate):
    opacity, dropout = OPACITY.reshape(shape), GaussianDropout(0.3, compensate=compensate)
    expected, keep = functional.gaussian_dropout(opacity, 0.3, compensate=compensate, generator=seeded())
    assert torch.equal(dropout(opacity, generator=seeded()), expected)
    assert torch.equal(dropout.keep, keep)
    dropout.eval()
    evaluated = dropout(opacity)
    assert evaluated is opacity if compensate else torch.equal(evaluated, functional.scale_opacity(opacity, 0.3))
    assert dropout.keep is None


@pytest.mark.parametrize("clip", [False, True])
def test_noise_is_its_functional_twin(clip):
    module = OpacityNoise(0.8, clip=clip)
    expected, noise = functional.opacity_noise(OPACITY, 0.8, clip=clip, generator=seeded())
    assert torch.equal(module(OPACITY, generator=seeded()), expected)
    assert torch.equal(module.noise, noise)
    assert module.eval()(OPACITY) is OPACITY
    assert module.noise is None


def test_draws_are_replayed_bit_for_bit_without_drawing():
    dropout, noise = GaussianDropout(0.5), OpacityNoise(0.5)
    first = dropout(OPACITY), noise(OPACITY)
    keep, eps = dropout.keep, noise.noise
    dropout(OPACITY), noise(OPACITY)
    before = torch.get_rng_state()
    assert torch.equal(dropout(OPACITY, drawn=Draw(keep=keep)), first[0])
    assert torch.equal(noise(OPACITY, drawn=Draw(eps)), first[1])
    assert dropout.keep is keep
    assert noise.noise is eps
    assert torch.equal(torch.get_rng_state(), before)


def test_a_draw_is_compensated_for_the_rate_that_it_was_drawn_at():
    dropout = GaussianDropout(LinearRamp(0.0, 0.5, 0, 10), compensate=True)
    dropout.set_step(4)
    first, draw = dropout(OPACITY), dropout.last
    torch.testing.assert_close(first, OPACITY * draw.keep / 0.8)
    dropout.set_step(10)
    assert torch.equal(dropout(OPACITY, drawn=draw), first)


def test_nothing_to_do_returns_the_same_tensor_and_no_draw():
    before = torch.get_rng_state()
    for module in (GaussianDropout(0.0), OpacityNoise(0.0), GaussianDropout(0.0).eval(), OpacityNoise(0.3).eval()):
        assert module(OPACITY) is OPACITY
    assert GaussianDropout(0.0).keep is None
    assert torch.equal(torch.get_rng_state(), before)


def test_they_compose():
    chain = nn.Sequential(GaussianDropout(0.2), OpacityNoise(0.8))
    out = chain(OPACITY)
    keep, noise = chain[0].keep, chain[1].noise
    torch.testing.assert_close(out, (OPACITY * keep * (1 + noise)).clamp(0, 1))
    torch.testing.assert_close(chain.eval()(OPACITY), OPACITY * 0.8)


def test_noise_accepts_the_large_opacities_of_compensated_dropout():
    out = nn.Sequential(GaussianDropout(0.9, compensate=True), OpacityNoise(0.1))(OPACITY)
    assert out.max() <= 1


def test_the_rate_follows_the_step():
    dropout, noise = GaussianDropout(LinearRamp(0.0, 0.2, 0, 100)), OpacityNoise(StartStop(0.4, start=50))
    assert dropout(OPACITY) is OPACITY
    assert noise(OPACITY) is OPACITY
    for module in (dropout, noise):
        module.set_step(50)
    assert dropout.p == pytest.approx(0.1)
    assert noise.sigma == 0.4
    expected, _ = functional.gaussian_dropout(OPACITY, dropout.p, generator=seeded())
    assert torch.equal(dropout(OPACITY, generator=seeded()), expected)
    torch.testing.assert_close(dropout.eval()(OPACITY), OPACITY * 0.9)


def test_logits_are_recognized_at_the_first_call():
    for module in (GaussianDropout(0.2), OpacityNoise(0.2), GaussianDropout(0.2).eval()):
        with pytest.raises(ValueError, match="sigmoid"):
            module(torch.randn(50))
        with pytest.raises(ValueError, match=r"from nan to nan; .*diverged"):
            module(OPACITY.clone().index_fill_(0, torch.tensor(7), torch.nan))


def test_a_draw_cannot_be_replayed_in_eval_nor_on_another_number_of_gaussians():
    dropout, noise = GaussianDropout(0.2), OpacityNoise(0.2)
    dropout(OPACITY), noise(OPACITY)
    keep, eps = dropout.keep, noise.noise
    with pytest.raises(ValueError, match="draw again"):
        dropout(OPACITY[:-1], drawn=Draw(keep=keep))
    with pytest.raises(ValueError, match="draw again"):
        noise(OPACITY[:-1], drawn=Draw(eps))
    with pytest.raises(ValueError, match="eval"):
        dropout.eval()(OPACITY, drawn=Draw(keep=keep))
    with pytest.raises(ValueError, match="eval"):
        noise.eval()(OPACITY, drawn=Draw(eps))


@pytest.mark.parametrize(
    "make",
    [
        lambda: GaussianDropout(1.0),
        lambda: GaussianDropout(-0.1),
        lambda: OpacityNoise(-1),
        lambda: GaussianDropout(Constant(1.0)),
        lambda: OpacityNoise(Constant(-1.0)),
    ],
)
def test_rates_are_checked_at_construction(make):
    with pytest.raises(ValueError, match="must be"):
        make()


@pytest.mark.parametrize("rate", [None, torch.tensor(0.2), torch.full((40,), 0.2)], ids=["none", "scalar", "(N,)"])
def test_a_rate_that_is_no_number_is_refused(rate):
    """One per Gaussian is for the functions; in a module a subclass of IndependentDropout defines them."""
    for kind, name in ((GaussianDropout, "p"), (OpacityNoise, "sigma")):
        with pytest.raises(TypeError, match=f"^{name} must .*number, got {type(rate).__name__}"):
            kind(rate)
        with pytest.raises(TypeError, match=f"^{name} at step 3 .*got {type(rate).__name__}"):
            kind(lambda step: rate).set_step(3)


def test_a_schedule_that_leaves_the_range_is_refused_with_its_step():
    dropout = GaussianDropout(lambda step: step / 100)
    with pytest.raises(ValueError, match="p at step 100"):
        dropout.set_step(100)


def test_unknown_keywords_raise():
    with pytest.raises(TypeError):
        GaussianDropout(0.2)(OPACITY, genrator=seeded())
    with pytest.raises(TypeError):
        OpacityNoise(0.2, clipped=True)


def test_printing_shows_the_arguments():
    assert repr(GaussianDropout(0.2)) == "GaussianDropout(p=0.2, compensate=False)"
    assert "LinearRamp(" in repr(OpacityNoise(LinearRamp(0.0, 0.8, 0, 10)))


@pytest.mark.parametrize("shape", [(6,), (6, 2)])
@pytest.mark.parametrize("dtype", [torch.int32, torch.float32])
def test_mask_radii_zeroes_the_dropped_and_nothing_else(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    dropout = GaussianDropout(p=0.5)
    radii = torch.arange(1, 1 + torch.Size(shape).numel()).reshape(shape).to(dtype)
    keep = torch.tensor([True, False, True, True, False, False])
    dropout(torch.full((6,), 0.5), drawn=Draw(keep=keep))
    masked = dropout.mask_radii(radii)
    assert masked.dtype == dtype
    assert torch.equal(masked[keep], radii[keep])
    assert not masked[~keep].any()
    with pytest.raises(ValueError, match="6 Gaussians"):
        dropout.mask_radii(radii[:5])
    dropout.eval()
    dropout(torch.full((6,), 0.5))
    assert dropout.mask_radii(radii) is radii


# --- steps, huge noise, threads ---


def test_step_0_is_a_step():
    module = GaussianDropout(LinearRamp(0.0, 0.5, 0, 100))
    module.set_step(100)
    opacity = torch.full((1000,), 0.5)
    assert module(Params(opacity, step=0)).opacities is opacity
    assert bool((module(Params(opacity)).opacities == 0).any())
    assert CAScore(flat, regularizer=module, samples=2)(Params(opacity, step=0), None).value == 0
    assert CAScore(flat, regularizer=module, samples=2)(Params(opacity), None).value > 0


def flat(opacity, view):
    return opacity.mean().expand(3, 2, 2), torch.ones(2, 2)


@pytest.mark.parametrize("sigma", [1e39, 1e31, float("inf")])
def test_noise_that_would_overflow_is_refused(sigma):
    with pytest.raises(ValueError, match="sigma"):
        OpacityNoise(sigma)
    with pytest.raises(ValueError, match="sigma"):
        functional.opacity_noise(torch.zeros(3), sigma)
    with pytest.raises(ValueError, match="sigma"):
        OpacityNoise(LinearRamp(0.0, 1e39, 0, 1)).set_step(1)


def test_the_largest_noise_leaves_an_opacity_of_0_as_it_is():
    assert not OpacityNoise(1e30)(torch.zeros(10_000)).any()


@pytest.mark.parametrize("module", [GaussianDropout(0.5), Chain(OpacityNoise(0.1), GaussianDropout(0.5))])
def test_each_thread_has_its_own_mask(module):
    opacity = torch.full((64,), 0.5)
    barrier = threading.Barrier(8)

    def work(_):
        barrier.wait()
        wrong = 0
        for _ in range(300):
            dropped = module(opacity) == 0
            time.sleep(0)  # let another thread draw
            wrong += not torch.equal(module.keep, ~dropped)
        return wrong

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(work, range(8))) == 0
    # A thread that has never called it, such as one that runs hooks of a backward pass, sees the latest mask.
    assert ThreadPoolExecutor(1).submit(lambda: module.keep).result() is not None


def test_masks_survive_neither_copies_nor_pickles():
    module = GaussianDropout(0.5)
    module(torch.full((9,), 0.5))
    keep = module.keep
    for twin in (copy.deepcopy(module), pickle.loads(pickle.dumps(module)), copy.copy(module)):
        assert twin.keep is None
        assert twin(torch.full((9,), 0.5)).shape == (9,)
        twin.eval()(torch.full((9,), 0.5))
    assert module.keep is keep


def test_masks_drawn_outside_are_mapped_over():
    opacity, keep = torch.rand(4, 50), torch.rand(4, 50) > 0.5
    assert torch.equal(torch.vmap(functional.apply_dropout)(opacity, keep), opacity * keep)


def test_one_module_twice_in_a_chain_drops_twice():
    dropout, opacity = GaussianDropout(0.5), torch.full((1000,), 0.5)
    chain = Chain(nn.Sequential(dropout, dropout))
    dropped = chain(opacity) == 0
    assert torch.equal(chain.keep, ~dropped)
    assert 0.65 < dropped.double().mean() < 0.85  # 3/4; 5 standard deviations are 0.07
