"""Clouds of centers that are hard for rules about neighbors and depths; their neighbors and ranks by brute force."""

import numpy as np
import torch

from ca_reg import Params

KINDS = ("spread", "one", "two", "few", "one depth", "outlier", "duplicates", "one place")
SIZES = {"one": 1, "two": 2, "few": 4}


def cloud(kind: str, n: int = 40) -> torch.Tensor:
    n = SIZES.get(kind, n)
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    if kind == "one depth":
        points[:, 2] = 0.5
    if kind == "outlier":
        points[3] = torch.tensor([300.0, -800.0, 4000.0])
    if kind == "duplicates":
        points[n // 2 :] = points[: n - n // 2]
    if kind == "one place":
        points[:] = points[0]
    return points


def rotated_camera() -> torch.Tensor:
    """World to camera: turned about all three axes, and moved."""
    q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    view = np.eye(4)
    view[:3, :3] = q * np.sign(np.linalg.det(q))
    view[:3, 3] = [0.3, -0.2, 4.0]
    return torch.tensor(view)


def params(points: torch.Tensor, step: int = 5_000) -> Params:
    g = torch.Generator().manual_seed(1)
    n = len(points)
    opacities = torch.rand(n, generator=g, dtype=points.dtype)
    sh = torch.randn(n, 16, 3, generator=g, dtype=points.dtype)
    return Params(opacities, points, sh=sh, view_matrix=rotated_camera().to(points), step=step)


def neighbor_distances(points: torch.Tensor, k: int) -> list[list[tuple[float, int]]]:
    """The distances and numbers of the k nearest others of each point, nearest first."""
    rows = points.tolist()
    found = []
    for i, a in enumerate(rows):
        others = [(float(np.sqrt(sum((p - q) ** 2 for p, q in zip(a, b, strict=True)))), j) for j, b in enumerate(rows)]
        found.append(sorted(pair for pair in others if pair[1] != i)[:k])
    return found


def mean_distance(points: torch.Tensor, k: int) -> np.ndarray:
    return np.array([np.mean([d for d, _ in row]) if row else 0.0 for row in neighbor_distances(points, k)])


def rank(values: np.ndarray, rounding: float = 1e-12) -> np.ndarray:
    """How many of the others are smaller, those equal counted half, over the number of the others."""
    n = len(values)
    if n == 1:
        return np.array([0.5])
    # What rounding alone tells apart counts as equal.
    near = np.isclose(values[:, None], values, rtol=rounding, atol=rounding / 10)
    smaller = (values < values[:, None]) & ~near
    return np.array([(smaller[i].sum() + 0.5 * (near[i].sum() - 1)) / (n - 1) for i in range(n)])
