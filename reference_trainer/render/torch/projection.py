"""From 3D Gaussians to colored 2D ellipses: EWA projection and spherical harmonics."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION, FRUSTUM_MARGIN, HARMONICS, MIN_ALPHA, NEAR_PLANE
from reference_trainer.render.splats import Projection
from reference_trainer.rotations import rotations

__all__ = ["evaluate_sh", "project", "sh_basis", "visible"]

_A, _B, _C, _D, _E, _F, _G, _H = HARMONICS


@torch.no_grad()
def visible(inputs: dict[str, Tensor], camera: Camera) -> tuple[Tensor, Tensor]:
    """Return depths of all Gaussians (N,), and the indices of those in view, see `Engine.project`."""
    depths = inputs["means"] @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    return depths, torch.nonzero((depths > NEAR_PLANE) & (inputs["opacities"] >= MIN_ALPHA)).squeeze(1)


def project(
    means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera, *, dilation: float = DILATION
) -> Projection:
    """Project 3D Gaussians with a local affine approximation of the perspective (EWA splatting).

    Convention: OpenCV camera, half-pixel centers, wxyz quaternions. Every Gaussian must lie in
    front of the camera.

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
    # The two rows of (Jacobian x view rotation), then of (Jacobian x view rotation x Gaussian
    # axes), each (3, M).
    row_x = (camera.fx / z) * (right - slope_x.clamp(-limit_x, limit_x) * forward)
    row_y = (camera.fy / z) * (down - slope_y.clamp(-limit_y, limit_y) * forward)
    axes = rotations(quaternions) * scales.T
    row_x, row_y = (row_x[:, None] * axes).sum(0), (row_y[:, None] * axes).sum(0)
    xx, xy, yy = (row_x * row_x).sum(0) + dilation, (row_x * row_y).sum(0), (row_y * row_y).sum(0) + dilation
    # The determinant as a sum of squares (Cauchy-Binet), |ux|^2 |uy|^2 - (ux uy)^2 = |ux x uy|^2:
    # xx yy - xy^2 would cancel for needles. Divided by yy before it is squared: fourth powers of
    # the scales would overflow from a million scene sizes on.
    l22 = torch.rsqrt(yy)
    cross = torch.linalg.cross(row_x, row_y * l22, dim=0)
    l11 = torch.rsqrt((cross * cross).sum(0) + dilation * (xx + yy - dilation) * (l22 * l22))
    return Projection(
        means=torch.stack([camera.fx * slope_x + camera.cx, camera.fy * slope_y + camera.cy], dim=-1),
        factors=torch.stack([l11, -xy * (l22 * l22) * l11, l22], dim=-1),
        covariances=torch.stack([xx, xy, yy], dim=-1),
        depths=z,
    )


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the (degree + 1)^2 real spherical harmonics, up to 3, of unit vectors (N, 3).

    Convention: the Condon-Shortley phase is kept and the order within a band is m = -l .. l, as in
    the INRIA code.

    Example:
        >>> sh_basis(torch.tensor([[0.0, 0.0, 1.0]]), 1).shape
        torch.Size([1, 4])
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, _A)]
    if degree >= 1:
        basis += [-_B * y, _B * z, -_B * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [_C * x * y, -_C * y * z, _D * (2 * zz - xx - yy), -_C * x * z, 0.5 * _C * (xx - yy)]
    if degree >= 3:
        basis += [
            -_E * y * (3 * xx - yy),
            _F * x * y * z,
            -_G * y * (4 * zz - xx - yy),
            _H * z * (2 * zz - 3 * xx - 3 * yy),
            -_G * x * (4 * zz - xx - yy),
            0.5 * _F * z * (xx - yy),
            -_E * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def evaluate_sh(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Evaluate colors from spherical-harmonic coefficients.

    Convention: 0.5 is added and the result is clamped below at 0, as in the INRIA code; it is not
    clamped above.

    The coefficients are (N, (degree + 1)^2, 3), of degree at most 3, the directions unit vectors
    from the camera center to the Gaussians, (N, 3), the colors (N, 3).

    Example:
        >>> evaluate_sh(torch.zeros(2, 1, 3), torch.eye(3)[:2], 0).tolist()
        [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]
    """
    if degree == 0:
        return torch.relu(_A * coefficients[:, 0] + 0.5)
    count = coefficients.shape[1]
    # Repeating the basis per channel and summing over it as matrix products keeps all axes long: on
    # a CPU this is several times faster than a batched product or a broadcast over the three
    # channels.
    channels = torch.eye(3, dtype=coefficients.dtype, device=coefficients.device)
    spread = torch.eye(count, dtype=coefficients.dtype, device=coefficients.device).repeat_interleave(3, dim=1)
    terms = (sh_basis(directions, degree) @ spread) * coefficients.flatten(1)
    return torch.relu(terms @ channels.repeat(count, 1) + 0.5)
