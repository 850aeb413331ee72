"""Chains against enumeration of all their draws, and what they make of modules that know nothing of them."""

import itertools

import pytest
import torch
from torch import nn

from ca_reg import Chain, Draw, GaussianDropout, IndependentDropout, OpacityNoise, Params, Regularizer
from ca_reg.regularizers import REGULARIZERS
from ca_reg.regularizers.concrete import SoftDropout

OPACITY = torch.tensor([0.1, 0.45, 0.8, 0.97], dtype=torch.float64)


class ByOpacity(IndependentDropout):
    """Rates of its own for every Gaussian."""

    def rates(self, x):
        return 0.1 + 0.6 * x.opacities.detach()


class ScaleUp(Regularizer):
    """Changes something else than the opacities."""

    needs = ("scales",)
    drops = False

    def draw(self, x, generator=None):
        return Draw(1 + torch.rand(len(x.scales), 1, generator=generator))

    def replay(self, x, draw):
        return x._replace(scales=x.scales * draw.value)


def test_a_member_that_is_switched_off_asks_for_nothing():
    chain = Chain(ScaleUp().eval(), GaussianDropout(0.5))
    with pytest.raises(ValueError, match="needs scales"):
        Chain(ScaleUp(), GaussianDropout(0.5))(OPACITY)
    assert torch.equal(chain(OPACITY) > 0, chain.keep)


def all_masks(n):
    return [torch.tensor(mask) for mask in itertools.product([False, True], repeat=n)]


@pytest.mark.parametrize("compensate", [False, True])
def test_test_time_value_and_multiplier_are_the_mean_and_variance_over_all_masks(compensate):
    rule = ByOpacity(compensate=compensate)
    x = Params(OPACITY)
    rates = rule.rates(x)
    mean = torch.zeros_like(OPACITY)
    square = torch.zeros_like(OPACITY)
    for keep in all_masks(4):
        weight = torch.where(keep, 1 - rates, rates).prod()
        drawn = rule.replay(x, Draw(keep=keep)).opacities
        mean, square = mean + weight * drawn, square + weight * drawn**2
    torch.testing.assert_close(rule.expected(x).opacities, mean, rtol=1e-14, atol=0)
    raised, multiplier = rule.alpha_factor(x)
    torch.testing.assert_close(raised.opacities * multiplier.mean, mean, rtol=1e-14, atol=0)
    torch.testing.assert_close(raised.opacities**2 * multiplier.variance, square - mean**2, rtol=1e-12, atol=1e-16)


# Nodes and weights of the standard normal distribution: the mean over the noise to 1e-3, as the clamp has kinks.
_NODES = torch.linspace(-8, 8, 20_001, dtype=torch.float64)
_WEIGHTS = torch.exp(-(_NODES**2) / 2) / torch.exp(-(_NODES**2) / 2).sum()


@pytest.mark.parametrize("compensate", [False, True])
@pytest.mark.parametrize("noise_first", [False, True])
def test_the_test_time_value_of_dropout_and_noise_is_their_common_mean_in_either_order(noise_first, compensate):
    """`nn.Sequential` is wrong here: the noise of the second would be that of an opacity scaled by the first."""
    p, sigma = 0.3, 0.8
    factor = 1 + sigma * _NODES[:, None]
    survivors = OPACITY / (1 - p) if compensate else OPACITY
    noisy = (OPACITY * factor).clamp(0, 1) / OPACITY * survivors if noise_first else (survivors * factor).clamp(0, 1)
    mean = (1 - p) * (_WEIGHTS[:, None] * noisy).sum(0)
    members = [GaussianDropout(p, compensate=compensate), OpacityNoise(sigma, scale=True)]
    chain = Chain(*(members[::-1] if noise_first else members)).eval()
    torch.testing.assert_close(chain(OPACITY), mean, rtol=1e-6, atol=0)


def test_noise_in_eval_takes_the_survivors_of_compensated_dropout_that_trains():
    p, sigma = 0.3, 0.8
    chain = Chain(GaussianDropout(p, compensate=True), OpacityNoise(sigma, scale=True).eval())
    rendered = chain(OPACITY)
    survivors = OPACITY / (1 - p)
    assert survivors.max() > 1
    mean = (_WEIGHTS[:, None] * (survivors * (1 + sigma * _NODES[:, None])).clamp(0, 1)).sum(0)
    torch.testing.assert_close(rendered, chain.keep * mean, rtol=1e-6, atol=0)


def test_a_chain_drops_what_a_member_drops_and_replays():
    chain = Chain(GaussianDropout(0.5), ByOpacity(), OpacityNoise(0.5))
    opacity = torch.full((400,), 0.6)
    out = chain(opacity, generator=torch.Generator().manual_seed(1))
    first, second, _ = chain
    assert torch.equal(chain.keep, first.keep & second.keep)
    assert torch.equal(out, opacity * chain.keep * (1 + chain.last.value[2].value).clamp(0, 1 / 0.6))
    assert torch.equal(chain(opacity, drawn=chain.last), out)


