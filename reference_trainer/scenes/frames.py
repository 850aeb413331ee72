"""Frames, which are photographs on disk with their cameras, and loading them as views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes.images import composite, read_image, resize_image
from reference_trainer.scenes.scene import View
from reference_trainer.scenes.undistort import undistort

__all__ = ["Frame", "fitted", "load_view", "view_matrix"]

# Rounding to whole pixels changes the aspect ratio by about 1 / height; a wrong picture folder changes it by more.
ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class Frame:
    """What a scene file says about one photograph.

    Args:
        name: its name in the scene file, unique within the scene.
        path: the image file.
        camera: its camera, at the picture size that the scene file refers to; the pose is float64.
        distortion: coefficients of the lens, in the order of `reference_trainer.scenes.undistort.distort`.
        bounds: nearest and farthest depth of the scene in this view, if the scene file has them.
        mask: a picture that is white on the object, if the scene has one.
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
        ValueError: if the file is no image, its aspect ratio is not the camera's, or its distortion cannot be undone.
    """
    image, alpha = read_image(frame.path)
    height, width = image.shape[1:]
    stretch = (width / frame.camera.width) / (height / frame.camera.height)
    if abs(stretch - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{frame.path} is {width}x{height} but its camera is for {frame.camera.width}x{frame.camera.height}: the "
            f"aspect ratios differ by {abs(stretch - 1):.1%}. Choose the picture folder that belongs to the cameras."
        )
    layers = {"image": image if alpha is None else composite(image, alpha, background)}
    layers |= {} if alpha is None else {"alpha": alpha[None]}
    layers |= {} if frame.mask is None else {"mask": read_image(frame.mask)[0].mean(0, keepdim=True)}
    camera = frame.camera.resized(max(1, round(width / downscale)), max(1, round(height / downscale)))
    fits = {name: fitted(layer, camera, frame.distortion if undistort else ()) for name, layer in layers.items()}
    image, camera = fits.pop("image")
    flat = {name: layer[0] for name, (layer, _) in fits.items()}
    return View(frame.name, camera.to(dtype=torch.float32), image, flat.get("alpha"), mask=flat.get("mask"))
