"""Opacity decay: the opacities of decayed logits in float64 and at their limits, and what a training sees of it."""

import math

import pytest
import torch

from ca_reg.decay import OpacityDecay
from ca_reg.functional import decayed_logits


@pytest.mark.parametrize("factor", [1e-3, 0.5, 0.995, 1.0])
def test_the_opacity_is_multiplied(factor):
    logits = torch.linspace(-8.0, 8.0, 101, dtype=torch.float64)
    torch.testing.assert_close(decayed_logits(logits, factor).sigmoid(), factor * logits.sigmoid(), rtol=1e-12, atol=0)
    single = decayed_logits(logits.float(), factor).double()  # an ulp of the larger of two terms of about 8
    torch.testing.assert_close(single, torch.logit(factor * logits.float().double().sigmoid()), rtol=0, atol=4e-6)


def test_at_its_limits_the_logit_is_that_of_the_factor_and_of_a_faint_opacity():
    ends = decayed_logits(torch.tensor([300.0, -14.0, -15.999, -300.0]), 0.9)
    expected = torch.tensor([math.log(9), -14 + math.log(0.9), -16.0, -16.0])
    torch.testing.assert_close(ends, expected, rtol=1e-6, atol=0)
    assert (ends.sigmoid() > 0).all()  # which a hook takes for dropout


def test_nothing_is_lost_with_a_factor_of_one():
    logits = torch.tensor([-300.0, -17.0, 3.0])
    assert torch.equal(decayed_logits(logits, 1), logits)


def test_a_training_decays_after_its_steps_and_keeps_the_optimizers_state():
    logits = torch.nn.Parameter(torch.tensor([0.3, -2.0, 5.0]).reshape(3, 1))
    optimizer, decay = torch.optim.Adam([logits], lr=0.0), OpacityDecay(0.9, start=2)
    start = logits.detach().sigmoid()
    for step in range(1, 6):
        logits.sigmoid().sum().backward()
        optimizer.step()
        moments = {name: x.clone() for name, x in optimizer.state[logits].items()}
        decay(logits, step)
        assert all(torch.equal(x, moments[name]) for name, x in optimizer.state[logits].items())
        torch.testing.assert_close(logits.detach().sigmoid(), start * 0.9 ** max(0, step - 2), rtol=1e-5, atol=0)
    assert logits.is_leaf
    assert repr(decay) == "OpacityDecay(0.9, start=2)"


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: OpacityDecay(0.0), ValueError, r"factor must be in \(0, 1\], got 0.0"),
        (lambda: OpacityDecay(1.1), ValueError, r"factor must be in \(0, 1\], got 1.1"),
        (lambda: OpacityDecay("0.9"), TypeError, "factor must be a real number, got str"),
        (lambda: OpacityDecay(start=-1), ValueError, "start must be at least 0"),
        (lambda: OpacityDecay()([0.5], 501), TypeError, "logits must be a torch tensor, got list; give the parameter"),
        (lambda: OpacityDecay()(torch.zeros(2).bfloat16(), 501), TypeError, "bfloat16"),
        (
            lambda: OpacityDecay()(torch.tensor([1, 2]), 501),
            TypeError,
            "must be a floating-point tensor, got torch.int64",
        ),
    ],
)
def test_wrong_arguments_are_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
