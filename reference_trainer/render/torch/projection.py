"""From 3D Gaussians to 2D ellipses: the EWA projection of one camera."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION, FRUSTUM_MARGIN
from reference_trainer.render.splats import Projection
from reference_trainer.rotations import rotations

__all__ = ["project"]


def project(
    means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera, *, dilation: float = DILATION
) -> Projection:
    """Project 3D Gaussians with a local affine approximation of the perspective (EWA splatting).

    Convention: OpenCV camera, half-pixel centers, wxyz quaternions. Every Gaussian must lie in front of the camera.

    The arguments are those of `reference_trainer.render.render`; differentiable in each.

    Example:
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> quaternion = torch.tensor([[1.0, 0, 0, 0]])
        >>> project(torch.tensor([[0.0, 0.0, 1.0]]), quaternion, torch.full((1, 3), 0.1), camera).means.tolist()
        [[16.0, 16.0]]
    """
    view = camera.world_to_camera.to(means)
    rotation = view[:3, :3]
    x, y, z = torch.addmm(view[:3, 3:], rotation, means.T).unbind(0)
    slope_x, slope_y = x / z, y / z
    limit_x, limit_y = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx, FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    right, down, forward = (axis[:, None] for axis in rotation)
    # The two rows of (Jacobian x view rotation), then of (Jacobian x view rotation x Gaussian axes), each (3, M).
    row_x = (camera.fx / z) * (right - slope_x.clamp(-limit_x, limit_x) * forward)
    row_y = (camera.fy / z) * (down - slope_y.clamp(-limit_y, limit_y) * forward)
    axes = rotations(quaternions) * scales.T
    row_x, row_y = (row_x[:, None] * axes).sum(0), (row_y[:, None] * axes).sum(0)
    xx, xy, yy = (row_x * row_x).sum(0) + dilation, (row_x * row_y).sum(0), (row_y * row_y).sum(0) + dilation
    # The determinant as a sum of squares (Cauchy-Binet): xx yy - xy^2 would cancel for needles. Divided by yy before it
    # is squared: fourth powers of the scales would overflow from a million scene sizes on.
    l22 = torch.rsqrt(yy)
    cross = torch.linalg.cross(row_x, row_y * l22, dim=0)
    l11 = torch.rsqrt((cross * cross).sum(0) + dilation * (xx + yy - dilation) * (l22 * l22))
    return Projection(
        means=torch.stack([camera.fx * slope_x + camera.cx, camera.fy * slope_y + camera.cy], dim=-1),
        factors=torch.stack([l11, -xy * (l22 * l22) * l11, l22], dim=-1),
        covariances=torch.stack([xx, xy, yy], dim=-1),
        depths=z,
    )
