"""D2GS against its formula in NumPy: done right, and as its code does it."""

import numpy as np
import pytest
import torch
from clouds import KINDS, cloud, mean_distance, params, rank

from ca_reg.regularizers.depth import D2GSDropout, DepthDropout

STEPS = (1, 500, 4_000, 25_000)


def _tiers(depths):
    ordered = sorted(depths)
    first, second = ordered[int(len(depths) * 0.33)], ordered[int(len(depths) * 0.67)]
    return np.array([1.0 if z <= first else 0.7 if z <= second else 0.3 for z in depths])


def _rate(step):
    return 0.05 + 0.25 * min(1.0, step / 10_000)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kind", KINDS)
def test_done_right(kind, step):
    points = cloud(kind)
    x = params(points, step)
    homogeneous = np.concatenate([points.numpy(), np.ones((len(points), 1))], axis=1)
    depths = np.array([(x.view_matrix.numpy() @ point)[2] for point in homogeneous])
    if kind == "one place":
        depths[:] = depths[0]
    score = 0.4 * (1 - rank(depths)) + 0.6 * rank(-mean_distance(points, 5))
    expected = torch.from_numpy(_rate(step) * _tiers(depths) * score)
    rates = D2GSDropout(depth_weight=0.4, density_weight=0.6).rates(x)
    torch.testing.assert_close(rates, expected, rtol=1e-9, atol=1e-12)


class _Source:
    """What the published code computes, step after step."""

    def __init__(self):
        self.density = np.zeros(0)

    def rates(self, points, view, step, w_depth=0.3, w_density=0.7):
        points = points.numpy()
        if step == 1 or step % 500 == 0:
            squares = ((points[:, None] - points) ** 2).sum(-1)
            self.density = -np.sort(np.sqrt(squares), axis=1)[:, :6].mean(1)  # the first of the six is the point itself
        world_view_transform = view.numpy().T  # as the INRIA code stores it
        depths = (np.concatenate([points, np.ones((len(points), 1))], axis=1) @ world_view_transform.T)[:, 2]
        near = 1 - (depths - depths.min()) / (depths.max() - depths.min() + 1e-6)
        density = np.full(len(points), 0.5)
        if len(self.density) >= len(points):
            stored = self.density[: len(points)] + 1e-6
            density = (stored - stored.min()) / (stored.max() - stored.min() + 1e-6)
        return _rate(step) * _tiers(depths) * (w_depth * near + w_density * density)


def test_literal_is_the_published_code_with_its_traps():
    source, rule = _Source(), D2GSDropout(literal=True)
    points = cloud("outlier")
    for step, count in [
        (1, 40),
        (2, 40),
        (300, 40),
        (400, 30),
        (500, 30),
        (600, 35),
        (999, 38),
        (1_000, 38),
        (1_001, 9),
    ]:
        x = params(points[:count], step)
        expected = torch.from_numpy(source.rates(x.means, x.view_matrix, step))
        # A factor of 6/5 in the densities cancels but for their 1e-6 beside differences of 0.1 and more.
        torch.testing.assert_close(rule.rates(x), expected, rtol=1e-4, atol=1e-7, msg=f"step {step}")


def test_the_depth_of_the_published_code_is_right_without_rotation_only():
    points = cloud("spread")
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    x = params(points)
    only_depth = {"depth_weight": 1.0, "density_weight": 0.0}
    for view, same in ((moved, True), (x.view_matrix, False)):
        right, literal = (
            D2GSDropout(**only_depth, literal=literal).rates(x._replace(view_matrix=view)) for literal in (False, True)
        )
        assert torch.equal(right.argsort(), literal.argsort()) == same


def test_an_outlier_decides_the_literal_rates_and_not_the_others():
    usual, outlier = cloud("spread"), cloud("outlier")
    for literal in (False, True):
        before, after = (
            D2GSDropout(rate=0.3, literal=literal).rates(params(points)._replace(view_matrix=torch.eye(4).double()))
            for points in (usual, outlier)
        )
        others = torch.arange(40) != 3
        assert ((before - after)[others].abs().median() > 0.02) == literal


def test_the_mean_rate_where_depth_and_density_are_unrelated():
    # Share x factor x score of each tier: its mean nearness is the middle of its ranks, its mean density 1/2.
    mean = 0.33 * (0.3 * 0.835 + 0.35) + 0.34 * 0.7 * (0.3 * 0.5 + 0.35) + 0.33 * 0.3 * (0.3 * 0.165 + 0.35)
    rates = D2GSDropout(rate=0.3).rates(params(cloud("spread", 400)))
    assert abs(rates.mean() / 0.3 - mean) < 0.015  # 5 standard deviations of 400 random densities; the seed is fixed
    assert abs(mean - 0.36) < 0.005


@pytest.mark.parametrize("kind", [D2GSDropout, DepthDropout])
def test_a_rate_out_of_range_is_refused_at_once(kind):
    with pytest.raises(ValueError, match=r"rate .*\[0, 1\), got 30"):
        kind(30.0)


def test_test_time_is_the_model_itself():
    x = params(cloud("spread"))
    assert D2GSDropout().eval()(x) is x
    scaled = D2GSDropout(scale=True)
    torch.testing.assert_close(scaled.eval()(x).opacities, x.opacities * (1 - scaled.rates(x)))
    torch.testing.assert_close(D2GSDropout().alpha_factor(x)[1].mean, 1 - D2GSDropout().rates(x))
