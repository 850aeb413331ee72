"""Three nearest neighbours against the full matrix of distances in float64."""

import pytest
import torch

from reference_trainer.compat import neighbors
from reference_trainer.compat.neighbors import neighbor_modules, three_nearest


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


@pytest.mark.parametrize("chunk", [4_000_000, 700])
@pytest.mark.parametrize("n", [4, 5, 601])
@pytest.mark.parametrize("kind", ["spread", "clustered", "outlier", "duplicates", "line"])
def test_equal_to_the_full_matrix(monkeypatch, kind, n, chunk):
    monkeypatch.setattr(neighbors, "CHUNK_ELEMENTS", max(chunk, 3 * n))
    points = _points(kind, n)
    squares = (points.double()[:, None] - points.double()).square().sum(-1)
    squares.fill_diagonal_(torch.inf)
    expected = squares.sort(dim=1).values[:, :3]
    means, numbers = three_nearest(points)
    torch.testing.assert_close(means.double(), expected.mean(1), rtol=1e-5, atol=1e-12)
    # Ties may be told apart either way: the neighbours' distances count, not their numbers.
    torch.testing.assert_close(squares.gather(1, numbers.long()), expected, rtol=1e-5, atol=1e-12)
    assert all(len(set(row)) == 3 for row in numbers.tolist())


def test_both_forms_of_the_extension(generator):
    points = torch.rand(20, 3, generator=generator).requires_grad_()
    means, numbers = three_nearest(points.detach())
    alone = neighbor_modules(indices=False)["simple_knn._C"].distCUDA2(points)
    pair = neighbor_modules(indices=True)["simple_knn._C"].distCUDA2(points)
    assert torch.equal(alone, means)
    assert not alone.requires_grad
    assert torch.equal(pair[0], means)
    assert torch.equal(pair[1], numbers)
    assert numbers.dtype == torch.int32


@pytest.mark.parametrize("shape", [(3, 3), (9, 2), (9,)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"\(N, 3\) with N > 3"):
        three_nearest(torch.zeros(shape))
