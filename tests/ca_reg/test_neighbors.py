"""Nearest neighbors against the full matrix of distances in float64."""

import sys

import numpy as np
import pytest
import torch
from stand_ins.card import counted_synchronizations

from ca_reg import neighbors
from ca_reg.neighbors import nearest_distance, nearest_neighbors, rms_neighbor_distance


def _points(kind: str, n: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(n)
    points = torch.randn(n, 3, generator=g)
    if kind == "clustered":
        points = 0.01 * points + 5 * torch.randint(0, 4, (n, 1), generator=g)
    if kind == "outlier":
        points[0] = torch.tensor([1e3, -2e3, 5e2])
    if kind == "duplicates":
        points = points.repeat_interleave(2, dim=0)[:n]
    if kind == "one place":
        points[:] = points[0]
    if kind == "line":
        points[:, 1:] = 0
    return points


CASES = pytest.mark.parametrize(
    ("kind", "n", "count"),
    [
        (kind, *size)
        for kind in ("spread", "clustered", "outlier", "duplicates", "one place", "line")
        for size in ((4, 3), (5, 3), (601, 3), (50, 7), (50, 1), (2, 1))
    ],
)


def _check(found, numbers, points, count):
    squares = (points.double()[:, None] - points.double()).square().sum(-1)
    squares.fill_diagonal_(torch.inf)
    expected = squares.sort(dim=1).values[:, :count]
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-12)
    # Ties may be told apart either way: the neighbors' distances count, not their numbers.
    torch.testing.assert_close(squares.gather(1, numbers), expected, rtol=1e-5, atol=1e-12)
    assert all(len(set(row)) == count for row in numbers.tolist())
    assert found.dtype == torch.promote_types(points.dtype, torch.float32)


@CASES
def test_by_scipy_equal_to_the_full_matrix(monkeypatch, kind, n, count):
    spatial, trees = pytest.importorskip("scipy.spatial"), []
    tree = spatial.cKDTree
    monkeypatch.setattr(spatial, "cKDTree", lambda of: trees.append(tree(of)) or trees[-1])
    monkeypatch.setattr(neighbors, "TREE_FROM", 0)
    points = _points(kind, n)
    _check(*nearest_neighbors(points, count), points, count)
    assert len(trees) == 1


@pytest.mark.parametrize(("chunk", "leaf"), [(4_000_000, 64), (4_000_000, 4), (10_000, 1), (1, 16)])
@CASES
def test_without_scipy_equal_to_the_full_matrix(monkeypatch, kind, n, count, chunk, leaf):
    monkeypatch.setattr(neighbors, "TREE_FROM", 0)
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    monkeypatch.setattr(neighbors, "CHUNK_ELEMENTS", chunk)
    monkeypatch.setattr(neighbors, "LEAF", leaf)
    points = _points(kind, n)
    _check(*nearest_neighbors(points, count), points, count)


