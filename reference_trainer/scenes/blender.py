"""Blender (NeRF-synthetic) scenes: ``transforms_train.json`` and ``transforms_test.json``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reference_trainer.camera import Camera
from reference_trainer.json_files import read_json
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import IMAGE_SUFFIXES, image_size, path_inside

__all__ = ["read_transforms"]


def read_transforms(path: str | Path) -> list[Frame]:
    """Read the frames of one ``transforms_*.json``, in the order of the file.

    Convention: ``transform_matrix`` is camera to world with OpenGL axes (x right, y up, z back); the frames' cameras
    are OpenCV and world to camera. The focal length is ``fl_x`` and ``fl_y``, pixels, for a picture of ``w`` x ``h``,
    else it follows from the horizontal field of view ``camera_angle_x``, radians. The principal point ``cx``, ``cy`` is
    the centre of the picture unless given. ``file_path`` is relative to the JSON file; without an extension it means a
    PNG file.

    Args:
        path: the JSON file.

    Returns:
        The frames; their names are the file paths without a leading ``./`` and without extension.

    Raises:
        FileNotFoundError: if the file or an image is missing.
        ValueError: if the file is not what is described above, or a path leads out of the scene folder.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    try:
        content = read_json(path)
        entries = content["frames"]
        if not isinstance(entries, list):
            raise TypeError(f"frames must be a list, got a {type(entries).__name__}")
        frames = [_frame(path, content, entry) for entry in entries]
    except FileNotFoundError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, OSError) as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is not a valid transforms file: {reason}") from error
    if len({frame.name for frame in frames}) != len(frames):
        raise ValueError(f"{path} lists an image twice.")
    return frames


def _frame(path: Path, content: dict[str, Any], entry: dict[str, Any]) -> Frame:
    """Build one frame from its entry."""
    file = path_inside(path.parent, entry["file_path"])
    if file == path.parent:
        raise ValueError(f"file_path {entry['file_path']!r} names the scene folder itself, not an image.")
    if file.suffix.lower() not in IMAGE_SUFFIXES:
        file = file.with_name(file.name + ".png")
    width, height = (int(content["w"]), int(content["h"])) if "w" in content else image_size(file)
    if "fl_x" in content:
        fx = float(content["fl_x"])
    else:
        angle = float(content["camera_angle_x"])
        if not 0 < angle < math.pi:
            raise ValueError(f"camera_angle_x must be in (0, pi) radians, got {angle}.")
        fx = 0.5 * width / math.tan(0.5 * angle)
    camera = Camera(
        _world_to_camera(entry),
        fx=fx,
        fy=float(content.get("fl_y", fx)),
        cx=float(content.get("cx", width / 2)),
        cy=float(content.get("cy", height / 2)),
        width=width,
        height=height,
    )
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    if not all(map(math.isfinite, intrinsics)):
        raise ValueError(f"focal lengths and principal point must be finite, got fx, fy, cx, cy = {intrinsics}.")
    name = file.relative_to(path.parent).with_suffix("").as_posix()
    return Frame(name, file, camera)


def _world_to_camera(entry: dict[str, Any]) -> torch.Tensor:
    """Convert an OpenGL camera-to-world matrix to the OpenCV view matrix (4, 4), float64."""
    matrix = np.array(entry["transform_matrix"], np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(
            f"transform_matrix of {entry['file_path']} must be a finite 4x4 matrix, got {matrix.tolist()}."
        )
    rotation = (matrix[:3, :3] * [1, -1, -1]).T
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(f"transform_matrix of {entry['file_path']} holds no rotation: {matrix[:3, :3].tolist()}.")
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ matrix[:3, 3]
    return torch.from_numpy(pose)
