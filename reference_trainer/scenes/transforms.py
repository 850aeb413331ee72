"""Scenes with ``transforms.json`` (nerfstudio, instant-ngp) or Blender's pair of train and test (NeRF-synthetic)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from reference_trainer.camera import Camera
from reference_trainer.json_files import read_json
from reference_trainer.scenes.formats import Capture, SceneFormat, only_default
from reference_trainer.scenes.frames import Frame, view_matrix
from reference_trainer.scenes.images import IMAGE_SUFFIXES, image_size, path_inside
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.points import ply_points
from reference_trainer.scenes.scene import PointCloud

__all__ = ["BLENDER", "TRANSFORMS", "read_transforms"]

_OPENCV = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")  # models that are parts of its model


def read_transforms(path: Path, images: str | None = None) -> list[Frame]:
    """Read the frames of one ``transforms*.json``, in the order of the file.

    Convention: ``transform_matrix`` is camera to world with OpenGL axes (x right, y up, z back); the frames' cameras
    are OpenCV and world to camera. nerfstudio's ``applied_transform`` is undone, so that the world is that of the
    COLMAP files it came from. The focal length is ``fl_x`` and ``fl_y``, pixels, for a picture of ``w`` x ``h``, or
    without these for that of ``file_path``; else it follows from the horizontal field of view ``camera_angle_x``,
    radians. The principal point ``cx``, ``cy`` is the center of the picture unless given; ``k1 k2 p1 p2 k3`` are
    OpenCV's distortion. A frame may override each of these. ``file_path`` is relative to the JSON file or absolute;
    without an extension it means a PNG file, or else another picture of that name. With ``images``, pictures of the
    same names are taken from that folder beside the file. ``mask_path`` is that of a mask, white where the picture
    counts. Frames are named by the relative path of their picture, without extension.

    Raises:
        FileNotFoundError: if the file or images are missing.
        ValueError: if the file is not as described above, has a fisheye camera, or a path leads out of the scene
            folder.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    try:
        content = read_json(path)
        entries = content["frames"]
        if not isinstance(entries, list):
            raise TypeError(f"frames must be a list, got a {type(entries).__name__}")
        files = [_file(path.parent, entry["file_path"], images) for entry in entries]
        missing = [str(file) for file in files if not file.is_file()]
        if missing:
            raise FileNotFoundError(f"{path} names {len(missing)} images that are not there, such as {missing[:3]}.")
        undo = _undo(content)
        frames = [_frame(path, file, content | entry, undo) for file, entry in zip(files, entries, strict=True)]
    except FileNotFoundError:  # an OSError too, but no fault of this file's content
        raise
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, OSError) as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is not a valid transforms file: {reason}") from error
    if len({frame.name for frame in frames}) != len(frames):
        raise ValueError(f"{path} lists an image twice.")
    return frames


def _file(root: Path, file_path: str, images: str | None) -> Path:
    """Find the picture of a frame."""
    file = _inside(root, file_path)
    if file == root:
        raise ValueError(f"file_path {file_path!r} names the scene folder itself, not an image.")
    if images is not None:
        file = root / images / file.name
    if file.suffix.lower() in IMAGE_SUFFIXES:
        return file
    named = [file.with_name(file.name + suffix) for suffix in (".png", *sorted(IMAGE_SUFFIXES))]
    return next((path for path in named if path.is_file()), named[0])


def _inside(root: Path, name: str) -> Path:
    """Return the path of a file of the scene, which may have been written on Windows."""
    return path_inside(root, name.replace("\\", "/"))


