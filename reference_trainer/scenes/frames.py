"""Photographs on disk with their cameras, loaded as what a pinhole camera would have taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes.images import composite, read_image, resize_image
from reference_trainer.scenes.scene import View

__all__ = ["Frame", "check_shape", "corner_displacement", "distort", "fitted", "load_view", "undistort", "view_matrix"]

# Rounding to whole pixels changes the aspect ratio by about 1 / height; a wrong picture folder changes it by more.
ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class Frame:
    """What a scene file says about one photograph.

    Args:
        name: its name in the scene file, unique within the scene.
        path: the image file.
        camera: its camera, at the picture size that the scene file refers to; the pose is float64.
        distortion: coefficients of the lens, in the order of `reference_trainer.scenes.frames.distort`.
        bounds: nearest and farthest depth of the scene in this view, if the scene file has them.
        mask: a picture that is white on the object, or 1 where 0 is elsewhere, if the scene has one.
    """

    name: str
    path: Path
    camera: Camera
    distortion: tuple[float, ...] = ()
    bounds: tuple[float, float] | None = None
    mask: Path | None = None


def view_matrix(axes: NDArray[np.float64], position: NDArray[np.float64]) -> Tensor:
    """Return the view matrix (4, 4), float64, of a camera at a world position (3,).

    The rows of ``axes`` (3, 3) are its right, down and forward; ValueError if they are no rotation to within 1e-3.
    """
    with np.errstate(all="ignore"):
        is_rotation = np.allclose(axes @ axes.T, np.eye(3), atol=1e-3) and np.linalg.det(axes) > 0
    if not is_rotation:
        raise ValueError(f"its pose holds no rotation: {axes.tolist()}.")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ position
    return torch.from_numpy(pose)


def check_shape(path: Path, layer: Tensor, camera: Camera, other: str) -> None:
    """Refuse a file, read as (..., H, W), whose aspect ratio is not that of a camera, with a ValueError.

    ``other`` names for the error what else has the shape of that camera.
    """
    height, width = layer.shape[-2:]
    stretch = (width / camera.width) / (height / camera.height)
    if abs(stretch - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{path} is {width}x{height}, which is not the shape of {other}: the aspect ratios of {width}x{height} and "
            f"{camera.width}x{camera.height} differ by {abs(stretch - 1):.1%}. Choose the folder that belongs to the "
            "cameras."
        )


def fitted(layer: Tensor, camera: Camera, distortion: Sequence[float], mode: str = "bicubic") -> tuple[Tensor, Camera]:
    """Resize a picture (C, H, W) to the size of its camera, then undo the distortion, if any; return both.

    The modes are those of `resize_image`, errors those of `undistort`.
    """
    if layer.shape[1:] != (camera.height, camera.width):
        layer = resize_image(layer, camera.width, camera.height, mode)
    return undistort(layer, camera, distortion, mode) if any(distortion) else (layer, camera)


def load_view(frame: Frame, *, background: Tensor, downscale: float = 1.0, undistort: bool = True) -> View:
    """Read the photograph of a frame and fit its camera to the picture's size, float32.

    A picture with an alpha channel is first composited on the background (3,). The picture is then shrunk by
    ``downscale``, at least 1, and last undistorted, if asked for.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is no image, its aspect ratio or that of its mask is not the camera's, or its distortion
            cannot be undone.
    """
    image, alpha = read_image(frame.path)
    check_shape(frame.path, image, frame.camera, "its camera")
    height, width = image.shape[1:]
    mask = None
    if frame.mask is not None:
        mask = read_image(frame.mask)[0].mean(0)
        mask = 255 * mask if mask.max() < 1.5 / 255 else mask  # of zeros and ones: white is 1
        check_shape(frame.mask, mask, frame.camera.resized(width, height), f"its photograph {frame.path}")
    image = image if alpha is None else composite(image, alpha, background)
    camera = frame.camera.resized(max(1, round(width / downscale)), max(1, round(height / downscale)))
    distortion = frame.distortion if undistort else ()
    alpha, mask = (None if x is None else fitted(x[None], camera, distortion)[0][0] for x in (alpha, mask))
    image, camera = fitted(image, camera, distortion)
    return View(frame.name, camera.to(dtype=torch.float32), image, alpha, mask=mask)


LARGEST_ZOOM = 4.0
"""Beyond this zoom the lens covers so little of the undistorted picture that the coefficients are more likely wrong."""


def distort(points: Tensor, camera: Camera, distortion: Sequence[float]) -> Tensor:
    """Return where the lens puts pixels (..., N, 2), float64, of a pinhole camera without distortion.

    Convention: OpenCV's rational model; the coefficients are k1 k2 p1 p2 k3 k4 k5 k6 or a prefix of that list, which is
    also the order of COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV. Pixel centers are half-integer.

    Example:
        >>> camera = Camera(torch.eye(4), 100.0, 100.0, 50.0, 40.0, 100, 80)
        >>> distort(torch.tensor([[150.0, 40.0]], dtype=torch.float64), camera, [0.1]).tolist()  # 1 + 0.1 * 1^2
        [[160.0, 40.0]]
    """
    from kornia.geometry.calibration import distort_points

    matrix = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=points.dtype)
    padded = torch.tensor([*distortion, *[0.0] * (8 - len(distortion))], dtype=points.dtype)
    moved: Tensor = distort_points(points, matrix, padded)
    return moved


def corner_displacement(camera: Camera, distortion: Sequence[float]) -> float:
    """Return the largest distance, in pixels, by which the distortion moves one of the four corners of the picture."""
    w, h = float(camera.width), float(camera.height)
    corners = torch.tensor([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]], dtype=torch.float64)
    return float((distort(corners, camera, distortion) - corners).norm(dim=1).max())


def undistort(
    pixels: Tensor, camera: Camera, distortion: Sequence[float], mode: str = "bicubic"
) -> tuple[Tensor, Camera]:
    """Undistort a picture (C, H, W) by one resampling, bicubic or ``"bilinear"``; return it with its new camera.

    The picture keeps its size. Where the lens saw less than the undistorted picture would show, the focal length grows
    until no pixel is empty, as with COLMAP's undistorter by default. ``camera`` and ``distortion`` are as for
    `distort`.

    Raises:
        ValueError: if the lens folds the picture over itself, or the zoom would exceed `LARGEST_ZOOM`.
    """
    zoom = _zoom(camera, distortion)
    straight = replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    source = _distort_zoomed(camera.pixel_centers(size).flatten(0, 1), camera, distortion, zoom)
    grid = 2 * source / size - 1
    grid = grid.to(pixels.dtype).reshape(1, camera.height, camera.width, 2)
    # Without align_corners, -1 and 1 are the outer edges of the picture: the same half-pixel centers as the camera's.
    resampled = torch.nn.functional.grid_sample(
        pixels[None], grid, mode=mode, padding_mode="border", align_corners=False
    )
    return resampled[0].clamp(0, 1), straight


def _distort_zoomed(points: Tensor, camera: Camera, distortion: Sequence[float], zoom: float) -> Tensor:
    """Distort pixels of a camera whose focal length is ``zoom`` times larger."""
    center = torch.tensor([camera.cx, camera.cy], dtype=points.dtype)
    return distort(center + (points - center) / zoom, camera, distortion)


def _zoom(camera: Camera, distortion: Sequence[float]) -> float:
    """Find the smallest factor on the focal length, at least 1, at which the lens has seen all of the picture."""
    x, y = (torch.linspace(0.5, size - 0.5, 65, dtype=torch.float64) for size in (camera.width, camera.height))
    border = [torch.stack([x, torch.full_like(x, edge)], 1) for edge in (0.5, camera.height - 0.5)]
    border += [torch.stack([torch.full_like(y, edge), y], 1) for edge in (0.5, camera.width - 0.5)]
    center = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    steps = torch.linspace(0, 1, 33, dtype=torch.float64)[:, None, None]
    rays = center + steps * (torch.cat(border) - center)  # from the center to every point of the border
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)

    def seen(zoom: float) -> bool:
        where = _distort_zoomed(rays, camera, distortion, zoom)
        outward = (where - center).norm(dim=-1).diff(dim=0) > 0  # a lens beyond its fit folds back
        return bool(outward.all() and (where[-1] >= 0).all() and (where[-1] <= size).all())

    if seen(1.0):
        return 1.0
    if not seen(LARGEST_ZOOM):
        raise ValueError(f"the lens distortion {tuple(distortion)} cannot be undone: it folds the picture over itself.")
    low, high = 1.0, LARGEST_ZOOM
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if seen(middle) else (middle, high)
    return high
