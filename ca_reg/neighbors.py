"""Nearest neighbors in point clouds, and their distances."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from ca_reg._precision import at_least_single

__all__ = ["nearest_distance", "nearest_neighbors", "rms_neighbor_distance"]

SMALLEST_SQUARED_DISTANCE = 1e-7  # INRIA's clamp: coinciding points still get a Gaussian of some size
TREE_FROM = 4_000  # points; below that the other search takes less time than importing SciPy
CHUNK_ELEMENTS = 4_000_000  # distances held at a time: 16 MB in float32
CHUNK_ROWS = 256  # sorted points per chunk; larger chunks span a wider strip, smaller ones make too many calls


@torch.no_grad()
def nearest_neighbors(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find the nearest other points of every point, exactly.

    For many points SciPy's k-d tree finds them in O(N log N), if SciPy is installed
    (``pip install ca_reg[neighbors]``); otherwise a search along one axis takes nearly O(N^2). The two may break ties
    differently.

    Args:
        points: finite, shape (N, 3), on any device; half precision is searched in float32.
        count: number of neighbors k, less than N.

    Returns:
        Squared distances, at least float32, and the neighbors' indices, int64, nearest first; shape (N, k) each.

    Raises:
        ValueError: if the shape is not (N, 3), or N is not above k.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]])
        >>> squares, indices = nearest_neighbors(points, 2)
        >>> squares[0].tolist(), indices[0].tolist()
        ([1.0, 9.0], [1, 2])
    """
    n = points.shape[0]
    if points.ndim != 2 or points.shape[1] != 3 or n <= count:
        raise ValueError(f"points must have shape (N, 3) with N > {count}, got {tuple(points.shape)}.")
    points = at_least_single(points)
    if n >= TREE_FROM:
        with suppress(ImportError):
            return _by_tree(points, count)
    return _along_an_axis(points, count)


def _by_tree(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Query SciPy's k-d tree for one more neighbor and remove the point itself."""
    from scipy.spatial import cKDTree

    coordinates = _on_cpu(points)
    distances, indices = cKDTree(coordinates).query(coordinates, count + 1, workers=torch.get_num_threads())
    found, places = torch.from_numpy(distances), torch.from_numpy(indices)
    others = places != torch.arange(len(points), device=places.device)[:, None]
    others[others.all(1), -1] = False  # among more than `count` points at one place it may not have found itself
    shape = (len(points), count)
    return found[others].view(shape).square_().to(points), places[others].view(shape).to(points.device)


def _on_cpu(points: Tensor) -> Any:
    return points.detach().cpu().double().numpy()


def _along_an_axis(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find exact neighbors by a sweep along the longest axis.

    In the order along that axis, a chunk's neighbors among those nearby bound how far away the true ones can be; only
    points in the strip of that width are then compared.
    """
    n = points.shape[0]
    axis = int((points.amax(0) - points.amin(0)).argmax())
    order = points[:, axis].argsort()
    ordered = points[order]
    along = ordered[:, axis].contiguous()
    squares = points.new_empty(n, count)
    indices = torch.empty(n, count, dtype=torch.int64, device=points.device)
    rows = max(1, min(CHUNK_ROWS, CHUNK_ELEMENTS // n))
    for start in range(0, n, rows):
        stop = min(start + rows, n)
        near, _ = _search(ordered, start, stop, max(0, start - rows - count), min(n, stop + rows + count), count)
        reach = near[:, -1].sqrt().amax() * (1 + 1e-5)  # rounded up: single precision must not lose a tie
        low = int(torch.searchsorted(along, along[start] - reach))
        high = int(torch.searchsorted(along, along[stop - 1] + reach, right=True))
        found, places = _search(ordered, start, stop, min(low, start), max(high, stop), count)
        squares[order[start:stop]], indices[order[start:stop]] = found, order[places]
    return squares, indices


def _search(ordered: Tensor, start: int, stop: int, low: int, high: int, count: int) -> tuple[Tensor, Tensor]:
    """Return squared distances and indices of the nearest among rows [low, high) for every row in [start, stop)."""
    # With matrix products, cdist would return 0 for near duplicates.
    distances = torch.cdist(ordered[start:stop], ordered[low:high], compute_mode="donot_use_mm_for_euclid_dist")
    distances.square_().diagonal(start - low).fill_(torch.inf)
    nearest = distances.topk(count, dim=1, largest=False)
    return nearest.values, nearest.indices + low


@torch.no_grad()
def nearest_distance(points: Tensor, others: Tensor) -> Tensor:
    """Return the distance from every point, (N, D), to the nearest of the others, (M, D); (N,), at least float32.

    Among many others SciPy's k-d tree finds it, as in `nearest_neighbors`; else all distances are computed.

    Raises:
        ValueError: if a shape is wrong, or there are no other points.

    Example:
        >>> nearest_distance(torch.tensor([[0.0, 0, 0], [5.0, 0, 0]]), torch.tensor([[1.0, 0, 0]])).tolist()
        [1.0, 4.0]
    """
    if points.ndim != 2 or others.ndim != 2 or points.shape[1] != others.shape[1] or len(others) < 1:
        shapes = f"{tuple(points.shape)} and {tuple(others.shape)}"
        raise ValueError(f"expected points (N, D) and at least one other, (M, D), got {shapes}.")
    points, others = at_least_single(points), at_least_single(others)
    if len(others) >= TREE_FROM:
        with suppress(ImportError):
            from scipy.spatial import cKDTree

            found, _ = cKDTree(_on_cpu(others)).query(_on_cpu(points), workers=torch.get_num_threads())
            return torch.from_numpy(found).to(points)
    rows = torch.split(points, max(1, CHUNK_ELEMENTS // len(others)))
    return torch.cat([torch.cdist(x, others, compute_mode="donot_use_mm_for_euclid_dist").amin(1) for x in rows])


def rms_neighbor_distance(positions: Tensor) -> Tensor:
    """Return the root mean squared distance of each point to its three nearest others, at least float32.

    The INRIA code takes its logarithm as the initial scale of a Gaussian. Coinciding points get sqrt(1e-7) instead of
    0. With fewer than three other points, all others count. Shapes (N, 3) and (N,).

    Raises:
        ValueError: if the shape is not (N, 3) or N is less than 2.

    Example:
        >>> rms_neighbor_distance(torch.tensor([[0.0, 0, 0], [0, 0, 2]])).tolist()
        [2.0, 2.0]
    """
    squares, _ = nearest_neighbors(positions, max(1, min(3, len(positions) - 1)))
    return squares.mean(1).clamp_min(SMALLEST_SQUARED_DISTANCE).sqrt()
