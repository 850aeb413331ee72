"""Formats whose cameras are NumPy files: LLFF, IDR (most of them DTU scans), and an ``.npz`` of predicted poses."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from reference_trainer.camera import Camera
from reference_trainer.npy_files import read_npy, read_npz
from reference_trainer.scenes.formats import Capture, SceneFormat
from reference_trainer.scenes.frames import Frame, view_matrix
from reference_trainer.scenes.images import image_folder, image_size, list_images, match_images
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import PointCloud

__all__ = ["ARRAYS", "IDR", "LLFF", "read_arrays", "read_idr", "read_llff"]


def read_llff(path: Path, folder: Path) -> list[Frame]:
    """Read the cameras of ``poses_bounds.npy`` and pair them with the images of a folder in sorted order.

    Convention: each row holds a (3, 5) matrix, row-major, and the nearest and farthest depth. The matrix is
    [R | t | (height, width, focal length)], camera to world, with the camera's axes down, right, back. The principal
    point is the center of the picture. The frames' cameras are OpenCV and world to camera.

    Raises:
        FileNotFoundError: if the file or the folder is missing.
        ValueError: if the file does not hold (N, 17) finite numbers with valid rotations, or there are not N images.
    """
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
            frames.append(Frame(file.name, file, _llff_camera(row), bounds=(float(row[15]), float(row[16]))))
        except ValueError as error:
            raise ValueError(f"{path}: the row of {file.name} is no camera: {error}") from error
    return frames


def _llff_camera(row: NDArray[np.float64]) -> Camera:
    """Build the camera of one row."""
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()
    down, right, back = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    pose = view_matrix(np.stack([right, down, -back]), matrix[:, 3])
    return Camera(pose, focal, focal, width / 2, height / 2, width=round(width), height=round(height))


def _read_llff_scene(root: Path, options: SceneOptions) -> Capture:
    """Read a scene folder."""
    return Capture(read_llff(root / "poses_bounds.npy", image_folder(root, options.images)))


LLFF = SceneFormat("llff", "poses_bounds.npy", lambda root: (root / "poses_bounds.npy").is_file(), _read_llff_scene)


IDR_FILES = ("cameras_sphere.npz", "cameras.npz")
DTU_IMAGES = (49, 64)


def read_idr(path: Path, folder: Path) -> list[Frame]:
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
            for matrix in (world, sphere):
                if matrix.shape not in ((4, 4), (3, 4)):
                    raise ValueError(f"expected shape (4, 4), got {matrix.shape}.")
            camera = _idr_camera(world, *image_size(file))
            bounds = _sphere_bounds(camera, sphere)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ValueError(f"{path}: world_mat_{number}, scale_mat_{number} are no camera: {error}") from error
        mask = masks.get(file.stem, masks.get(f"{number:03}"))
        frames.append(Frame(file.name, file, camera, bounds=bounds, mask=mask))
    return frames


def _idr_camera(world: NDArray[np.float64], width: int, height: int) -> Camera:
    """Decompose K [R | t]: the RQ decomposition of K R, by the QR decomposition of its inverse."""
    # K [R | t] is the same camera times any factor; this sign makes det R = 1.
    projection = world[:3] * np.sign(np.linalg.det(world[:3, :3]))
    turned, upper = np.linalg.qr(np.linalg.inv(projection[:, :3]))
    # A QR decomposition is unique up to signs: a camera's K has a positive diagonal.
    signs = np.sign(np.diag(upper))
    intrinsics, rotation = np.linalg.inv(upper) * signs, signs[:, None] * turned.T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.linalg.solve(intrinsics, projection[:, 3])
    k = intrinsics / intrinsics[2, 2]
    if abs(k[0, 1]) > 1e-3 * k[0, 0]:
        raise ValueError(f"its pixels are skewed: K is {k.tolist()}.")
    return Camera(torch.from_numpy(pose), k[0, 0], k[1, 1], k[0, 2], k[1, 2], width, height)


def _sphere_bounds(camera: Camera, sphere: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the nearest and farthest depth of the sphere around the object, None if it lies behind the camera."""
    center, radius = torch.from_numpy(sphere[:3, 3].copy()), float(abs(sphere[0, 0]))
    depth = float(camera.forward @ (center - camera.position))
    # A camera inside the sphere sees things at any depth: the near bound stays positive.
    return (max(depth - radius, depth / 10), depth + radius) if depth > 0 else None


