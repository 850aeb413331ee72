"""LLFF scenes: ``poses_bounds.npy`` beside a folder of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reference_trainer.camera import Camera
from reference_trainer.npy_files import read_npy
from reference_trainer.scenes.formats import Capture, SceneFormat
from reference_trainer.scenes.frames import Frame, view_matrix
from reference_trainer.scenes.images import list_images, picture_folder
from reference_trainer.scenes.options import SceneOptions

__all__ = ["LLFF", "read_llff"]


def read_llff(path: str | Path, folder: str | Path) -> list[Frame]:
    """Read the cameras of ``poses_bounds.npy`` and pair them with the images of a folder in sorted order.

    Convention: each row holds a (3, 5) matrix, row-major, and the nearest and farthest depth. The matrix is
    [R | t | (height, width, focal length)], camera to world, with the camera's axes down, right, back. The principal
    point is the center of the picture. The frames' cameras are OpenCV and world to camera.

    Raises:
        FileNotFoundError: if the file or the folder is missing.
        ValueError: if the file does not hold (N, 17) finite numbers with valid rotations, or there are not N images.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    rows = read_npy(path.read_bytes(), path)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise ValueError(f"{path} must hold floats of shape (N, 17), got shape {rows.shape}.")
    files = list_images(folder)
    if len(files) != len(rows):
        raise ValueError(f"{path} has {len(rows)} poses but {folder} has {len(files)} images; each needs one.")
    frames = []
    for file, row in zip(files, rows, strict=True):
        try:
            frames.append(Frame(file.name, file, _camera(row), bounds=(float(row[15]), float(row[16]))))
        except ValueError as error:
            raise ValueError(f"{path}: the row of {file.name} is no camera: {error}") from error
    return frames


def _camera(row: NDArray[np.float64]) -> Camera:
    """Build the camera of one row."""
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()
    down, right, back = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    pose = view_matrix(np.stack([right, down, -back]), matrix[:, 3])
    return Camera(pose, focal, focal, width / 2, height / 2, width=round(width), height=round(height))


def _read(root: Path, options: SceneOptions) -> Capture:
    """Read a scene folder."""
    return Capture(read_llff(root / "poses_bounds.npy", picture_folder(root, options.images)))


LLFF = SceneFormat("llff", "poses_bounds.npy", lambda root: (root / "poses_bounds.npy").is_file(), _read)