def _frame(path: Path, file: Path, entry: dict[str, Any], undo: NDArray[np.float64]) -> Frame:
    """Build one frame from its entry, to which the file's shared values have been added."""
    measured = _file(path.parent, entry["file_path"], None) if "fl_x" in entry else file  # whose pixels are meant
    width, height = (int(entry["w"]), int(entry["h"])) if "w" in entry else image_size(measured)
    if (fx := entry.get("fl_x")) is None:
        angle = float(entry["camera_angle_x"])
        if not 0 < angle < math.pi:
            raise ValueError(f"camera_angle_x must be in (0, pi) radians, got {angle}.")
        fx = 0.5 * width / math.tan(0.5 * angle)
    camera = Camera(
        _world_to_camera(entry, undo),
        fx=fx,
        fy=entry.get("fl_y", fx),
        cx=entry.get("cx", width / 2),
        cy=entry.get("cy", height / 2),
        width=width,
        height=height,
    )
    distortion = tuple(float(entry.get(name, 0)) for name in ("k1", "k2", "p1", "p2", "k3"))
    if not all(map(math.isfinite, distortion)):
        raise ValueError(f"the distortion must be finite, got {distortion}.")
    model = str(entry.get("camera_model", "OPENCV"))
    if model not in _OPENCV or entry.get("is_fisheye") or entry.get("k4"):
        raise ValueError(f"its camera {model} is no lens of OpenCV's model with k1 k2 p1 p2 k3: undistort it first")
    name = file.relative_to(path.parent).with_suffix("").as_posix()
    mask = _inside(path.parent, entry["mask_path"]) if entry.get("mask_path") else None
    return Frame(name, file, camera, distortion if any(distortion) else (), mask=mask)


def _undo(content: dict[str, Any]) -> NDArray[np.float64]:
    """Return the inverse (4, 4) of the transform that nerfstudio has applied to the world."""
    matrix = np.eye(4)
    matrix[:3] = np.array(content.get("applied_transform", matrix[:3]), np.float64)[:3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
        raise ValueError(f"applied_transform must be a finite 3x4 matrix with an inverse, got {matrix[:3].tolist()}.")
    inverse: NDArray[np.float64] = np.linalg.inv(matrix).astype(np.float64)
    return inverse


def _world_to_camera(entry: dict[str, Any], undo: NDArray[np.float64]) -> torch.Tensor:
    """Convert an OpenGL camera-to-world matrix to the OpenCV view matrix (4, 4), float64."""
    matrix = np.array(entry["transform_matrix"], np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(
            f"transform_matrix of {entry['file_path']} must be a finite 4x4 matrix, got {matrix.tolist()}."
        )
    matrix = undo @ matrix
    try:
        # The columns are the camera's axes in the world: OpenGL's up and back become OpenCV's down and forward.
        return view_matrix((matrix[:3, :3] * [1, -1, -1]).T, matrix[:3, 3])
    except ValueError as error:
        raise ValueError(f"transform_matrix of {entry['file_path']}: {error}") from error


def _points(path: Path, content: dict[str, Any], frames: list[Frame], options: SceneOptions) -> PointCloud | None:
    """Read the points that the file names, if any: in the world of its matrices, and possibly from any image."""
    if "ply_file_path" not in content or options.init is not None or options.points.startswith("random"):
        return None
    file = _inside(path.parent, str(content["ply_file_path"]))
    if not file.is_file():
        raise FileNotFoundError(
            f"{path} names the points {file}, which are not there: copy them, or say --points random."
        )
    cloud = ply_points(file)
    undo = torch.from_numpy(_undo(content)).to(cloud.positions)
    positions = cloud.positions @ undo[:3, :3].T + undo[:3, 3]
    return replace(cloud, positions=positions, seen_by=frozenset(frame.name for frame in frames))


def _read_transforms(root: Path, options: SceneOptions) -> Capture:
    """Read a scene of one file."""
    path = root / "transforms.json"
    frames, content = read_transforms(path, options.images), read_json(path)
    points, split = _points(path, content, frames, options), "transforms" if "train_filenames" in content else "llff"
    # Split rules count photographs by name; the file may list them in any order.
    return Capture(sorted(frames, key=lambda frame: frame.name), points=points, split=split)


def _read_blender(root: Path, options: SceneOptions) -> Capture:
    """Read a scene of a training and a test file."""
    only_default("blender", images=options.images, split=options.split)
    train, test = (root / f"transforms_{kind}.json" for kind in ("train", "test"))
    held_out = None if options.test == "none" and not test.is_file() else read_transforms(test)
    return Capture(read_transforms(train), held_out, views=8, background="white")


BLENDER = SceneFormat(
    "blender", "transforms_train.json", lambda root: (root / "transforms_train.json").is_file(), _read_blender
)
TRANSFORMS = SceneFormat(
    "transforms", "transforms.json", lambda root: (root / "transforms.json").is_file(), _read_transforms
)
