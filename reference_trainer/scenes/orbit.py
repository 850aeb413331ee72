"""Cameras around a model that comes without a scene, such as anyone's PLY file."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reference_trainer.camera import Camera

__all__ = ["orbit_views"]

ELEVATION = math.radians(20)
"""Height of the cameras over the horizon of the centre: objects are mostly looked at from a little above."""

INSIDE = 0.98
"""Share of the opacity that the picture must hold; stray Gaussians far away would make the object tiny otherwise."""


def orbit_views(
    means: Tensor,
    opacities: Tensor,
    *,
    count: int,
    width: int,
    height: int,
    field_of_view: float = math.radians(45),
) -> list[Camera]:
    """Place cameras on a circle around a model, all looking at its centre.

    The centre is that of the box between the quantiles 1 - `INSIDE` and `INSIDE` of each coordinate, and the radius is
    the quantile `INSIDE` of the distances from it, all weighted by opacity, so that a few stray Gaussians move neither.
    The sphere of this centre and radius fills the shorter side of the picture. The first camera looks along +z, the
    others follow at equal angles towards the side of +x.

    Convention: OpenCV world, y down and z forward, as captures mostly have it: a PLY does not say where up is, and the
    axes of inertia do not tell it either (a plant is longest along it, a table shortest). The cameras are OpenCV too.
    The renderer does not draw what is nearer than 0.2: models with a radius below about 0.13 must be enlarged first.

    Args:
        means: world coordinates, finite, shape (N, 3).
        opacities: activated, in [0, 1], shape (N,) or (N, 1).
        count: number of cameras, at least 1.
        width: image width, pixels.
        height: image height, pixels.
        field_of_view: along the shorter side of the picture, radians, in (0, pi).

    Returns:
        The cameras, with float32 poses on the device of the means.

    Raises:
        ValueError: if an argument is out of range, the shapes do not match, or the Gaussians that are not transparent
            do not span a volume, because there are none or they lie on one point.

    Example:
        >>> corners = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
        >>> cameras = orbit_views(corners, torch.ones(8), count=4, width=64, height=48)
        >>> len(cameras), [round(x, 2) for x in cameras[0].forward.tolist()]  # 20 degrees downwards
        (4, [0.0, 0.34, 0.94])
    """
    if count < 1 or not 0 < field_of_view < math.pi:
        raise ValueError(f"expected count >= 1 and field_of_view in (0, pi) radians, got {count} and {field_of_view}.")
    n = means.shape[0]
    if means.shape != (n, 3) or opacities.shape not in ((n,), (n, 1)):
        raise ValueError(
            f"expected means (N, 3) and opacities (N,) or (N, 1), got {tuple(means.shape)} and "
            f"{tuple(opacities.shape)}."
        )
    points, weights = means.detach().double(), opacities.detach().double().reshape(n)
    if not bool(weights.sum() > 0):
        raise ValueError(f"there is nothing to look at: {n} Gaussians with a total opacity of 0.")
    center = torch.stack(
        [(_quantile(axis, weights, 1 - INSIDE) + _quantile(axis, weights, INSIDE)) / 2 for axis in points.unbind(1)]
    )
    radius = float(_quantile((points - center).norm(dim=1), weights, INSIDE))
    if not radius > 0:
        raise ValueError(f"the {n} Gaussians span no volume: {INSIDE:.0%} of the opacity lie on one point.")
    distance = radius / math.sin(0.5 * field_of_view)
    focal = 0.5 * min(width, height) / math.tan(0.5 * field_of_view)
    level, lift = distance * math.cos(ELEVATION), distance * math.sin(ELEVATION)
    cameras = []
    for turn in (2 * math.pi * i / count for i in range(count)):
        offset = center.new_tensor([level * math.sin(turn), -lift, -level * math.cos(turn)])
        pose = _look_at(center + offset, center)
        cameras.append(Camera(pose.float(), focal, focal, width / 2, height / 2, width, height))
    return cameras


def _quantile(values: Tensor, weights: Tensor, share: float) -> Tensor:
    """Return the smallest value that, with all below it, holds this share of the weight."""
    ordered, order = values.sort()
    held = weights[order].cumsum(0)
    return ordered[torch.searchsorted(held, share * held[-1])]


def _look_at(position: Tensor, target: Tensor) -> Tensor:
    """Return the view matrix (4, 4) of a camera that looks at a target with -y of the world upright."""
    forward = normalize(target - position, dim=0)
    down = position.new_tensor([0.0, 1.0, 0.0])
    right = normalize(torch.linalg.cross(down, forward), dim=0)
    pose = torch.eye(4, dtype=position.dtype, device=position.device)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose
