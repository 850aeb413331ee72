"""COLMAP reconstructions, binary or text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from reference_trainer.scenes.colmap_binary import read_cameras_binary, read_images_binary, read_points_binary
from reference_trainer.scenes.colmap_model import ColmapModel
from reference_trainer.scenes.colmap_text import read_cameras_text, read_images_text, read_points_text
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import match_images

__all__ = ["COLMAP_FOLDERS", "colmap_frames", "find_colmap", "read_colmap"]

COLMAP_FOLDERS = ("sparse/0", "sparse")
"""Where a scene folder has its reconstruction, unless the three files lie in the folder itself; the first counts."""

T = TypeVar("T")


def read_colmap(folder: str | Path) -> ColmapModel:
    """Read a reconstruction: cameras, images and points, from ``.bin`` files, or ``.txt`` where there is no ``.bin``.

    Args:
        folder: the folder of the three files, often ``sparse/0``.

    Returns:
        The reconstruction, its images sorted by name.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is truncated, inconsistent or not COLMAP's; the message names it.
    """
    folder = Path(folder)
    cameras = _read(folder, "cameras", read_cameras_binary, read_cameras_text)
    images = _read(folder, "images", read_images_binary, read_images_text)
    points = _read(folder, "points3D", read_points_binary, read_points_text)
    try:
        return ColmapModel(cameras, tuple(sorted(images, key=lambda image: image.name)), points)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error


def find_colmap(root: Path) -> Path | None:
    """Return the folder of the reconstruction of a scene, None if it has none."""
    for folder in (*(root / name for name in COLMAP_FOLDERS), root):
        if all(any((folder / f"{stem}{end}").is_file() for end in (".bin", ".txt")) for stem in ("cameras", "images")):
            return folder
    return root / COLMAP_FOLDERS[0] if (root / COLMAP_FOLDERS[0]).is_dir() else None  # to be told what is missing there


def colmap_frames(model: ColmapModel, folder: str | Path) -> list[Frame]:
    """Pair the images of a reconstruction with their files.

    Lens distortion is ignored: the frame has the pinhole part of the camera, and says how far a corner is off.

    Args:
        model: the reconstruction.
        folder: the image folder; it may hold resized copies.

    Returns:
        The frames, sorted by name.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if images are missing there, or a camera is a fisheye.
    """
    files = match_images(folder, [image.name for image in model.images])
    frames = []
    for image in model.images:
        camera = model.cameras[image.camera_id]
        pinhole = camera.pinhole(image.world_to_camera)
        frames.append(Frame(image.name, files[image.name], pinhole, camera.corner_displacement()))
    return frames


def _read(folder: Path, stem: str, binary: Callable[[Path], T], text: Callable[[Path], T]) -> T:
    """Read one of the three files in whichever form is there."""
    for suffix, reader in ((".bin", binary), (".txt", text)):
        path = folder / (stem + suffix)
        if path.is_file():
            try:
                return reader(path)
            except ValueError as error:
                raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error
    found = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else "no such folder"
    raise FileNotFoundError(f"there is no {stem}.bin or {stem}.txt in {folder}; found: {found}.")
