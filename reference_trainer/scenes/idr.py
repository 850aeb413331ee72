"""Scenes of IDR, NeuS and MonoSDF, most of them DTU scans: ``cameras_sphere.npz``, pictures and masks of the object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from reference_trainer.camera import Camera
from reference_trainer.npy_files import read_npz
from reference_trainer.scenes.formats import Capture, SceneFormat
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import image_size, list_images, picture_folder
from reference_trainer.scenes.options import SceneOptions

__all__ = ["IDR", "read_idr"]

FILES = ("cameras_sphere.npz", "cameras.npz")
DTU_PICTURES = (49, 64)


def read_idr(path: str | Path, folder: str | Path) -> list[Frame]:
    """Read the cameras of ``cameras_sphere.npz`` and pair them with the images of a folder, sorted by name.

    Convention: ``world_mat_<i>`` is K [R | t], world to pixels of the pictures on disk, with OpenCV axes and the
    pictures' own pixel centers. ``scale_mat_<i>`` maps the unit sphere onto the one around the object. World
    coordinates (millimeters for DTU) are kept, so that COLMAP files beside it still fit; the sphere gives the depth
    bounds. Images are matched to cameras in sorted order if there are as many, else by their names, which must be
    numbers. A folder ``mask`` beside the file holds the masks.

    Raises:
        FileNotFoundError: if the file or the folder is missing.
        ValueError: if a matrix is missing or makes no camera.
    """
    path, folder = Path(path), Path(folder)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    arrays, files = read_npz(path), [file for file in list_images(folder) if not file.stem.endswith("_normal")]
    cameras = sum(name.startswith("world_mat_") and not name.startswith("world_mat_inv") for name in arrays)
    by_name = cameras != len(files) and all(file.stem.isdecimal() for file in files)
    masks = {mask.stem: mask for mask in list_images(path.parent / "mask")} if (path.parent / "mask").is_dir() else {}
    frames = []
    for order, file in enumerate(files):
        number = int(file.stem) if by_name else order
        world, sphere = (arrays.get(f"{kind}_mat_{number}", np.eye(4)) for kind in ("world", "scale"))
        if f"world_mat_{number}" not in arrays or not (by_name or cameras == len(files)):
            raise ValueError(f"{path} has {cameras} cameras, none for {file.name}; {folder} has {len(files)} images.")
        try:
            camera = _camera(world, *image_size(file))
            bounds = _bounds(camera, sphere)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ValueError(f"{path}: world_mat_{number}, scale_mat_{number} are no camera: {error}") from error
        mask = masks.get(file.stem, masks.get(f"{number:03}"))
        frames.append(Frame(file.name, file, camera, bounds=bounds, mask=mask))
    return frames


def _camera(world: NDArray[np.float64], width: int, height: int) -> Camera:
    """Decompose K [R | t]: the RQ decomposition of K R, by the QR decomposition of its inverse."""
    if world.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"expected shape (4, 4), got {world.shape}.")
    projection = world[:3] * np.sign(np.linalg.det(world[:3, :3]))
    turned, upper = np.linalg.qr(np.linalg.inv(projection[:, :3]))
    signs = np.sign(np.diag(upper))
    intrinsics, rotation = np.linalg.inv(upper) * signs, signs[:, None] * turned.T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.linalg.solve(intrinsics, projection[:, 3])
    k = intrinsics / intrinsics[2, 2]
    if abs(k[0, 1]) > 1e-3 * k[0, 0]:
        raise ValueError(f"its pixels are skewed: K is {k.tolist()}.")
    fx, fy, cx, cy = (float(k[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(torch.from_numpy(pose), fx, fy, cx, cy, width, height)


def _bounds(camera: Camera, sphere: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the nearest and farthest depth of the sphere around the object, None if it lies behind the camera."""
    center, radius = torch.from_numpy(sphere[:3, 3].copy()), float(abs(sphere[0, 0]))
    depth = float(camera.forward @ (center - camera.position))
    return (max(depth - radius, depth / 10), depth + radius) if depth > 0 else None


def _read(root: Path, options: SceneOptions) -> Capture:
    """Read a scene folder."""
    path = next((root / name for name in FILES if (root / name).is_file()), root / FILES[0])
    usual = "image" if (root / "image").is_dir() or not (root / "images").is_dir() else "images"
    frames = read_idr(path, picture_folder(root, options.images, usual))
    return Capture(frames, split="dtu" if len(frames) in DTU_PICTURES else "llff")


IDR = SceneFormat("idr", FILES[0], lambda root: any((root / name).is_file() for name in FILES), _read)
