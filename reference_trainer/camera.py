"""The pinhole camera, which scenes and the renderer share."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

__all__ = ["Camera"]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: pose, intrinsics and image size.

    Convention: OpenCV (x right, y down, z forward). Pixel centers lie at half-integers: the center of the pixel in row
    ``i`` and column ``j`` projects to ``(j + 0.5, i + 0.5)``, so the image spans ``[0, width] x [0, height]``.

    Raises:
        ValueError: if the view matrix is not a finite (4, 4) tensor, a focal length is not positive and finite, the
            principal point not finite, or the size not positive.
        TypeError: if a length or the principal point is no number, or the size not whole numbers.

    Example:
        >>> camera = Camera(torch.eye(4), fx=100.0, fy=100.0, cx=32.0, cy=24.0, width=64, height=48)
        >>> camera.lift(torch.tensor([32.0, 124.0]), torch.tensor(2.0)).tolist()
        [0.0, 2.0, 2.0]
    """

    world_to_camera: Tensor  # the view matrix, shape (4, 4): ``x_camera = R x_world + t``
    fx: float  # focal length in x, pixels
    fy: float  # focal length in y, pixels
    cx: float  # principal point in x, pixels
    cy: float  # principal point in y, pixels
    width: int  # image width, pixels
    height: int  # image height, pixels

    def __post_init__(self) -> None:
        # Numbers of Python whatever was given, such as numpy's, which Triton does not take.
        vars(self).update({name: float(getattr(self, name)) for name in ("fx", "fy", "cx", "cy")})
        vars(self).update({name: operator.index(getattr(self, name)) for name in ("width", "height")})
        pose = self.world_to_camera
        if pose.shape != (4, 4) or not bool(torch.isfinite(pose).all()):
            raise ValueError(f"world_to_camera must be a finite (4, 4) tensor, got shape {tuple(pose.shape)}: {pose}.")
        if not (0 < self.fx < math.inf and 0 < self.fy < math.inf):
            raise ValueError(f"focal lengths must be positive, finite pixels, got fx={self.fx}, fy={self.fy}.")
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise ValueError(f"the principal point must be finite, in pixels, got cx={self.cx}, cy={self.cy}.")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"the image size must be positive, got {self.width}x{self.height}.")

    @property
    def position(self) -> Tensor:
        """Camera center in world coordinates, shape (3,)."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    @property
    def forward(self) -> Tensor:
        """Unit viewing direction (the camera's +z axis) in world coordinates, shape (3,)."""
        return self.world_to_camera[2, :3]

    def lift(self, pixels: Tensor, depth: Tensor) -> Tensor:
        """Return the world points (..., 3) at pixels (..., 2) and depths (...) along the camera's z axis."""
        pose = self.world_to_camera.to(depth)
        across = (pixels - depth.new_tensor([self.cx, self.cy])) / depth.new_tensor([self.fx, self.fy])
        local = torch.cat([across, torch.ones_like(across[..., :1])], -1) * depth[..., None]
        return (local - pose[:3, 3]) @ pose[:3, :3]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return pixels (..., 2) and depths (...) of world points (..., 3); the inverse of `lift`.

        Behind the camera the depth is negative and the pixel meaningless; at depth 0 the pixel is not finite.
        """
        pose = self.world_to_camera.to(points)
        local = points @ pose[:3, :3].T + pose[:3, 3]
        depth = local[..., 2]
        across = local[..., :2] / depth[..., None]
        return across * depth.new_tensor([self.fx, self.fy]) + depth.new_tensor([self.cx, self.cy]), depth

    def inside(self, pixels: Tensor, depth: Tensor) -> Tensor:
        """Return which pixels (..., 2) at depths (...) are in the picture and in front of the camera, (...) bool."""
        x, y = pixels.unbind(-1)
        return (depth > 0) & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)

    def depths_of(self, points: Tensor) -> Tensor:
        """Return the depths of those world points (N, 3) that are in the picture, in their order."""
        pixels, depths = self.project(points)
        return depths[self.inside(pixels, depths)]

    def pixel_centers(self, like: Tensor) -> Tensor:
        """Return the centers of all pixels (height, width, 2), of the dtype and on the device of a tensor."""
        sides = (torch.arange(side, dtype=like.dtype, device=like.device) + 0.5 for side in (self.width, self.height))
        return torch.stack(torch.meshgrid(*sides, indexing="xy"), -1)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same picture resized to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """Return the camera with its view matrix on another device or in another dtype."""
        pose = self.world_to_camera.to(device=device, dtype=dtype)
        return self if pose is self.world_to_camera else replace(self, world_to_camera=pose)
