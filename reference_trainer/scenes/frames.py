"""A photograph on disk with its camera, and the step from there to a view in memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes.images import composite, read_image, resize_image
from reference_trainer.scenes.scene import View

__all__ = ["Frame", "load_view"]

# Resizing to whole pixels changes the aspect ratio by about 1 / height; a wrong picture folder changes it by more.
ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class Frame:
    """What a scene file says about one photograph.

    Args:
        name: its name in the scene file, unique within the scene.
        path: the image file.
        camera: its camera, for the picture size that the scene file was written for; the pose is float64.
        distortion_px: how far the lens distortion, which is ignored, moves a corner of that picture, pixels.
        bounds: nearest and farthest depth of the scene in this view, where the scene file has them.
    """

    name: str
    path: Path
    camera: Camera
    distortion_px: float = 0.0
    bounds: tuple[float, float] | None = None


def load_view(frame: Frame, *, background: Tensor, downscale: float = 1.0) -> View:
    """Read the photograph of a frame and fit its camera to the picture's size.

    A picture with an alpha channel is composited on the background first and resized afterwards.

    Args:
        frame: the photograph.
        background: RGB in [0, 1], shape (3,).
        downscale: factor, at least 1, by which the picture is made smaller.

    Returns:
        The view, float32.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is no image, or its aspect ratio is not the camera's.
    """
    image, alpha = read_image(frame.path)
    height, width = image.shape[1:]
    stretch = (width / frame.camera.width) / (height / frame.camera.height)
    if abs(stretch - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"{frame.path} is {width}x{height} but its camera is for {frame.camera.width}x{frame.camera.height}: the "
            f"aspect ratios differ by {abs(stretch - 1):.1%}. Choose the picture folder that belongs to the cameras."
        )
    if alpha is not None:
        image = composite(image, alpha, background)
    if downscale != 1:
        height, width = max(1, round(height / downscale)), max(1, round(width / downscale))
        image = resize_image(image, width, height)
        alpha = None if alpha is None else resize_image(alpha[None], width, height)[0]
    camera = frame.camera.resized(width, height).to(dtype=torch.float32)
    return View(frame.name, camera, image, alpha)
