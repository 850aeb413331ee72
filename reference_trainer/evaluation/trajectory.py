"""Viewpoints derived from cameras: flights through them, and the views that a scene is measured at."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import torch

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.camera import Camera
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.scenes.virtual_cameras import camera_between

__all__ = ["interpolate_cameras", "measured_views"]

_log = logging.getLogger(__name__)


def interpolate_cameras(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Move through cameras in order, in equal steps: positions along straight lines, orientations along great arcs.

    ``frames`` includes the first and the last camera; intrinsics and size are those of the first. Raises ValueError if
    there are fewer than two cameras or frames.

    Example:
        >>> first = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> pose = torch.eye(4)
        >>> pose[0, 3] = 1.0
        >>> [c.position[0].item() for c in interpolate_cameras([first, replace(first, world_to_camera=pose)], 3)]
        [0.0, -0.5, -1.0]
    """
    if len(cameras) < 2 or frames < 2:
        raise ValueError(f"a path needs at least 2 cameras and 2 frames, got {len(cameras)} and {frames}.")
    path = []
    for along in torch.linspace(0, len(cameras) - 1, frames).tolist():
        i = min(int(along), len(cameras) - 2)
        pose = camera_between(cameras[i], cameras[i + 1], along - i).world_to_camera
        path.append(replace(cameras[0], world_to_camera=pose))
    return path


def measured_views(scene: Scene) -> dict[str, Sequence[Viewpoint]]:
    """Return the views of a scene that a model is measured at, by split: ``"train"`` and ``"test"``.

    If all photographs are trained on, viewpoints without one replace the test views, and the log says so:
    ``"between"``, halfway from each training camera to its nearest neighbor, and ``"around"``, as far in the opposite
    direction. Orientations are inter- and extrapolated alike. A single camera has neither.
    """
    if scene.test:
        return {"train": scene.train, "test": scene.test}
    _log.info(
        "No test views: no quality at unseen views, only what needs no photograph there, such as exact CA, measured "
        "between and around the training views."
    )
    cameras = [view.camera for view in scene.train]
    if len(cameras) < 2:
        return {"train": scene.train}
    nearest = nearest_neighbors(torch.stack([camera.position for camera in cameras]), 1)[1][:, 0].tolist()
    pairs = sorted({(min(pair), max(pair)) for pair in enumerate(nearest)})
    new = {
        "between": [camera_between(cameras[i], cameras[j], 0.5) for i, j in pairs],
        "around": [camera_between(cameras[i], cameras[j], -0.5) for i, j in enumerate(nearest)],
    }
    numbered = {split: [Viewpoint(f"{i:03d}", camera) for i, camera in enumerate(of)] for split, of in new.items()}
    return {"train": scene.train, **numbered}
