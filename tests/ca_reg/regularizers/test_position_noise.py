"""Position noise against a loop, with the same normal numbers."""

import pytest
import torch
from clouds import KINDS, cloud, mean_distance, params

from ca_reg.regularizers.noise import PositionNoise
from ca_reg.schedules import LinearRamp


@pytest.mark.parametrize("kind", KINDS)
def test_equal_to_a_loop(kind):
    points = cloud(kind)
    nearest = mean_distance(points, 1)
    normal = torch.randn(len(points) * 3, generator=torch.Generator().manual_seed(5)).reshape(-1, 3).double()
    expected = torch.stack([point + 0.3 * nearest[i] * normal[i] for i, point in enumerate(points)])
    rule = PositionNoise(0.3)
    x = params(points)
    drawn = rule.draw(x, torch.Generator().manual_seed(5))
    torch.testing.assert_close(rule.replay(x, drawn).means, expected, rtol=1e-6, atol=1e-9)
    assert drawn.keep is None


def test_gradients_pass_and_test_time_is_the_model_itself():
    points = cloud("spread").requires_grad_()
    x = params(points)
    PositionNoise(0.5).regularize(x).means.sum().backward()
    assert torch.equal(points.grad, torch.ones_like(points))
    assert PositionNoise(0.5).eval()(x) is x
    assert PositionNoise(0.5).alpha_factor(x) is None


def test_schedules_and_refusals():
    x = params(cloud("spread"), step=0)
    assert PositionNoise(LinearRamp(0.0, 0.5, 0, 100)).regularize(x) is x
    with pytest.raises(ValueError, match=r"sigma .*at least 0"):
        PositionNoise(-0.1)
