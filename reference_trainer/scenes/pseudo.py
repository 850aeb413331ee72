"""Virtual cameras between and around the training cameras, for losses that need no photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import torch
from torch.nn.functional import normalize

from reference_trainer.camera import Camera
from reference_trainer.scenes.orbit import look_at
from reference_trainer.scenes.scene import Scene

__all__ = ["VIRTUAL_VIEWS", "CameraPath", "camera_between", "cameras_between", "depth_bounds", "pseudo_cameras"]

CameraPath = Literal["line", "arc"]


def pseudo_cameras(scene: Scene) -> Callable[[torch.Generator], Camera]:
    """Return a function that draws random cameras among the training cameras, as CoR-GS does on LLFF and DTU.

    Positions are uniform in the box that is centered on the mean training position, has its edges along the axes of the
    mean orientation and just reaches every training camera. All cameras look at the point on the mean optical axis at
    the depth ``1 / (0.25 / (0.9 near) + 0.75 / (5 far))``. Size and focal lengths are those of the first training
    camera, the principal point is the picture's center. ``near`` and ``far`` are the `depth_bounds` of the initial
    points; the sources read them from ``poses_bounds.npy``.

    Raises:
        ValueError: if no initial point lies in a training picture, or the viewing directions differ too much to have
            a mean, as around an object.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> draw = pseudo_cameras(synthetic_scene(width=32, height=24, points=50))
        >>> draw(torch.Generator().manual_seed(0)).width
        32
    """
    cameras = [view.camera for view in scene.train]
    rotations = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    positions = torch.stack([camera.position.double() for camera in cameras])
    down, forward = rotations[:, 1].mean(0), rotations[:, 2].mean(0)
    if forward.norm() < 0.5:
        raise ValueError(
            f"pseudo views need training cameras that look to one side; the mean of their axes is {forward.norm():.2f} "
            "long and should be near 1: leave out what compares at pseudo views."
        )
    near, far = depth_bounds(scene)
    center = positions.mean(0)
    axes = look_at(center, center + forward, down)[:3, :3]
    reach = ((positions - center) @ axes.T).abs().amax(0)
    target = center + normalize(forward, dim=0) / (0.25 / (0.9 * near) + 0.75 / (5 * far))
    first = cameras[0]

    def draw(generator: torch.Generator) -> Camera:
        place = 2 * torch.rand(3, generator=generator, device=generator.device).to(reach) - 1
        pose = look_at(center + (place * reach) @ axes, target, down)
        cx, cy = first.width / 2, first.height / 2
        return replace(first, world_to_camera=pose.to(generator.device, first.world_to_camera.dtype), cx=cx, cy=cy)

    return draw


def cameras_between(
    scene: Scene, path: CameraPath = "arc", *, past: float = -0.15
) -> Callable[[torch.Generator], Camera]:
    """Return a function that draws cameras between two random training cameras, with the intrinsics of one of them.

    Args:
        scene: with the training cameras.
        path: the path from one to the other, see `camera_between`.
        past: how far beyond either end a camera may stand, as a share of the path; by default 0.15 short of both.

    Raises:
        ValueError: if the scene has fewer than two training cameras.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> draw = cameras_between(synthetic_scene(width=32, height=24, points=50))
        >>> draw(torch.Generator().manual_seed(0)).width
        32
    """
    cameras = [view.camera for view in scene.train]
    if len(cameras) < 2:
        raise ValueError(f"virtual views lie between two training cameras, and {scene.name!r} has {len(cameras)}.")

    def draw(generator: torch.Generator) -> Camera:
        first, second = torch.randperm(len(cameras), generator=generator, device=generator.device)[:2].tolist()
        along = (1 + 2 * past) * torch.rand((), generator=generator, device=generator.device).item() - past
        return camera_between(cameras[first], cameras[second], along, path).to(generator.device)

    return draw


@torch.no_grad()
def camera_between(first: Camera, second: Camera, along: float, path: CameraPath = "line") -> Camera:
    """Return the first camera moved and turned towards the second; ``along`` is 0 at the first and 1 at the second.

    Orientations are interpolated along the great arc. Positions follow the straight line, or the ``"arc"`` of the screw
    motion between the poses: cameras that look at a common point from one distance move around it, facing it.

    Example:
        >>> pose = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # half a turn around the origin, 2 in front of both
        >>> one, other = (Camera(p, 9, 9, 4, 4, 8, 8) for p in (torch.eye(4), pose))
        >>> for camera in (one, other):
        ...     camera.world_to_camera[2, 3] = 2
        >>> for path in get_args(CameraPath):
        ...     [round(x, 3) for x in camera_between(one, other, 0.5, path).position.abs().tolist()]
        [0.0, 0.0, 0.0]
        [2.0, 0.0, 0.0]
    """
    from kornia.geometry.liegroup import Se3

    start, end = (Se3.from_matrix(camera.world_to_camera.double()) for camera in (first, second))
    pose = (Se3.exp(along * (end * start.inverse()).log()) * start).matrix()
    if path == "line":
        pose[:3, 3] = -pose[:3, :3] @ torch.lerp(first.position, second.position, along).to(pose)
    return replace(first, world_to_camera=pose.to(first.world_to_camera))


VIRTUAL_VIEWS = {"box": pseudo_cameras} | {path: partial(cameras_between, path=path) for path in get_args(CameraPath)}
VIRTUAL_VIEWS["beyond"] = partial(cameras_between, past=0.5)
"""Where virtual cameras may stand, by name: functions from a scene to a function that draws such cameras."""


def depth_bounds(scene: Scene) -> tuple[float, float]:
    """Return the smallest and the largest depth of the initial points, robust to one outlier in a thousand per end.

    Convention: LLFF's ``poses_bounds.npy`` holds these two percentiles, 0.1 and 99.9, for every photograph.

    Raises:
        ValueError: if no initial point lies within a training picture.
    """
    bounds = []
    for view in scene.train:
        pixels, depths = view.camera.project(scene.points.positions)
        depths = depths[view.camera.inside(pixels, depths)]
        if len(depths):
            bounds.append(depths.quantile(depths.new_tensor([0.001, 0.999])).tolist())
    if not bounds:
        raise ValueError(f"scene {scene.name!r} has no initial point in a training picture: give other points.")
    return min(near for near, _ in bounds), max(far for _, far in bounds)