def _read_idr_scene(root: Path, options: SceneOptions) -> Capture:
    """Read a scene folder."""
    path = next((root / name for name in IDR_FILES if (root / name).is_file()), root / IDR_FILES[0])
    usual = "image" if (root / "image").is_dir() or not (root / "images").is_dir() else "images"
    frames = read_idr(path, image_folder(root, options.images, usual))
    return Capture(frames, split="dtu" if len(frames) in DTU_IMAGES else "llff")


IDR = SceneFormat("idr", IDR_FILES[0], lambda root: any((root / name).is_file() for name in IDR_FILES), _read_idr_scene)


TO_CAMERA = ("extrinsic", "extrinsics", "world_to_camera", "w2c", "cam_from_world", "viewmats")
TO_WORLD = ("camera_poses", "camera_to_world", "cam2world", "c2w", "poses")
INTRINSICS = ("intrinsic", "intrinsics", "K", "Ks")
POINTS = ("points", "points3d", "pts3d", "world_points", "world_points_from_depth")
COLORS = ("colors", "rgb", "images", "image")
CONFIDENCE = ("confidence", "conf", "world_points_conf", "depth_conf")
NAMES = ("image_names", "names", "image_paths")
LARGEST_ARRAY = 2**30  # bytes per array
MOST_POINTS = 50_000  # networks predict one point per pixel

Arrays = Mapping[str, NDArray[Any]]


def read_arrays(path: Path, folder: Path) -> tuple[list[Frame], PointCloud | None]:
    """Read the S cameras of an ``.npz`` file, pair them with the images of a folder, and read the points, if any.

    Convention: OpenCV axes, half-integer pixel centers. ``extrinsic(s)``, ``world_to_camera``, ``w2c``,
    ``cam_from_world`` and ``viewmats`` are world to camera; ``camera_poses``, ``camera_to_world``, ``cam2world``,
    ``c2w`` and ``poses`` camera to world; both (S, 3, 4) or (S, 4, 4). ``intrinsic(s)``, ``K`` or ``Ks``, (S, 3, 3) or
    (3, 3), refer to pictures of the size of ``images``, ``depth`` or a map of points in the file, else of the image
    files. Images are matched to cameras by ``image_names``, ``names`` or ``image_paths``, else in sorted order.

    Points are ``points``, ``points3d``, ``pts3d``, ``world_points`` or ``world_points_from_depth``, (..., 3), else
    ``depth`` (S, H, W) lifted; colors are ``colors``, ``rgb`` or ``images``, as bytes or floats up to 1. Points that
    are not finite or whose ``confidence`` is below the median are left out; the rest is thinned to at most 50,000.

    Raises:
        FileNotFoundError: if the folder is missing.
        ValueError: if there are no poses or intrinsics, or they do not make a valid camera for every image.
    """
    asked = (*TO_CAMERA, *TO_WORLD, *INTRINSICS, *POINTS, *COLORS, *CONFIDENCE, *NAMES, "depth")
    arrays = read_npz(path, largest=LARGEST_ARRAY, names=asked)
    arrays = {name: x for name, x in arrays.items() if (x.dtype.kind == "U") == (name in NAMES)}
    poses, k = _first(arrays, (*TO_CAMERA, *TO_WORLD)), _first(arrays, INTRINSICS)
    if poses is None or k is None:
        raise ValueError(
            f"{path} needs poses, called {', '.join(TO_CAMERA)} (world to camera) or {', '.join(TO_WORLD)} (camera to "
            f"world), and intrinsics, called {', '.join(INTRINSICS)}; of names that mean something it has "
            f"{sorted(arrays)}."
        )
    k = np.broadcast_to(k, (*poses.shape[:1], 3, 3)) if k.shape == (3, 3) else k
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)) or k.shape != (len(poses), 3, 3):
        raise ValueError(
            f"{path}: poses must have shape (S, 3, 4) or (S, 4, 4) and intrinsics (S, 3, 3), got {poses.shape} and "
            f"{k.shape}."
        )
    files, size, frames = _npz_images(path, folder, _first(arrays, NAMES), len(poses)), _map_size(arrays), []
    to_camera = not arrays.keys().isdisjoint(TO_CAMERA)
    for file, pose, of in zip(files, poses, k, strict=True):
        axes, at = (pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]) if to_camera else (pose[:3, :3].T, pose[:3, 3])
        try:
            pose = view_matrix(axes, at)
            camera = Camera(pose, of[0, 0], of[1, 1], of[0, 2], of[1, 2], *(size or image_size(file)))
        except ValueError as error:
            raise ValueError(f"{path}: the camera of {file.name}: {error}") from error
        frames.append(Frame(file.name, file, camera))
    return frames, _npz_points(path, arrays, frames)


