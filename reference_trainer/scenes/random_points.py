"""Random initial points: in a box, or in the cameras' frusta."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from reference_trainer.camera import Camera
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.scene import PointCloud

__all__ = ["random_points", "random_points_in_frusta"]

BLENDER_BOX = 1.3  # half the edge of the box that holds every NeRF-synthetic object, as in the INRIA code


def random_points(train: Sequence[Frame], count: int, generator: torch.Generator) -> PointCloud:
    """Draw gray points where the training cameras look.

    They fill the NeRF-synthetic box if its center lies in all training pictures and all training cameras stand outside
    it, else the cameras' frusta, between the scene file's depth bounds if it has any, else between a quarter and four
    times the median depth of the point closest to all optical axes.

    Raises:
        ValueError: if the optical axes that must give the bounds do not meet in front of the cameras, or the bounds are
            not ``0 < near < far``.
    """
    cameras = [frame.camera for frame in train]
    if all(map(_looks_at_box, cameras)):
        positions = (2 * torch.rand(count, 3, generator=generator) - 1) * BLENDER_BOX
        return PointCloud(positions, torch.full((count, 3), 0.5), source="random", seen_by=frozenset())
    bounds = [frame.bounds for frame in train if frame.bounds is not None]
    if bounds:
        near, far = min(near for near, _ in bounds), max(far for _, far in bounds)
    else:
        focus = _focus_depth(cameras)
        near, far = focus / 4, focus * 4
    return random_points_in_frusta(cameras, count, near=near, far=far, generator=generator)


def _looks_at_box(camera: Camera) -> bool:
    """Whether the camera stands outside the NeRF-synthetic box and has its center, the origin, in the picture."""
    outside = float(camera.position.abs().max()) > BLENDER_BOX
    return outside and bool(camera.inside(*camera.project(torch.zeros(3))))


def random_points_in_frusta(
    cameras: Sequence[Camera], count: int, *, near: float, far: float, generator: torch.Generator
) -> PointCloud:
    """Draw gray points in the cameras' frusta: uniform over the picture and in inverse depth between two bounds.

    The bounds are in world units. Raises ValueError if they are not ``0 < near < far``.
    """
    if not 0 < near < far:
        raise ValueError(f"the depth bounds must satisfy 0 < near < far, got {near} and {far}.")
    chosen = torch.randint(len(cameras), (count,), generator=generator)
    u, v, share = torch.rand(3, count, generator=generator)
    depth = 1 / (share / near + (1 - share) / far)
    positions = torch.empty(count, 3)
    for number, camera in enumerate(cameras):
        mine = chosen == number
        pixels = torch.stack([u[mine] * camera.width, v[mine] * camera.height], dim=1)
        positions[mine] = camera.lift(pixels, depth[mine])
    return PointCloud(positions, torch.full((count, 3), 0.5), source="random", seen_by=frozenset())


def _focus_depth(cameras: Sequence[Camera]) -> float:
    """Median depth of the point with the least summed squared distance to the optical axes."""
    axes = torch.stack([camera.forward.double() for camera in cameras])
    centers = torch.stack([camera.position.double() for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    # The smallest eigenvalue is the summed squared sine of the axes' angles to their common direction.
    if torch.linalg.eigvalsh(normal)[0] > 1e-6 * len(cameras):
        point = torch.linalg.solve(normal, (across @ centers[:, :, None]).sum(0)[:, 0])
        depth = float(((point - centers) * axes).sum(1).median())
        if depth > 0:
            return depth
    raise ValueError(
        "cannot tell how far the scene is: the optical axes of the training cameras do not meet in front of them. "
        "Start from points, not from random ones: --points (points=) takes a COLMAP folder or a .ply file of the scene."
    )