@pytest.mark.parametrize("tree_from", [0, 10**9], ids=["tree", "leaves"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_searched_in_single(monkeypatch, dtype, tree_from):
    """Squares beyond the range of half precision in both directions: distances from 1e-4 to 5e4."""
    monkeypatch.setattr(neighbors, "TREE_FROM", tree_from)
    points = torch.cat([1e-4 * _points("spread", 50), 2e4 + 5e3 * _points("spread", 40)]).to(dtype)
    _check(*nearest_neighbors(points, 3), points, 3)
    expected = (points.double()[:, None] - points[::2].double()).square().sum(-1).amin(1).sqrt()
    torch.testing.assert_close(nearest_distance(points, points[::2]).double(), expected, rtol=1e-5, atol=0)


def test_on_any_device(device):
    points = _points("clustered", 601)
    there = points.to(device)
    with counted_synchronizations() as waits:
        found, numbers = nearest_neighbors(there, 7)
    assert waits.total() <= 1
    assert found.device.type == numbers.device.type == device.type
    _check(found.cpu(), numbers.cpu(), points, 7)


@pytest.mark.parametrize("tree_from", [0, 10**9], ids=["tree", "leaves"])
@pytest.mark.parametrize("n", [9, 601])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_points_that_are_not_finite_are_refused(monkeypatch, n, value, tree_from):
    monkeypatch.setattr(neighbors, "TREE_FROM", tree_from)
    points = _points("spread", n)
    points[n // 2, 1] = value
    with pytest.raises(ValueError, match=r"finite.*remove these Gaussians"):
        nearest_neighbors(points, 3)


@pytest.mark.parametrize("shape", [(3, 3), (9, 2), (9,)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"\(N, 3\) with N > 3"):
        nearest_neighbors(torch.zeros(shape), 3)


def brute_force(positions):
    """Root mean squared distance to the three nearest others, in float64, one pair at a time."""
    p = positions.double().numpy()
    squared = ((p[:, None] - p[None]) ** 2).sum(-1)
    result = []
    for i, row in enumerate(squared):
        nearest = sorted(np.delete(row, i))[:3]
        result.append(max(np.mean(nearest), 1e-7) ** 0.5)
    return torch.tensor(result)


@pytest.mark.parametrize("n", [2, 3, 4, 200])
def test_neighbor_distance_equals_brute_force(n):
    positions = torch.randn(n, 3, generator=torch.Generator().manual_seed(n))
    torch.testing.assert_close(rms_neighbor_distance(positions).double(), brute_force(positions), rtol=1e-5, atol=0)


def test_neighbor_distance_of_near_duplicates_far_from_the_origin():
    generator = torch.Generator().manual_seed(0)
    base = torch.rand(40, 3, generator=generator) + 3
    shifts = 1e-3 * torch.randn(3, 40, 3, generator=generator)
    positions = torch.cat([base, *(base + shift for shift in shifts)])
    got = rms_neighbor_distance(positions)
    torch.testing.assert_close(got.double(), brute_force(positions), rtol=1e-4, atol=0)


def test_points_at_one_place_are_not_all_compared_with_all(monkeypatch):
    """20,000 took 8 s. A few others lie around them, whose boxes hold some of both."""
    compared, cdist = [], torch.cdist
    monkeypatch.setattr(neighbors, "CHUNK_ELEMENTS", 10_000)  # else many boxes are searched as far as one of them
    monkeypatch.setattr(torch, "cdist", lambda *args, **kwargs: compared.append(cdist(*args, **kwargs)) or compared[-1])
    points = _points("one place", 3000)
    points[::100] += _points("spread", 30)
    squares, numbers = nearest_neighbors(points, 3)
    assert sum(distances.numel() for distances in compared) < 0.2 * 3000**2
    monkeypatch.undo()
    _check(squares, numbers, points, 3)


def test_duplicates_get_the_floor():
    assert torch.equal(rms_neighbor_distance(torch.ones(5, 3)), torch.full((5,), 1e-7).sqrt())


@pytest.mark.parametrize("shape", [(1, 3), (0, 3), (4, 2), (12,)])
def test_neighbor_distance_refuses_other_shapes(shape):
    with pytest.raises(ValueError, match="shape"):
        rms_neighbor_distance(torch.zeros(shape))


@pytest.mark.parametrize("tree", [True, False])
@pytest.mark.parametrize("chunk", [4_000_000, 1800, 1])
@pytest.mark.parametrize(("n", "m", "d"), [(50, 601, 3), (601, 7, 2), (3, 1, 3), (0, 5, 3)])
def test_the_nearest_of_other_points_equal_to_the_full_matrix(monkeypatch, tree, chunk, n, m, d):
    if tree:
        pytest.importorskip("scipy")
    monkeypatch.setattr(neighbors, "TREE_FROM", 0 if tree else 10**9)
    monkeypatch.setattr(neighbors, "CHUNK_ELEMENTS", chunk)
    g = torch.Generator().manual_seed(n)
    points, others = torch.randn(n, d, generator=g), torch.randn(m, d, generator=g)
    points[: n // 2] = others[torch.arange(n // 2) % m]  # some at one place
    expected = (points.double()[:, None] - others.double()).square().sum(-1).amin(1).sqrt()
    found = nearest_distance(points, others)
    assert found.dtype == points.dtype
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)


def test_the_nearest_distance_is_found_on_the_device(device):
    points, others = _points("spread", 50), _points("clustered", neighbors.TREE_FROM)
    there = points.to(device), others.to(device)
    with counted_synchronizations() as waits:
        found = nearest_distance(*there)
    assert not waits
    assert found.device.type == device.type
    torch.testing.assert_close(found.cpu(), nearest_distance(points, others), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("shapes", [((4, 3), (5, 2)), ((4, 3), (0, 3)), ((4,), (4, 3))])
def test_other_points_of_a_wrong_shape_are_refused(shapes):
    with pytest.raises(ValueError, match=r"points \(N, D\) and at least one"):
        nearest_distance(*(torch.zeros(shape) for shape in shapes))