def test_a_member_in_eval_gives_its_test_time_value_in_a_replay_as_well():
    chain = Chain(GaussianDropout(0.5), OpacityNoise(0.5))
    chain.members[0].eval()
    opacity = torch.full((400,), 0.6)
    out = chain(opacity)
    assert chain.keep is None
    assert torch.equal(out, 0.5 * opacity * (1 + chain.last.value[1].value).clamp(0, 1 / 0.3))
    assert torch.equal(chain(opacity, drawn=chain.last), out)


def test_a_draw_is_that_of_all_members_in_either_mode_and_leaves_no_trace():
    x, drawn = Params(torch.full((400,), 0.6)), []
    for chain in (
        Chain(GaussianDropout(0.5), OpacityNoise(0.5)),
        Chain(GaussianDropout(0.5), OpacityNoise(0.5)).eval(),
    ):
        draw = chain.draw(x, torch.Generator().manual_seed(2))
        assert chain.last is None
        drawn.append(chain.replay(x, draw).opacities)
    assert torch.equal(*drawn)
    assert bool((drawn[0] == 0).any())


def test_members_may_change_other_parameters_and_say_what_they_need():
    chain = Chain(GaussianDropout(0.5), ScaleUp())
    assert chain.needs == ("scales",)
    x = chain(Params(torch.full((6,), 0.5), scales=torch.ones(6, 3)))
    assert bool((x.scales > 1).all())
    with pytest.raises(ValueError, match=r"ScaleUp needs scales .*Params\("):
        chain(torch.full((6,), 0.5))


def test_a_chain_has_a_multiplier_only_if_every_member_has_one():
    assert Chain(GaussianDropout(0.5), ScaleUp()).alpha_factor(Params(OPACITY)) is None
    _, multiplier = Chain(GaussianDropout(0.5), ByOpacity()).alpha_factor(Params(OPACITY))
    expected = ByOpacity().alpha_factor(Params(OPACITY))[1]
    torch.testing.assert_close(multiplier.mean, 0.5 * expected.mean)


@pytest.mark.parametrize("first", [SoftDropout(), OpacityNoise(0.8, scale=True)], ids=["soft", "noise"])
def test_noise_behind_a_factor_that_is_not_0_or_1_has_no_multiplier(first):
    second, opacity = OpacityNoise(0.8, scale=True), torch.tensor([0.6], dtype=torch.float64)
    chain, many = Chain(first, second), opacity.expand(40_000)
    torch.manual_seed(0)
    draws = chain(many)
    product = opacity * first.alpha_factor(Params(opacity))[1].mean * second.alpha_factor(Params(opacity))[1].mean
    assert (draws.mean() - product).abs() > 10 * draws.std() / len(draws) ** 0.5  # what the multipliers would say
    assert chain.alpha_factor(Params(opacity)) is None
    torch.testing.assert_close(chain.eval()(opacity), second(first(opacity)))
    assert Chain(OpacityNoise(0.8), SoftDropout()).alpha_factor(Params(opacity)) is not None


