"""The small scenes that the cases of the stability study push to an extreme."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from reference_trainer.camera import Camera

__all__ = ["PARAMETERS", "StressScene", "base_scene", "camera_of", "stack"]

PARAMETERS = ("means", "quaternions", "scales", "opacities", "colors")
"""Names of the Gaussians' tensors, in the order of the renderer's arguments."""

_SEED = 20
_DISTANCE = 3.0  # from the camera to the center of the scene, whose half width is 1


@dataclass(frozen=True)
class StressScene:
    """Gaussians, a camera and a background.

    Args:
        means: world coordinates, shape (N, 3).
        quaternions: wxyz, shape (N, 4).
        scales: standard deviations, shape (N, 3).
        opacities: activated, shape (N,).
        colors: RGB, shape (N, 3).
        background: shape (3,).
        camera: the view.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    background: Tensor
    camera: Camera

    @property
    def parameters(self) -> list[Tensor]:
        """The Gaussians' tensors, by `PARAMETERS`."""
        return [getattr(self, name) for name in PARAMETERS]

    def to(self, dtype: torch.dtype, *, camera: torch.dtype | None = None) -> StressScene:
        """Return the scene in another dtype; ``camera`` is that of the camera's pose, if it differs."""
        tensors = {x.name: getattr(self, x.name).to(dtype) for x in fields(self) if x.name != "camera"}
        return StressScene(**tensors, camera=self.camera.to(dtype=camera or dtype))

    def rounded(self, dtype: torch.dtype = torch.float32) -> StressScene:
        """Return the scene in float64, with all but the pose rounded to a dtype."""
        return self.to(dtype, camera=torch.float64).to(torch.float64)


def camera_of(width: int = 32, height: int = 24, *, focal: float = 40.0, distance: float = _DISTANCE) -> Camera:
    """Return a rotated camera at a distance from the origin, which lies on its optical axis; float64."""
    skew = torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.3], [-0.2, 0.3, 0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(skew)
    pose[2, 3] = distance
    return Camera(pose, focal, 0.95 * focal, 0.47 * width, 0.53 * height, width, height)


def base_scene(n: int = 24, *, camera: Camera | None = None) -> StressScene:
    """Draw n ordinary Gaussians around the origin, float64.

    Args:
        n: number of Gaussians.
        camera: the view, by default 32 x 24 pixels from a distance of 3.

    Example:
        >>> base_scene(5).means.shape
        torch.Size([5, 3])
    """
    generator = torch.Generator().manual_seed(_SEED)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    return StressScene(
        means=uniform(-0.8, 0.8, n, 3),
        quaternions=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        scales=0.15 * torch.exp(uniform(-0.7, 0.7, n, 3)),
        opacities=uniform(0.2, 0.9, n),
        colors=uniform(0.0, 1.0, n, 3),
        background=torch.tensor([0.1, 0.3, 0.2], dtype=torch.float64),
        camera=camera or camera_of(),
    )


def stack(n: int, opacity: float, *, spacing: float = 1e-3) -> StressScene:
    """Put n Gaussians one behind the other on the optical axis of an 8 x 8 camera: all of them reach all pixels."""
    scene = base_scene(n, camera=Camera(torch.eye(4, dtype=torch.float64), 20.0, 20.0, 4.0, 4.0, 8, 8))
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = 2.0 + spacing * torch.arange(n, dtype=torch.float64)
    opacities = torch.full((n,), opacity, dtype=torch.float64)
    return replace(scene, means=means, scales=scene.scales + 0.5, opacities=opacities)
