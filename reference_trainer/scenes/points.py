"""Initial points: from COLMAP, from a PLY file, or random; and the guard against test views among their sources."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.camera import Camera
from reference_trainer.scenes.colmap import read_colmap
from reference_trainer.scenes.scene import PointCloud

__all__ = [
    "check_no_leak",
    "colmap_points",
    "mean_neighbor_distance",
    "random_points_in_box",
    "random_points_in_frusta",
]

SMALLEST_SQUARED_DISTANCE = 1e-7  # INRIA's clamp: coinciding points still get a Gaussian of some size


def colmap_points(folder: str | Path) -> PointCloud:
    """Read the points of a COLMAP reconstruction.

    Args:
        folder: the folder of its three files, such as ``sparse/0``.

    Returns:
        The points; ``seen_by`` names the images in their tracks, or all of the reconstruction's if tracks are missing.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is damaged or there are no points.
    """
    model = read_colmap(folder)
    if len(model.points.ids) == 0:
        raise ValueError(f"{folder} has no points to start from; choose another folder or random points.")
    positions = torch.from_numpy(model.points.positions).to(torch.float32)
    colors = torch.from_numpy(model.points.colors).to(torch.float32) / 255
    return PointCloud(positions, colors, source=str(folder), seen_by=model.seen_by())


def random_points_in_box(count: int, half_size: float, *, generator: torch.Generator | None = None) -> PointCloud:
    """Draw grey points uniformly in a cube around the origin.

    Args:
        count: number of points.
        half_size: half the edge of the cube, world units; 1.3 for the NeRF-synthetic scenes.
        generator: source of randomness; the global one if None.

    Example:
        >>> cloud = random_points_in_box(5, 1.3, generator=torch.Generator().manual_seed(0))
        >>> bool((cloud.positions.abs() <= 1.3).all())
        True
    """
    positions = (2 * torch.rand(count, 3, generator=generator) - 1) * half_size
    return PointCloud(positions, torch.full((count, 3), 0.5), source="random", seen_by=frozenset())


def random_points_in_frusta(
    cameras: Sequence[Camera],
    count: int,
    *,
    near: float | None = None,
    far: float | None = None,
    generator: torch.Generator | None = None,
) -> PointCloud:
    """Draw grey points that some camera sees: uniform over its picture, and in inverse depth between two bounds.

    Without bounds, the point closest to all optical axes is looked for; near and far are a quarter of its median depth
    and four times that.

    Args:
        cameras: the training cameras, at least one.
        count: number of points.
        near: smallest depth, world units.
        far: largest depth, world units.
        generator: source of randomness; the global one if None.

    Raises:
        ValueError: if no depth can be found because the optical axes do not meet in front of the cameras, or the bounds
            are not ``0 < near < far``.
    """
    if near is None or far is None:
        focus = _focus_depth(cameras)
        near, far = focus / 4, focus * 4
    if not 0 < near < far:
        raise ValueError(f"the depth bounds must satisfy 0 < near < far, got {near} and {far}.")
    chosen = torch.randint(len(cameras), (count,), generator=generator)
    u, v, share = torch.rand(3, count, generator=generator)
    depth = 1 / (share / near + (1 - share) / far)
    intrinsics = torch.tensor([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras], dtype=torch.float32)[
        chosen
    ]
    fx, fy, cx, cy, width, height = intrinsics.unbind(1)
    local = torch.stack([(u * width - cx) / fx * depth, (v * height - cy) / fy * depth, depth], dim=1)
    poses = torch.stack([camera.world_to_camera.to(torch.float32) for camera in cameras])[chosen]
    positions = torch.einsum("nji,nj->ni", poses[:, :3, :3], local - poses[:, :3, 3])
    return PointCloud(positions, torch.full((count, 3), 0.5), source="random", seen_by=frozenset())


def _focus_depth(cameras: Sequence[Camera]) -> float:
    """Median depth of the point with the least summed squared distance to the optical axes."""
    axes = torch.stack([camera.forward.double() for camera in cameras])
    centres = torch.stack([camera.position.double() for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    # The smallest eigenvalue is the summed squared sine of the axes' angles to their common direction.
    if torch.linalg.eigvalsh(normal)[0] > 1e-6 * len(cameras):
        point = torch.linalg.solve(normal, (across @ centres[:, :, None]).sum(0)[:, 0])
        depth = float(((point - centres) * axes).sum(1).median())
        if depth > 0:
            return depth
    raise ValueError(
        "cannot tell how far the scene is: the optical axes of the training cameras do not meet in front of them. "
        "Start from points, not from random ones: --points (points=) takes a COLMAP folder or a .ply file of the scene."
    )


def check_no_leak(points: PointCloud, train_names: Iterable[str], *, allow: bool = False) -> None:
    """Refuse points that were triangulated with the help of images outside the training split.

    A point found in a test view brings that view's geometry into training. A cloud whose origin is unknown
    (``seen_by`` is None) passes: nothing is known against it.

    Args:
        points: the initial points.
        train_names: names of the training images.
        allow: accept such points all the same.

    Raises:
        ValueError: if the points have seen other images and ``allow`` is False.

    Example:
        >>> cloud = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3), "sparse/0", frozenset({"a.png", "b.png"}))
        >>> check_no_leak(cloud, ["a.png", "b.png", "c.png"])
        >>> check_no_leak(cloud, ["a.png"])
        Traceback (most recent call last):
        ...
        ValueError: the points from sparse/0 have seen 1 image outside the training split: b.png. ...
    """
    outside = sorted((points.seen_by or frozenset()) - set(train_names))
    if outside and not allow:
        shown = ", ".join(outside[:8]) + (", ..." if len(outside) > 8 else "")
        raise ValueError(
            f"the points from {points.source} have seen {len(outside)} image{'s' * (len(outside) > 1)} outside the "
            f"training split: {shown}. Results would not count as sparse-view ones. Take points from the training "
            "views alone or random points, or pass --allow-test-points (allow_test_points=True) to use them anyway."
        )


def mean_neighbor_distance(positions: Tensor) -> Tensor:
    """Return the root mean squared distance of each point to its three nearest others.

    Convention: the INRIA code takes the logarithm of this as the initial scale of a Gaussian. Coinciding points get
    sqrt(1e-7) instead of 0. With fewer than three other points, all others count.

    Args:
        positions: world coordinates, shape (N, 3), N at least 2.

    Returns:
        Distances, shape (N,), positive.

    Raises:
        ValueError: if the shape is not (N, 3) or N is less than 2.

    Example:
        >>> mean_neighbor_distance(torch.tensor([[0.0, 0, 0], [0, 0, 2]])).tolist()
        [2.0, 2.0]
    """
    n = positions.shape[0]
    if positions.ndim != 2 or positions.shape[1] != 3 or n < 2:
        raise ValueError(f"positions must have shape (N, 3) with N >= 2, got {tuple(positions.shape)}.")
    squares, _ = nearest_neighbors(positions, min(3, n - 1))
    return squares.mean(1).clamp_min(SMALLEST_SQUARED_DISTANCE).sqrt()