class Halves(nn.Module):
    """Knows nothing of this package."""

    def __init__(self):
        super().__init__()
        self.inner = GaussianDropout(lambda step: step / 100)

    def forward(self, opacity):
        return opacity * torch.tensor([0.0, 1.0]).repeat(len(opacity) // 2) if self.training else opacity * 0.5


def test_foreign_modules_are_members():
    chain = Chain(nn.Sequential(GaussianDropout(0.0), nn.Sequential(Halves())))
    opacity = torch.full((6,), 0.5)
    chain.set_step(30)
    assert torch.equal(chain(opacity) > 0, torch.tensor([False, True] * 3))
    assert chain.keep.tolist() == [False, True] * 3
    assert list(chain)[1].module.inner.step == 30
    module = list(chain)[1].module
    torch.testing.assert_close(chain.expected(Params(opacity, step=50)).opacities, opacity * 0.5)
    assert module.training, "the module itself is not touched"
    assert module.inner.step == 30
    with pytest.raises(TypeError, match="torch module"):
        Chain(torch.relu)


def test_a_chain_holds_the_rates_of_its_members():
    chain = Chain(GaussianDropout(lambda step: step / 100), GaussianDropout(0.5)).eval()
    chain.hold(20)
    chain.set_step(90)
    torch.testing.assert_close(chain(OPACITY), 0.8 * 0.5 * OPACITY)


def test_the_multiplier_of_a_finished_model_does_not_come_from_the_neighbors_of_training():
    generator = torch.Generator().manual_seed(0)
    first, last = (Params(torch.full((40,), 0.5), torch.randn(40, 3, generator=generator), step=step)
                   for step in (1, 20))  # fmt: skip
    chain = Chain(REGULARIZERS.make_one("density"), GaussianDropout(0.5))
    chain(first)
    expected = Chain(REGULARIZERS.make_one("density"), GaussianDropout(0.5)).alpha_factor(last)[1]
    assert torch.equal(chain.test_alpha_factor(last)[1].mean, expected.mean)
    assert not torch.equal(chain.alpha_factor(last)[1].mean, expected.mean)


class FirstAlone(Chain):
    """Does something else with its members."""

    def regularize(self, x, generator=None):
        x = (first := next(iter(self))).regularize(x, generator)
        self.last = first.last
        return x


def test_a_chain_of_another_kind_stays_what_it_is_in_a_chain():
    chain = Chain(FirstAlone(GaussianDropout(0.5), OpacityNoise(0.5)), Chain(GaussianDropout(0.0)))
    opacity = torch.full((400,), 0.6)
    assert torch.equal(chain(opacity), opacity * chain.keep)
    assert len(chain) == 2


class AtMost(nn.Module):
    """Like those of this package, it takes the generator of a draw."""

    def forward(self, opacity, generator=None):
        return opacity.clamp(max=0.6)


def test_a_foreign_module_keeps_its_place_at_test_time():
    dropout, noise = GaussianDropout(0.5), OpacityNoise(0.8, scale=True)
    for members in ((AtMost(), dropout), (noise, AtMost(), dropout), (dropout, AtMost())):
        torch.testing.assert_close(Chain(*members).eval()(OPACITY), nn.Sequential(*members).eval()(OPACITY))
    chain = Chain(AtMost(), dropout, noise).train()
    draws = torch.stack([chain(OPACITY, generator=torch.Generator().manual_seed(i)) for i in range(4_000)])
    error = draws.std(0) / len(draws) ** 0.5
    assert ((draws.mean(0) - chain.eval()(OPACITY)).abs() < 5 * error).all()  # false alarm: 6e-7 for each of four


def test_a_bare_tensor_meets_the_step_that_a_member_was_told():
    dropout = GaussianDropout(lambda step: 0.9 * (step >= 50))
    chain, opacity = Chain(OpacityNoise(0.0), nn.Sequential(dropout)), torch.full((1000,), 0.5)
    assert chain(opacity) is opacity
    dropout.set_step(50)
    assert chain.step == 50
    assert (chain(opacity) == 0).any()
    chain.set_step(0)  # also back
    assert chain(opacity) is opacity


@pytest.mark.parametrize("wrap", [lambda dropout: dropout, Chain, nn.Sequential])
def test_parameters_without_a_step_meet_the_one_that_a_member_was_told(wrap):
    dropout = GaussianDropout(lambda step: 0.9 * (step >= 50))
    module, x = wrap(dropout), Params(torch.full((1000,), 0.5))
    assert module(x) is x
    dropout.set_step(50)
    drawn = module(x)
    assert (drawn.opacities == 0).any()
    assert drawn.step == x.step
    assert torch.equal(dropout(x, drawn=dropout.last).opacities, drawn.opacities)
    torch.testing.assert_close(module.eval()(x).opacities, 0.1 * x.opacities)
    earlier = x._replace(step=49)  # a step that is given counts
    assert module.train()(earlier) is earlier


@pytest.mark.parametrize("name", [*REGULARIZERS])
def test_parameters_may_have_a_column_of_opacities(name):
    rates = {"dropout": "(0.5)", "noise": "(0.8, scale=True)", "clustered": "(0.5)", "position_noise": "(0.1)"}
    x = Params(
        torch.rand(20), torch.rand(20, 3), torch.rand(20, 3), torch.rand(20, 4), torch.rand(20, 16, 3), torch.eye(4),
        {"dropout_logits": torch.zeros(20)}, step=3000,
    )  # fmt: skip
    column = x._replace(opacities=x.opacities[:, None])
    module = REGULARIZERS.make_one(name + rates.get(name, ""))
    for training in (True, False):
        module.train(training)
        flat, other = (module(given, generator=torch.Generator().manual_seed(0)) for given in (x, column))
        assert torch.equal(other.opacities, flat.opacities[:, None])
        assert other.opacities is column.opacities or flat.opacities is not x.opacities
        assert all(torch.equal(a, b) for a, b in zip(flat[1:6], other[1:6], strict=True))


def test_the_text_of_a_regularizer_has_its_arguments():
    class Fade(IndependentDropout):
        rate_name = "speed"

        def __init__(self, speed, share=0.5):
            super().__init__(speed)
            self.share = share

    assert repr(Fade(0.1)) == "Fade(speed=0.1, share=0.5)"
    for kind, name in ((Fade, "speed"), (IndependentDropout, "the rate")):
        with pytest.raises(ValueError, match=rf"^{name} must .*\[0, 1\), got 1\.5"):
            kind(1.5)
        with pytest.raises(ValueError, match=rf"^{name} at step 9 .*\[0, 1\), got 1\.5"):
            kind(lambda step: 1.5).set_step(9)
