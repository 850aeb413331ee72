"""SH dropout against a loop over the Gaussians."""

import pytest
import torch
from clouds import cloud, params

from ca_reg import Params
from ca_reg.regularizers.clustered import SHDropout


@pytest.mark.parametrize(
    ("step", "bands"),
    [(0, 1), (1_999, 1), (2_000, 4), (3_999, 4), (4_000, 9), (5_999, 9), (6_000, None), (9_000, None)],
)
def test_equal_to_a_loop(step, bands):
    x = params(cloud("spread"), step)
    rule = SHDropout()
    drawn = rule.draw(x, torch.Generator().manual_seed(3))
    after = rule.replay(x, drawn)
    if bands is None:
        assert after is x
        return
    cut = torch.rand(40, generator=torch.Generator().manual_seed(3)) < 0.2
    expected = x.sh.clone()
    for i in range(40):
        for band in range(bands, 16):
            if cut[i]:
                expected[i, band] = 0.0
    assert cut.any()
    assert torch.equal(after.sh, expected)
    assert after.opacities is x.opacities
    assert drawn.keep is None


def test_models_of_a_lower_degree_are_left_alone_where_there_is_nothing_to_cut():
    x = params(cloud("spread"), step=2_500)
    low = x._replace(sh=x.sh[:, :4])
    assert SHDropout().regularize(low) is low
    assert SHDropout().eval()(x) is x
    assert SHDropout().alpha_factor(x) is None


def test_gradients_reach_what_is_shown_only():
    x = params(cloud("spread"), step=100)
    sh = x.sh.clone().requires_grad_()
    rule = SHDropout(0.5)
    rule.regularize(x._replace(sh=sh), torch.Generator().manual_seed(0)).sh.sum().backward()
    whole = rule.last.value[0]
    assert bool((sh.grad[:, 0] == 1).all())
    assert torch.equal(sh.grad[:, 1:] == 1, whole[:, None, None].expand(-1, 15, 3))


def test_what_is_refused():
    with pytest.raises(ValueError, match=r"\bp .*\[0, 1\)"):
        SHDropout(1.0)
    with pytest.raises(ValueError, match="in rising order"):
        SHDropout(until=(4_000, 2_000))


@pytest.mark.slow  # loads torch's tracer
def test_compiled_the_degree_follows_the_step():
    torch._dynamo.reset()
    dropout = SHDropout(0.5, until=(2, 4))
    compiled = torch.compile(dropout, backend="eager")
    x = Params(torch.ones(60), sh=torch.ones(60, 9, 3))
    kept = []
    for step in (1, 2, 3, 4, 5):
        dropout.set_step(step)
        kept.append(set(compiled(x).sh.sum((1, 2)).tolist()))
    # False alarm 2^-59 each: that all 60 are cut, or none.
    assert kept == [{3.0, 27.0}, {12.0, 27.0}, {12.0, 27.0}, {27.0}, {27.0}]
