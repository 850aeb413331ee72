"""Nearest neighbours against the full matrix of distances in float64."""

import pytest
import torch

from reference_trainer import neighbors
from reference_trainer.neighbors import nearest_neighbors


def _points(kind: str, n: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(n)
    points = torch.randn(n, 3, generator=g)
    if kind == "clustered":
        points = 0.01 * points + 5 * torch.randint(0, 4, (n, 1), generator=g)
    if kind == "outlier":
        points[0] = torch.tensor([1e3, -2e3, 5e2])
    if kind == "duplicates":
        points = points.repeat_interleave(2, dim=0)[:n]
    if kind == "line":
        points[:, 1:] = 0
    return points


@pytest.mark.parametrize("chunk", [4_000_000, 1800, 1])
@pytest.mark.parametrize(("n", "count"), [(4, 3), (5, 3), (601, 3), (50, 7), (50, 1), (2, 1)])
@pytest.mark.parametrize("kind", ["spread", "clustered", "outlier", "duplicates", "line"])
def test_equal_to_the_full_matrix(monkeypatch, kind, n, count, chunk):
    monkeypatch.setattr(neighbors, "CHUNK_ELEMENTS", chunk)  # the last is one point at a time, as from 2 million on
    points = _points(kind, n)
    squares = (points.double()[:, None] - points.double()).square().sum(-1)
    squares.fill_diagonal_(torch.inf)
    expected = squares.sort(dim=1).values[:, :count]
    found, numbers = nearest_neighbors(points, count)
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-12)
    # Ties may be told apart either way: the neighbours' distances count, not their numbers.
    torch.testing.assert_close(squares.gather(1, numbers), expected, rtol=1e-5, atol=1e-12)
    assert all(len(set(row)) == count for row in numbers.tolist())


@pytest.mark.parametrize("shape", [(3, 3), (9, 2), (9,)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"\(N, 3\) with N > 3"):
        nearest_neighbors(torch.zeros(shape), 3)
