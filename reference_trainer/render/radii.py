"""Screen-space radii as the INRIA rasterizers report them; to densification, a positive one means visible."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION, NEAR_PLANE
from reference_trainer.render.torch.projection import project

__all__ = ["SMALLEST_SPREAD", "in_front", "longer_radii", "visible_radii"]

SMALLEST_SPREAD = 0.1**0.5  # px^2, of the INRIA code
CUDA_TILE = 16  # pixels; a Gaussian is visible to the INRIA code if the square around it meets a tile of the picture


def in_front(means: Tensor, camera: Camera) -> Tensor:
    """Say which Gaussians, at world coordinates (N, 3), lie beyond the near plane; shape (N,) bool."""
    pose = camera.world_to_camera.to(means)
    return means.detach() @ pose[2, :3] + pose[2, 3] > NEAR_PLANE


@torch.no_grad()
def longer_radii(covariances: Tensor, smallest: float) -> Tensor:
    """Return three standard deviations of the longer axis of 2D covariances (M, 3), rounded up, pixels, shape (M,).

    More for round splats: half the difference of the axes' variances counts as at least ``smallest``.

    Example:
        >>> longer_radii(torch.tensor([[1.0, 0.0, 1.0], [9.0, 0.0, 1.0]]), SMALLEST_SPREAD).tolist()  # 3 sqrt(1.32), 9
        [4.0, 9.0]
    """
    xx, xy, yy = covariances.unbind(-1)
    spread = torch.hypot(0.5 * (xx - yy), xy).clamp_min(smallest)
    return torch.ceil(3.0 * (0.5 * (xx + yy) + spread).sqrt())


@torch.no_grad()
def visible_radii(
    means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera, *, blur: float = DILATION
) -> Tensor:
    """Measure the radii of the splats that meet the picture: pixels, (N,) int32, 0 before the near plane or off it.

    As in the originals the opacity does not matter: a Gaussian of opacity 0 has a radius, though it is not drawn.
    Quaternions are wxyz, scales standard deviations, ``blur`` is in square pixels.

    Example:
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [9.0, 0.0, 1.0]])
        >>> visible_radii(means, torch.eye(4)[:1].repeat(3, 1), torch.full((3, 3), 0.1), camera).tolist()
        [16, 0, 0]
    """
    radii = torch.zeros(means.shape[0], dtype=torch.int32, device=means.device)
    front = torch.nonzero(in_front(means, camera)).squeeze(1)
    camera = camera.to(means.device, means.dtype)
    splats = project(means[front], quaternions[front], scales[front], camera, dilation=blur)
    center = splats.means - 0.5  # in the INRIA code pixel centers are integers
    tiles = center.new_tensor([-(-camera.width // CUDA_TILE), -(-camera.height // CUDA_TILE)])
    extents = longer_radii(splats.covariances, SMALLEST_SPREAD)
    first = ((center - extents[:, None]) / CUDA_TILE).trunc().clamp(min=0.0).minimum(tiles)
    last = ((center + extents[:, None] + CUDA_TILE - 1) / CUDA_TILE).trunc().clamp(min=0.0).minimum(tiles)
    radii[front] = torch.where((last > first).all(-1), extents, 0.0).to(torch.int32)
    return radii
