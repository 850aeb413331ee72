"""Camera paths between given cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from reference_trainer.camera import Camera

__all__ = ["interpolate_cameras"]


def interpolate_cameras(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Move through cameras in their order: positions on straight lines, orientations on great arcs.

    Args:
        cameras: at least two; the intrinsics and the size are those of the first.
        frames: number of cameras to return, at least 2, the first and the last given one included.

    Returns:
        Cameras at equal steps of the path parameter.

    Raises:
        ValueError: if there are fewer than two cameras or frames.

    Example:
        >>> first = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> pose = torch.eye(4)
        >>> pose[0, 3] = 1.0
        >>> [c.position[0].item() for c in interpolate_cameras([first, replace(first, world_to_camera=pose)], 3)]
        [0.0, -0.5, -1.0]
    """
    if len(cameras) < 2 or frames < 2:
        raise ValueError(f"a path needs at least 2 cameras and 2 frames, got {len(cameras)} and {frames}.")
    from kornia.geometry.quaternion import Quaternion

    rotations = [Quaternion.from_matrix(camera.world_to_camera[:3, :3]) for camera in cameras]
    path = []
    for along in torch.linspace(0, len(cameras) - 1, frames).tolist():
        i = min(int(along), len(cameras) - 2)
        rotation = rotations[i].slerp(rotations[i + 1], along - i).matrix()
        position = torch.lerp(cameras[i].position, cameras[i + 1].position, along - i)
        pose = torch.eye(4, dtype=position.dtype, device=position.device)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ position
        path.append(replace(cameras[0], world_to_camera=pose))
    return path