def _first(arrays: Arrays, names: Sequence[str]) -> NDArray[Any] | None:
    """Return the first array found under one of the names, None if there is none."""
    return next((arrays[name] for name in names if name in arrays), None)


def _npz_images(path: Path, folder: Path, names: NDArray[Any] | None, count: int) -> list[Path]:
    """Return the image file of each camera."""
    if names is None:
        files = list_images(folder)
    else:
        stems = [re.split(r"[/\\]", str(name))[-1] for name in names.ravel()]
        found = match_images(folder, stems)
        files = [found[stem] for stem in stems]
    if len(files) != count or len(set(files)) != count:
        raise ValueError(f"{path} has {count} cameras for the {len(set(files))} images of {folder}: each needs one.")
    return files


def _map_size(arrays: Arrays) -> tuple[int, int] | None:
    """Return width and height of the network's input pictures, None if no array of the file has their size."""
    maps = [arrays[name].shape for name in ("images", "image", "depth", *POINTS) if name in arrays]
    maps = [shape for shape in maps if len(shape) > 3 or (len(shape) == 3 and shape[2] != 3)]
    if not maps:
        return None
    height, width = maps[0][2:4] if len(maps[0]) > 3 and maps[0][1] == 3 else maps[0][1:3]
    return width, height


def _npz_points(path: Path, arrays: Arrays, frames: Sequence[Frame]) -> PointCloud | None:
    """Return the points, None if there are none."""
    found = _first(arrays, POINTS)
    if found is None and "depth" in arrays:
        depths = arrays["depth"]
        if depths.ndim < 3 or depths.shape not in ((shape := (len(frames), *depths.shape[1:3])), (*shape, 1)):
            raise ValueError(f"{path}: depth must have shape (S, H, W), got {depths.shape} for {len(frames)} cameras.")
        found = np.stack([_lifted(depth, frame.camera) for depth, frame in zip(depths, frames, strict=True)])
    if found is None:
        return None
    if found.shape[-1:] != (3,):
        raise ValueError(f"{path}: points must have shape (..., 3), got {found.shape}.")
    positions = found.reshape(-1, 3)
    colors = np.full(positions.shape, 0.5)
    # Backwards, so that the first name wins if several fit.
    for name in [name for name in COLORS if name in arrays][::-1]:
        given = arrays[name]
        given = np.moveaxis(given, 1, -1) if given.ndim == 4 and given.shape[1] == 3 else given
        if given.size == positions.size:
            colors = given.reshape(-1, 3) / (255 if given.dtype.kind in "iu" or given.max(initial=0) > 1 else 1)
    keep, confidence = np.isfinite(positions).all(1), _first(arrays, CONFIDENCE)
    if confidence is not None and confidence.size == len(positions):
        known = confidence[~np.isnan(confidence)]
        keep &= confidence.ravel() >= (np.median(known) if len(known) else np.inf)
    chosen = np.flatnonzero(keep)
    chosen = chosen[:: -(-len(chosen) // MOST_POINTS) or 1]
    if len(chosen) == 0:
        return None
    where, color = (torch.from_numpy(x[chosen].astype(np.float32)) for x in (positions, colors.clip(0, 1)))
    return PointCloud(where, color, source=str(path), seen_by=frozenset(frame.name for frame in frames))


def _lifted(depth: NDArray[Any], camera: Camera) -> NDArray[Any]:
    """Lift a map of depths along the camera's z axis to world points (H, W, 3); nan where the depth is not positive."""
    height, width = depth.shape[:2]
    camera = camera.resized(width, height)  # that of the file's pictures, which may be larger than the map
    depths = torch.from_numpy(depth.reshape(height, width).astype(np.float64))
    return camera.lift(camera.pixel_centers(depths), depths.where(depths > 0, torch.nan)).numpy()


def _npz_files(root: Path) -> list[Path]:
    """Return the ``.npz`` files of a folder, none if it is an IDR scene."""
    return [] if IDR.found(root) else sorted(root.glob("*.npz"))


def _read_npz_scene(root: Path, options: SceneOptions) -> Capture:
    """Read a scene folder."""
    files = _npz_files(root)
    if len(files) != 1:
        raise ValueError(f"{root} must hold one .npz with the poses, got {[file.name for file in files]}.")
    frames, points = read_arrays(files[0], image_folder(root, options.images))
    return Capture(sorted(frames, key=lambda frame: frame.name), points=points)


ARRAYS = SceneFormat("npz", "an .npz of poses", lambda root: bool(_npz_files(root)), _read_npz_scene)
