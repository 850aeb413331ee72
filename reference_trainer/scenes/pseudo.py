"""Cameras between and around the training cameras, for losses that need no photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch.nn.functional import normalize

from reference_trainer.camera import Camera, pixels_of
from reference_trainer.scenes.orbit import look_at
from reference_trainer.scenes.scene import Scene

__all__ = ["depth_bounds", "pseudo_cameras"]


def pseudo_cameras(scene: Scene) -> Callable[[torch.Generator], Camera]:
    """Return a function that draws cameras at random among the training cameras, as CoR-GS does on LLFF and DTU.

    A camera stands anywhere in the box of the training cameras that is centred on their mean position, its edges along
    the axes of their mean orientation, and looks at one point on the mean axis, at the depth
    ``1 / (0.25 / (0.9 near) + 0.75 / (5 far))``. Size and focal lengths are those of the first training camera, the
    principal point is the picture's middle. ``near`` and ``far`` are `depth_bounds` of the initial points; the sources
    read them from ``poses_bounds.npy``.

    Raises:
        ValueError: if the scene has no points in its pictures, or the cameras look to too different sides, such as
            from around an object: they have no mean direction.

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


def depth_bounds(scene: Scene) -> tuple[float, float]:
    """Return the least and the largest depth of the scene, those of one point in a thousand in each picture apart.

    Convention: LLFF's ``poses_bounds.npy`` holds these two percentiles, 0.1 and 99.9, for every photograph.

    Raises:
        ValueError: if no initial point lies within a training picture.
    """
    positions = torch.empty(0, 3) if scene.points is None else scene.points.positions
    bounds = []
    for view in scene.train:
        pose = view.camera.world_to_camera
        depths = (positions @ pose[2, :3] + pose[2, 3])[pixels_of(positions, view.camera)[2]]
        if len(depths):
            bounds.append(depths.quantile(depths.new_tensor([0.001, 0.999])).tolist())
    if not bounds:
        raise ValueError(f"scene {scene.name!r} has no initial point in a training picture: give other points.")
    return min(near for near, _ in bounds), max(far for _, far in bounds)
