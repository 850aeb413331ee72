"""DropGaussian against ``torch.nn.functional.dropout`` on a vector of ones, as its source has it."""

import pytest
import torch

from ca_reg import Draw
from ca_reg.regularizers import parse
from ca_reg.regularizers.dropout import DropGaussian


@pytest.mark.parametrize("step", [1, 2_500, 10_000])
def test_survivors_are_those_of_a_dropped_vector_of_ones(step):
    dropout, opacity = DropGaussian(), torch.rand(500, generator=torch.Generator().manual_seed(1))
    dropout.set_step(step)
    out = dropout(opacity, generator=torch.Generator().manual_seed(2))
    rate = 0.2 * step / 10_000
    # Either 0 or 1 / (1 - p), whatever the opacity; which is the mask's to say.
    literal = opacity * torch.where(dropout.keep, 1 / (1 - rate), 0.0)
    torch.testing.assert_close(out, literal)
    values = torch.nn.functional.dropout(torch.ones(500), rate).unique()
    torch.testing.assert_close((out / opacity).round(decimals=5).unique()[-1], values[-1].round(decimals=5))


def test_the_share_of_the_dropped_is_the_ramp_s():
    """Of 100,000 Gaussians within 4.5 standard errors: a false alarm in 1 of 50,000 seeds at each of the steps."""
    for step in (2_000, 7_000, 20_000):
        dropout, p = DropGaussian(), 0.2 * min(step, 10_000) / 10_000
        dropout.set_step(step)
        dropout(torch.full((100_000,), 0.5), generator=torch.Generator().manual_seed(step))
        assert abs(1 - dropout.keep.double().mean() - p) < 4.5 * (p * (1 - p) / 100_000) ** 0.5


def test_the_first_step_and_evaluation_do_nothing():
    opacity = torch.full((4,), 0.9)
    dropout = DropGaussian()
    assert dropout(opacity) is opacity
    dropout.set_step(5_000)
    assert dropout.eval()(opacity) is opacity
    dropout.train()
    everything = Draw(keep=torch.ones(4, dtype=torch.bool))
    assert float(dropout(opacity, drawn=everything)[0]) == pytest.approx(1.0)  # may be above 1


def test_arguments():
    (short,) = parse("drop_gaussian(0.4, 100)")
    short.set_step(50)
    assert short.p == pytest.approx(0.2)
    with pytest.raises(ValueError, match=r"\bp .*\[0, 1\)"):
        DropGaussian(1.0)
    with pytest.raises(ValueError, match="end_step must come after"):
        DropGaussian(steps=0)
