"""Nearest neighbors in point clouds, and their distances."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from ca_reg._precision import at_least_single

__all__ = ["nearest_distance", "nearest_neighbors", "rms_neighbor_distance"]

SMALLEST_SQUARED_DISTANCE = 1e-7  # INRIA's clamp: coinciding points still get a Gaussian of some size
TREE_FROM = 4_000  # points; below that the other search takes less time than importing SciPy
CHUNK_ELEMENTS = 4_000_000  # distances held at a time: 16 MB in float32
LEAF = 64  # points of a box: fewer make more calls, more compare points that are far apart
NOT_FINITE = (
    "points must be finite, and so must squared distances, got nan or infinity: remove these Gaussians, or stop a "
    "training that diverged."
)


@torch.no_grad()
def nearest_neighbors(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find the nearest other points of every point, exactly.

    Many points on a CPU take SciPy's k-d tree if it is installed (``pip install ca_reg[neighbors]``), which is several
    times as fast there; all others are compared box by box on their device. The two may break ties differently.

    Args:
        points: finite, shape (N, 3), on any device; half precision is searched in float32.
        count: number of neighbors k, less than N.

    Returns:
        Squared distances, at least float32, and the neighbors' indices, int64, nearest first; shape (N, k) each.

    Raises:
        ValueError: if the shape is not (N, 3), N is not above k, or a coordinate is nan or infinite.

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
    if n >= TREE_FROM and points.device.type == "cpu":
        with suppress(ImportError):
            return _by_tree(points, count)
    return _by_leaves(points, count)


def _by_tree(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Query SciPy's k-d tree for one more neighbor and remove the point itself."""
    from scipy.spatial import cKDTree

    if not bool(points.isfinite().all()):
        raise ValueError(NOT_FINITE)
    coordinates = _on_cpu(points)
    distances, indices = cKDTree(coordinates).query(coordinates, count + 1, workers=torch.get_num_threads())
    found, places = torch.from_numpy(distances), torch.from_numpy(indices)
    others = places != torch.arange(len(points), device=places.device)[:, None]
    others[others.all(1), -1] = False  # among more than `count` points at one place it may not have found itself
    shape = (len(points), count)
    return found[others].view(shape).square_().to(points), places[others].view(shape).to(points.device)


def _on_cpu(points: Tensor) -> Any:
    return points.detach().cpu().double().numpy()


def _by_leaves(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find exact neighbors by comparing small boxes of points with the boxes around them, all on the points' device.

    The neighbors within a point's own box bound how far away the true ones can be; only nearer boxes are searched.
    """
    n = len(points)
    ids, places = _leaves(points, max(LEAF, 4 * count))
    low, high = places.amin(1), places.amax(1)

    def gaps(rows: Tensor) -> Tensor:
        """Return the squared distances of these boxes to all, (rows, leaves); below 0 to itself if points coincide."""
        found = torch.maximum(low[rows, None] - high, low - high[rows, None]).clamp_min_(0).square_().sum(-1)
        found[every[: len(rows)], rows] -= (reach[rows] == 0).to(found)
        return found

    def search(rows: Tensor, leaves: Tensor) -> tuple[Tensor, Tensor]:
        """Return squared distances and indices of the nearest points of these leaves, (rows, some), for each row's."""
        others = ids[leaves].flatten(1)[:, None]
        # With matrix products, cdist would return 0 for near duplicates.
        mode = "donot_use_mm_for_euclid_dist"
        distances = torch.cdist(places[rows], places[leaves].flatten(1, 2), compute_mode=mode)
        distances.masked_fill_((others == ids[rows][..., None]) | (others >= n), torch.inf)
        nearest = distances.topk(count, largest=False)
        return nearest.values.square_(), others.expand_as(distances).gather(2, nearest.indices)

    every = torch.arange(len(ids), device=points.device)
    pairs = ids.shape[1] ** 2  # of the points of two leaves
    own = [search(some, some[:, None])[0].amax((1, 2)) for some in torch.split(every, max(1, CHUNK_ELEMENTS // pairs))]
    # Rounded up: single precision must not lose a tie. Points at one place, which may be thousands, reach no further.
    reach = torch.cat(own) * (1 + 1e-5)
    within = [
        (gaps(some) < reach[some, None]).sum(1) for some in torch.split(every, max(1, CHUNK_ELEMENTS // len(ids)))
    ]
    finite = (high - low).square().sum(1).isfinite()  # else a point may find itself, or what fills a leaf
    numbers, order = (torch.cat(within) * finite).sort(descending=True)
    most = numbers.tolist()  # the one wait for a card
    if most[-1] == 0:  # else a box finds at least itself
        raise ValueError(NOT_FINITE)
    squares, indices = points.new_empty(ids.numel(), count), torch.empty_like(ids).view(-1, 1).repeat(1, count)
    start = 0
    while start < len(order):
        # Leaves that search about as many boxes go together, and all search as many as the first, which needs most.
        rows = order[start : start + max(1, CHUNK_ELEMENTS // (pairs * most[start]))]
        squares[ids[rows]], indices[ids[rows]] = search(rows, gaps(rows).topk(most[start], largest=False).indices)
        start += len(rows)
    return squares[:n], indices[:n]


def _leaves(points: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Halve the points at the middle of their widest axis, and the halves, until none holds more than ``size``.

    Returns the points' indices, (leaves, points of one), and positions. All leaves are equally large: the first points
    occur a second time to fill them, with indices from the number of points on.
    """
    halvings = max(0, math.ceil(math.log2(len(points) / size)))
    ids = torch.arange(-(-len(points) >> halvings) << halvings, device=points.device)
    places = points[ids % len(points)]
    for level in range(halvings):
        parts = places.view(1 << level, -1, 3)
        widest = (parts.amax(1) - parts.amin(1)).argmax(1)
        order = parts.gather(2, widest[:, None, None].expand(-1, parts.shape[1], 1))[..., 0].argsort(1)
        places, ids = parts.gather(1, order[..., None].expand(-1, -1, 3)), ids.view(order.shape).gather(1, order)
    return ids.view(1 << halvings, -1), places.view(1 << halvings, -1, 3)


@torch.no_grad()
def nearest_distance(points: Tensor, others: Tensor) -> Tensor:
    """Return the distance from every point, (N, D), to the nearest of the others, (M, D); (N,), at least float32.

    Among many others on a CPU SciPy's k-d tree finds it, as in `nearest_neighbors`; else all distances are computed.

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
    if len(others) >= TREE_FROM and others.device.type == "cpu":
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
