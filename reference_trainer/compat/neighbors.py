"""The public interface of ``simple_knn``: mean squared distances to the three nearest neighbours."""

from __future__ import annotations

import importlib.machinery
from types import ModuleType

import torch
from torch import Tensor

__all__ = ["neighbor_modules", "three_nearest"]

NEIGHBORS = 3
CHUNK_ELEMENTS = 4_000_000  # distances held at a time: 16 MB in float32


@torch.no_grad()
def three_nearest(points: Tensor) -> tuple[Tensor, Tensor]:
    """Find the three nearest other points of every point, exactly.

    The points are sorted along one axis: only those within a strip can be nearer than the neighbours already known, so
    the time grows more slowly than N squared, and memory is bounded.

    Args:
        points: shape (N, 3), N at least 4.

    Returns:
        Mean of the three squared distances, shape (N,), and the neighbours' numbers, nearest first, shape (N, 3) int32.

    Raises:
        ValueError: if the shape is not (N, 3) or N is less than 4.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [6.0, 0, 0]])
        >>> means, numbers = three_nearest(points)
        >>> round(means[0].item(), 2), numbers[0].tolist()  # (1 + 9 + 36) / 3
        (15.33, [1, 2, 3])
    """
    n = points.shape[0]
    if points.ndim != 2 or points.shape[1] != 3 or n <= NEIGHBORS:
        raise ValueError(f"points must have shape (N, 3) with N > {NEIGHBORS}, got {tuple(points.shape)}.")
    axis = int((points.amax(0) - points.amin(0)).argmax())
    order = points[:, axis].argsort()
    ordered = points[order]
    along = ordered[:, axis].contiguous()
    means, numbers = points.new_empty(n), torch.empty(n, NEIGHBORS, dtype=torch.int32, device=points.device)
    start = 0
    rows = max(1, min(256, CHUNK_ELEMENTS // n))
    while start < n:
        stop = min(start + rows, n)
        near = _search(ordered, start, stop, max(0, start - rows), min(n, stop + rows + NEIGHBORS))
        reach = near[0][:, -1].sqrt().amax() * (1 + 1e-5)  # rounded up: single precision must not lose a tie
        low = int(torch.searchsorted(along, along[start] - reach))
        high = int(torch.searchsorted(along, along[stop - 1] + reach, right=True))
        squares, found = _search(ordered, start, stop, min(low, start), max(high, stop))
        means[order[start:stop]] = squares.mean(1)
        numbers[order[start:stop]] = order[found].int()
        start = stop
    return means, numbers


def _search(ordered: Tensor, start: int, stop: int, low: int, high: int) -> tuple[Tensor, Tensor]:
    """Return squared distances and numbers of the nearest among rows low..high, for every row start..stop."""
    # By way of matrix products, cdist would return 0 for near duplicates.
    distances = torch.cdist(
        ordered[start:stop], ordered[low:high], compute_mode="donot_use_mm_for_euclid_dist"
    ).square_()
    distances.diagonal(start - low).fill_(torch.inf)
    nearest = distances.topk(min(NEIGHBORS, high - low - 1), dim=1, largest=False)
    return nearest.values, nearest.indices + low


def neighbor_modules(*, indices: bool) -> dict[str, ModuleType]:
    """Make the modules ``simple_knn`` and ``simple_knn._C``.

    Args:
        indices: whether ``distCUDA2`` returns the neighbours' numbers too, as the version of FSGS and CoR-GS does.
    """

    def distCUDA2(points: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return mean squared distances to the three nearest neighbours, shape (N,), and their numbers if so built."""
        means, numbers = three_nearest(points.detach())
        return (means, numbers) if indices else means

    package, compiled = ModuleType("simple_knn"), ModuleType("simple_knn._C")
    package.__spec__ = importlib.machinery.ModuleSpec("simple_knn", loader=None, is_package=True)
    compiled.__spec__ = importlib.machinery.ModuleSpec("simple_knn._C", loader=None)
    package.__path__ = []
    package._C = compiled  # type: ignore[attr-defined]
    compiled.distCUDA2 = distCUDA2  # type: ignore[attr-defined]
    return {"simple_knn": package, "simple_knn._C": compiled}
