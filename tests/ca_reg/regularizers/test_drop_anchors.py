"""DropAnSH-GS's anchors against a loop over them, and the rates of single Gaussians against their closed form."""

import math

import pytest
import torch
from clouds import KINDS, cloud, neighbor_distances, params

from ca_reg.regularizers.clustered import AnchorDropout

# Where several others are equally near, which of them go with an anchor is open.
WITHOUT_TIES = [kind for kind in KINDS if kind not in ("duplicates", "one place")]


@pytest.mark.parametrize("k", [1, 10])
@pytest.mark.parametrize("kind", WITHOUT_TIES)
def test_equal_to_a_loop_over_the_anchors(kind, k):
    points = cloud(kind)
    neighbors = neighbor_distances(points, k)
    for seed in range(5):
        anchors = torch.rand(len(points), generator=torch.Generator().manual_seed(seed)) < 0.2
        keep = [True] * len(points)
        for i in anchors.nonzero().flatten().tolist():
            for j in [i, *(j for _, j in neighbors[i])]:
                keep[j] = False
        rule = AnchorDropout(0.2, k)
        drawn = rule.draw(params(points), torch.Generator().manual_seed(seed))
        assert drawn.keep.tolist() == keep
        out = rule.replay(params(points), drawn).opacities
        assert torch.equal(out, params(points).opacities * torch.tensor(keep))


def test_rates_of_single_gaussians_and_their_correlation():
    """A bound of 4.5 standard deviations for 8 means: a false alarm in 2e4 seeds; this one is fixed."""
    points, rate, draws = cloud("spread", 8), 0.1, 3_000
    clusters = [1] * 8
    for row in neighbor_distances(points, 2):
        for _, j in row:
            clusters[j] += 1
    rule, g, x = AnchorDropout(rate, 2), torch.Generator().manual_seed(0), params(points)
    dropped = torch.stack([~rule.draw(x, g).keep for _ in range(draws)]).double()
    for j in range(8):
        p = 1 - (1 - rate) ** clusters[j]
        assert abs(dropped[:, j].mean() - p) < 4.5 * math.sqrt(p * (1 - p) / draws)


def test_the_rate_rises_to_theirs_and_nothing_is_scaled():
    x = params(cloud("spread"))
    rule = AnchorDropout()
    assert [rule.rate_at(step) for step in (0, 5_000, 10_000, 30_000)] == [0.0, 0.01, 0.02, 0.02]
    assert rule.eval()(x) is x
    assert rule.alpha_factor(x) is None
