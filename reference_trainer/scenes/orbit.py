"""Cameras around a model that comes without a scene, such as anyone's PLY file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reference_trainer.camera import Camera
from reference_trainer.scenes.options import OrbitOptions, World

__all__ = ["BoundingSphere", "bounding_sphere", "look_at", "orbit_cameras", "orbit_views"]

ELEVATION = math.radians(20)
"""Elevation of the cameras above the center: objects are mostly looked at from a little above."""

FIELD_OF_VIEW = math.radians(45)
"""Along the shorter side of the picture."""

INSIDE = 0.98
"""Share of the opacity that the picture must hold; with all of it, stray Gaussians would make the object tiny."""

SURROUNDINGS = 3.0
"""A model is an object with surroundings if the radius around its median point that holds `INSIDE` of the opacity is
more than this many times the radius that holds half: 1.6 to 1.9 for objects (a plant, a mesh, lego), 5 for fern."""


@dataclass(frozen=True)
class BoundingSphere:
    """The part of a model to look at: center (3,), float64, and radius, world units.

    With ``surroundings`` it is the middle of a place, such as a room, rather than a whole object.
    """

    center: Tensor
    radius: float
    surroundings: bool


def orbit_cameras(options: OrbitOptions, means: Tensor, opacities: Tensor) -> list[Camera]:
    """Place the cameras that options describe around Gaussians; other arguments and errors are those of `orbit_views`.

    Example:
        >>> [camera.width for camera in orbit_cameras(OrbitOptions(2, size=64), torch.eye(3), torch.ones(3))]
        [64, 64]
    """
    return orbit_views(
        means,
        opacities,
        count=options.cameras,
        width=options.size,
        height=options.size,
        fill=0.8,  # so that what lies outside the bounding sphere, such as a plant's highest leaf, shows too
        world=options.world,
        arc=math.radians(options.arc),
    )


def orbit_views(
    means: Tensor,
    opacities: Tensor,
    *,
    count: int,
    width: int,
    height: int,
    fill: float = 1.0,
    world: World = "y-down",
    arc: float = 2 * math.pi,
) -> list[Camera]:
    """Place cameras on a circle around a model, all looking at its center.

    The `bounding_sphere` spans the share ``fill`` of the shorter side of the picture. In a y-down world the first
    camera of a full circle faces +z, looking slightly down, and the others follow at equal angles, moving towards +x;
    an arc is centered on that first camera and has a camera at both ends.

    Convention: the world is y down and z forward (OpenCV) unless told otherwise, as in most captures: a PLY file does
    not say where up is, nor do the axes of inertia (a plant is longest along it, a table shortest). Blender and
    nerfstudio have z up. The cameras are OpenCV.
    The renderer clips at depth 0.2: models with a radius below about 0.13 must be enlarged first.

    Args:
        means: as for `bounding_sphere`.
        opacities: as for `bounding_sphere`.
        count: number of cameras.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        fill: diameter of the sphere as a share of the shorter side, in (0, 1].
        world: the vertical axis.
        arc: angle between the first and the last camera, radians, in (0, 2 pi]; a full circle has no camera twice.
            A model captured from one side (LLFF scenes) looks sensible on a small arc only.

    Raises:
        ValueError: if an argument is out of range, or `bounding_sphere` raises it.

    Example:
        >>> corners = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
        >>> cameras = orbit_views(corners, torch.ones(8), count=4, width=64, height=48)
        >>> len(cameras), [round(x, 2) for x in cameras[0].forward.tolist()]  # 20 degrees downwards
        (4, [0.0, 0.34, 0.94])
    """
    if count < 1 or not 0 < fill <= 1 or not 0 < arc <= 2 * math.pi or world not in get_args(World):
        raise ValueError(
            f"expected count >= 1, fill in (0, 1], arc in (0, 2 pi] and world one of {', '.join(get_args(World))}; got "
            f"{count}, {fill}, {arc} and {world!r}."
        )
    sphere = bounding_sphere(means, opacities)
    center, half_angle = sphere.center, math.atan(fill * math.tan(0.5 * FIELD_OF_VIEW))
    distance = sphere.radius / math.sin(half_angle)
    focal = 0.5 * min(width, height) / math.tan(0.5 * FIELD_OF_VIEW)
    level, lift = distance * math.cos(ELEVATION), distance * math.sin(ELEVATION)
    full = arc > 2 * math.pi * (1 - 1e-9)
    start, step = (0.0, arc / count) if full else (-0.5 * arc if count > 1 else 0.0, arc / max(1, count - 1))
    axes = _axes(world).to(center)
    cameras = []
    for turn in (start + step * i for i in range(count)):
        offset = center.new_tensor([level * math.sin(turn), -lift, -level * math.cos(turn)])
        pose = look_at(center + axes @ offset, center, axes[:, 1])
        cameras.append(Camera(pose.float(), focal, focal, width / 2, height / 2, width, height))
    return cameras


def bounding_sphere(means: Tensor, opacities: Tensor) -> BoundingSphere:
    """Find where the Gaussians of a model are, robust to a few stray ones.

    For an object, the center is that of the box between the quantiles 1 - `INSIDE` and `INSIDE` of each coordinate, and
    the radius is the quantile `INSIDE` of the distances from it. For a place with `SURROUNDINGS`, where that sphere
    would be the room, the center is the median and the radius is twice the median distance from it. Quantiles are
    weighted by the activated opacities, (N,) or (N, 1); the means (N, 3) are finite world coordinates.

    Raises:
        ValueError: if the shapes do not match, or the opacity is all 0 or concentrated at one point.

    Example:
        >>> sphere = bounding_sphere(torch.tensor([[1.0, 0, 0], [3.0, 0, 0]]), torch.ones(2))
        >>> sphere.center.tolist(), sphere.radius, sphere.surroundings
        ([2.0, 0.0, 0.0], 1.0, False)
    """
    n = means.shape[0]
    if means.shape != (n, 3) or opacities.shape not in ((n,), (n, 1)):
        raise ValueError(
            f"expected means (N, 3) and opacities (N,) or (N, 1), got {tuple(means.shape)} and "
            f"{tuple(opacities.shape)}."
        )
    points, weights = means.detach().double(), opacities.detach().double().reshape(n)
    if not bool(weights.sum() > 0):
        raise ValueError(f"there is nothing to look at: {n} Gaussians with a total opacity of 0.")
    median = torch.stack([_quantile(axis, weights, 0.5) for axis in points.unbind(1)])
    near, far = (float(_quantile((points - median).norm(dim=1), weights, share)) for share in (0.5, INSIDE))
    if near > 0 and far > SURROUNDINGS * near:
        return BoundingSphere(median, 2 * near, surroundings=True)
    center = torch.stack(
        [(_quantile(axis, weights, 1 - INSIDE) + _quantile(axis, weights, INSIDE)) / 2 for axis in points.unbind(1)]
    )
    radius = float(_quantile((points - center).norm(dim=1), weights, INSIDE))
    if not radius > 0:
        raise ValueError(f"the {n} Gaussians span no volume: {INSIDE:.0%} of the opacity lie on one point.")
    return BoundingSphere(center, radius, surroundings=False)


def _axes(world: World) -> Tensor:
    """Return the rotation whose columns are the directions right, down and forward in this world."""
    vertical, sign = "xyz".index(world[0]), 1.0 if world.endswith("down") else -1.0
    down = torch.eye(3, dtype=torch.float64)[vertical] * sign
    right = torch.eye(3, dtype=torch.float64)[1 if vertical == 0 else 0]
    return torch.stack([right, down, torch.linalg.cross(right, down)], dim=1)


def _quantile(values: Tensor, weights: Tensor, share: float) -> Tensor:
    """Return the weighted quantile: the smallest value that, with all below it, holds this share of the weight."""
    ordered, order = values.sort()
    held = weights[order].cumsum(0)
    return ordered[torch.searchsorted(held, share * held[-1])]


def look_at(position: Tensor, target: Tensor, down: Tensor) -> Tensor:
    """Return the view matrix (4, 4) of a camera that looks at a target, upright."""
    forward = normalize(target - position, dim=0)
    right = normalize(torch.linalg.cross(down, forward), dim=0)
    pose = torch.eye(4, dtype=position.dtype, device=position.device)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose
