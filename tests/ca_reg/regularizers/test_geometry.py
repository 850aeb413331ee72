"""Surface variation against NumPy's covariances, and where it is known."""

import numpy as np
import pytest
import torch
from clouds import KINDS, cloud, neighbor_distances, params, rank

from ca_reg.regularizers.surroundings import GeometryDropout, surface_variation


def _literal(points, k):
    out = []
    for i, row in enumerate(neighbor_distances(points, k)):
        group = points[[i, *(j for _, j in row)]].numpy()
        values = np.linalg.eigvalsh(np.atleast_2d(np.cov(group.T, bias=True)))
        out.append(max(values[0], 0) / values.sum() if values.sum() > 1e-20 else 0.0)
    return np.array(out)


@pytest.mark.parametrize("k", [4, 10])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "duplicates"])  # ties of unlike neighbors
def test_equal_to_the_covariances_of_numpy(kind, k):
    points = cloud(kind)
    expected = _literal(points, k)
    torch.testing.assert_close(surface_variation(points, k), torch.from_numpy(expected), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_rates_follow_from_the_rank_of_the_variation(kind):
    points = cloud(kind)
    expected = 0.2 + 0.3 * rank(surface_variation(points, 10).numpy(), rounding=0)
    torch.testing.assert_close(GeometryDropout().rates(params(points)), torch.from_numpy(expected), rtol=1e-12, atol=0)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_known_surroundings_of_any_size(size):
    axes = torch.eye(3)
    star = torch.cat([torch.zeros(1, 3), axes, -axes]) * size
    torch.testing.assert_close(surface_variation(star, 6)[0], torch.tensor(1 / 3))
    tilted = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) @ torch.tensor([[1.0, 2, 3], [2, -1, 1]])
    assert surface_variation(tilted * size, 10).max() < 1e-5
    assert surface_variation(tilted[:, :1] * torch.tensor([1.0, 2.0, 3.0]) * size, 10).max() < 1e-5
