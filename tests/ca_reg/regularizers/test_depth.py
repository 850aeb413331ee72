"""Depth dropout against its formula in NumPy."""

import pytest
import torch
from clouds import KINDS, cloud, params, rank

from ca_reg.regularizers.depth import DepthDropout


@pytest.mark.parametrize(("near", "far"), [(1.0, 0.3), (0.3, 1.0)])
@pytest.mark.parametrize("kind", KINDS)
def test_rates_are_a_straight_line_in_the_rank_of_the_depth(kind, near, far):
    x = params(cloud(kind), step=2_000)
    view = x.view_matrix.numpy()
    depths = x.means.numpy() @ view[2, :3] + view[2, 3]
    expected = 0.1 * (near + (far - near) * rank(depths))
    rates = DepthDropout(near=near, far=far).rates(x)
    if kind == "one place":
        assert len(rates.unique()) == 1
    torch.testing.assert_close(rates, torch.from_numpy(expected), rtol=1e-9, atol=0)


def test_test_time_is_the_model_itself():
    x = params(cloud("spread"))
    assert DepthDropout().eval()(x) is x
    torch.testing.assert_close(DepthDropout().alpha_factor(x)[1].mean, 1 - DepthDropout().rates(x))


def test_negative_factors_are_refused():
    with pytest.raises(ValueError, match=r"far .*at least 0"):
        DepthDropout(far=-0.1)


def test_depths_are_along_the_third_axis_of_the_camera():
    x = params(cloud("spread"))
    view = x.view_matrix.numpy()
    depths = (x.means.numpy() @ view[:3, :3].T + view[:3, 3])[:, 2]
    torch.testing.assert_close(x.depths, torch.from_numpy(depths))
    with pytest.raises(ValueError, match="view_matrix"):
        _ = x._replace(view_matrix=None).depths
