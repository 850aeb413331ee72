"""From 3D Gaussians to colored 2D ellipses, one Gaussian after the other, and back for gradients.

The formulas are those of `render/torch/projection.py`, which PyTorch differentiates; here every
derivative is written out, beside the formula that it belongs to. ``to_x`` is the gradient of the
loss with respect to ``x`` throughout.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.camera import Camera
from reference_trainer.compiled.compiling import inlined, kernel
from reference_trainer.compiled.threads import in_threads
from reference_trainer.render.checks import numbers_to_check
from reference_trainer.render.constants import DILATION, FRUSTUM_MARGIN, HARMONICS
from reference_trainer.render.splats import Projected, Projection
from reference_trainer.render.torch.projection import visible

__all__ = ["basis", "basis_gradient", "project"]

Array = Any
f4 = np.float32
_A, _B, _C, _D, _E, _F, _G, _H = (f4(x) for x in HARMONICS)
_ZERO, _HALF, _ONE, _TWO, _THREE = f4(0), f4(0.5), f4(1), f4(2), f4(3)
_FOUR, _SIX, _EIGHT, _DILATION = f4(4), f4(6), f4(8), f4(DILATION)
_NO_DIRECTION = f4(1e-30)  # a quaternion well below this is taken for 0


@inlined
def basis(x: Any, y: Any, z: Any, degree: Any, values: Any) -> None:
    """Write the (degree + 1)^2 basis functions at a unit vector."""
    # Homogeneous polynomials of degree l for band l, m = -l .. l within a band, as `sh_basis`.
    values[0] = _A
    if degree > 0:
        values[1], values[2], values[3] = -_B * y, _B * z, -_B * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        values[4], values[5], values[7] = _C * x * y, -_C * y * z, -_C * x * z
        values[6], values[8] = _D * (_TWO * zz - xx - yy), _HALF * _C * (xx - yy)
        if degree > 2:
            values[9], values[15] = -_E * y * (_THREE * xx - yy), -_E * x * (xx - _THREE * yy)
            values[10], values[14] = _F * x * y * z, _HALF * _F * z * (xx - yy)
            values[11], values[13] = -_G * y * (_FOUR * zz - xx - yy), -_G * x * (_FOUR * zz - xx - yy)
            values[12] = _H * z * (_TWO * zz - _THREE * xx - _THREE * yy)


@inlined
def basis_gradient(x: Any, y: Any, z: Any, degree: Any, to_values: Any) -> Any:
    """Return the gradient of (x, y, z), given that of the basis functions."""
    # The derivatives of the polynomials of `basis`, one band after the other. They are those of the
    # polynomials in all of space: `_backward` removes the part that would leave the sphere.
    g = to_values
    to_x, to_y, to_z = f4(0), f4(0), f4(0)
    if degree > 0:
        to_x, to_y, to_z = -_B * g[3], -_B * g[1], _B * g[2]
    if degree > 1:
        to_x += _C * (y * g[4] - z * g[7] + x * g[8]) - _TWO * _D * x * g[6]
        to_y += _C * (x * g[4] - z * g[5] - y * g[8]) - _TWO * _D * y * g[6]
        to_z += -_C * (y * g[5] + x * g[7]) + _FOUR * _D * z * g[6]
        if degree > 2:
            xx, yy, zz = x * x, y * y, z * z
            to_x += -_E * (_SIX * x * y * g[9] + _THREE * (xx - yy) * g[15]) + _F * z * (y * g[10] + x * g[14])
            to_x += _G * (_TWO * x * y * g[11] - (_FOUR * zz - _THREE * xx - yy) * g[13]) - _SIX * _H * x * z * g[12]
            to_y += -_E * (_THREE * (xx - yy) * g[9] - _SIX * x * y * g[15]) + _F * z * (x * g[10] - y * g[14])
            to_y += _G * (_TWO * x * y * g[13] - (_FOUR * zz - xx - _THREE * yy) * g[11]) - _SIX * _H * y * z * g[12]
            to_z += _F * (x * y * g[10] + _HALF * (xx - yy) * g[14]) - _EIGHT * _G * z * (y * g[11] + x * g[13])
            to_z += _THREE * _H * (_TWO * zz - xx - yy) * g[12]
    return to_x, to_y, to_z


@inlined
def _rotation(quaternions: Array, i: int) -> Any:
    """Return rotation matrix, unit quaternion, and the factor that normalizes it."""
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    # Divided by the largest component first: its square would overflow from 1e19 on, or underflow.
    largest = max(max(abs(w), abs(x)), max(abs(y), abs(z)))
    scale = _ONE / (largest if largest > _NO_DIRECTION else _NO_DIRECTION)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = _ONE / norm if norm > f4(1e-12) else _ZERO  # a zero quaternion gives the identity
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    matrix = (
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip
    return matrix, (w, x, y, z), scale * inverse


@inlined
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _plus(a: Any, scale: Any, b: Any) -> Any:
    """Return a + scale b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@inlined
def _times(scale: Any, a: Any) -> Any:
    return scale * a[0], scale * a[1], scale * a[2]


@inlined
def _clip(x: Any, limit: Any) -> Any:
    return max(-limit, min(limit, x))


@inlined
def _in_camera(means: Array, i: int, view: Array) -> Any:
    """Return a mean in the camera's frame."""
    m = means[i, 0], means[i, 1], means[i, 2]
    return _dot(view[0], m) + view[0, 3], _dot(view[1], m) + view[1, 3], _dot(view[2], m) + view[2, 3]


@inlined
def _axes(matrix: Any, row: Any, scales: Any) -> Any:
    """Project the three scaled axes of a Gaussian onto a row vector in world coordinates."""
    return (
        scales[0] * (row[0] * matrix[0] + row[1] * matrix[3] + row[2] * matrix[6]),
        scales[1] * (row[0] * matrix[1] + row[1] * matrix[4] + row[2] * matrix[7]),
        scales[2] * (row[0] * matrix[2] + row[1] * matrix[5] + row[2] * matrix[8]),
    )


@inlined
def _rows(slope_x: Any, slope_y: Any, z: Any, view: Array, intrinsics: Array) -> Any:
    """Return the two rows of (Jacobian x view rotation), linearized at slopes within the limits."""
    # u = fx x / z has the derivatives (fx / z, 0, -fx x / z^2) in the camera's frame: fx / z times
    # (right - slope forward), in the axes of the world.
    right, down = (view[0, 0], view[0, 1], view[0, 2]), (view[1, 0], view[1, 1], view[1, 2])
    forward = view[2, 0], view[2, 1], view[2, 2]
    row_x = _times(intrinsics[0] / z, _plus(right, -_clip(slope_x, intrinsics[4]), forward))
    row_y = _times(intrinsics[1] / z, _plus(down, -_clip(slope_y, intrinsics[5]), forward))
    return row_x, row_y


@inlined
def _towards(means: Array, i: int, position: Array) -> Any:
    """Return the unit vector from the camera to a mean, and one over their distance."""
    x, y, z = means[i, 0] - position[0], means[i, 1] - position[1], means[i, 2] - position[2]
    distance = math.sqrt(x * x + y * y + z * z)
    inverse = _ONE / max(distance, f4(1e-12))
    return (x * inverse, y * inverse, z * inverse), inverse


@inlined
def _ellipse(means: Array, quaternions: Array, scales: Array, i: int, view: Array, intrinsics: Array) -> Any:
    """Project a Gaussian; return all that its gradient needs, the results last."""
    # The image of the three scaled axes: u = row (rotation) (scales). The covariance on the screen,
    # J W Sigma W' J', is made of the dot products of ux and uy.
    x, y, z = _in_camera(means, i, view)
    row_x, row_y = _rows(x / z, y / z, z, view, intrinsics)
    matrix, unit, scale = _rotation(quaternions, i)
    ux, uy = _axes(matrix, row_x, scales[i]), _axes(matrix, row_y, scales[i])
    xx, xy, yy = _dot(ux, ux) + _DILATION, _dot(ux, uy), _dot(uy, uy) + _DILATION
    # With d = DILATION, det = |ux|^2 |uy|^2 - (ux uy)^2 + d (|ux|^2 + |uy|^2 + d)
    #                        = |ux x uy|^2 + d (xx + yy - d),     by Lagrange's identity:
    # no difference of large numbers, so needles stay exact. The inverse covariance L L' then has
    # l22 = yy^(-1/2),   l11 = (yy / det)^(1/2),   l21 = -xy l11 / yy.
    # det / yy is evaluated as |ux x w|^2 + spread / yy with w = uy / sqrt(yy): nothing overflows.
    l22 = _ONE / math.sqrt(yy)
    w, spread = _times(l22, uy), _DILATION * (xx + yy - _DILATION)
    cross = _cross(ux, w)
    l11 = _ONE / math.sqrt(_dot(cross, cross) + spread * (l22 * l22))
    slopes, rotation, factor = (x / z, y / z, z), (matrix, unit, scale), (l11, l22)
    return slopes, rotation, (row_x, row_y), (ux, uy), (w, spread, cross), (xx, xy, yy), factor


@kernel
def _forward(
    first: int, last: int, indices: Array, means: Array, quaternions: Array, scales: Array, sh: Array, degree: int,
    view: Array, intrinsics: Array, position: Array, centers: Array, factors: Array, covariances: Array, depths: Array,
    colors: Array,
) -> None:  # fmt: skip
    """Project and color."""
    values = np.empty(16, f4)
    for k in range(first, last):
        i = indices[k]
        (slope_x, slope_y, z), _, _, _, _, (xx, xy, yy), (l11, l22) = _ellipse(
            means, quaternions, scales, i, view, intrinsics
        )
        centers[k, 0], centers[k, 1] = intrinsics[0] * slope_x + intrinsics[2], intrinsics[1] * slope_y + intrinsics[3]
        factors[k, 0], factors[k, 1], factors[k, 2] = l11, -xy * (l22 * l22) * l11, l22
        covariances[k, 0], covariances[k, 1], covariances[k, 2] = xx, xy, yy
        depths[k] = z
        if degree < 0:
            for c in range(3):
                colors[k, c] = sh[i, 0, c]
        else:
            direction, _ = _towards(means, i, position)
            basis(direction[0], direction[1], direction[2], degree, values)
            for c in range(3):
                color = _HALF
                for j in range((degree + 1) * (degree + 1)):
                    color += values[j] * sh[i, j, c]
                # Clamped at 0. As a product, so that minus infinity gives nan, which is refused.
                colors[k, c] = color if not color < _ZERO else _ZERO * color


@kernel
def _backward(
    first: int, last: int, indices: Array, means: Array, quaternions: Array, scales: Array, sh: Array, degree: int,
    view: Array, intrinsics: Array, position: Array, colors: Array, to_centers: Array, to_factors: Array,
    to_depths: Array, to_colors: Array, to_means: Array, to_quaternions: Array, to_scales: Array, to_sh: Array,
) -> None:  # fmt: skip
    """Carry gradients back to the Gaussians."""
    values = np.empty(16, f4)
    for k in range(first, last):
        i = indices[k]
        (slope_x, slope_y, z), rotation, (row_x, row_y), (ux, uy), (w, spread, cross), (_, xy, _), (l11, l22) = (
            _ellipse(means, quaternions, scales, i, view, intrinsics)
        )
        matrix, (qw, qx, qy, qz), scale = rotation
        s = scales[i]
        # The factor, last formula first. l21 = -xy l22^2 l11 passes its gradient on to all three:
        to_l11 = to_factors[k, 0] - to_factors[k, 1] * xy * l22 * l22
        to_xy = -to_factors[k, 1] * l22 * l22 * l11
        # l11 = q^(-1/2) with q = |cross|^2 + spread l22^2:   dl11 / dq = -l11^3 / 2.
        to_square = -_HALF * l11 * l11 * l11 * to_l11
        # cross = ux x w:   d(a x b) . g = da . (b x g) + db . (g x a).
        to_cross = _times(_TWO * to_square, cross)
        to_w = _cross(to_cross, ux)
        # l22 is a result itself, and stands in l21, in q, and in w = l22 uy.
        to_l22 = (
            to_factors[k, 2] - _TWO * to_factors[k, 1] * xy * l22 * l11 + _TWO * spread * l22 * to_square
            + _dot(to_w, uy)
        )  # fmt: skip
        # spread = d (xx + yy - d), and l22 = yy^(-1/2):   dl22 / dyy = -l22^3 / 2.
        to_xx = _DILATION * l22 * l22 * to_square
        to_yy = to_xx - _HALF * l22 * l22 * l22 * to_l22
        # xx = |ux|^2 + d,   xy = ux . uy,   yy = |uy|^2 + d.
        to_ux = _plus(_plus(_cross(w, to_cross), _TWO * to_xx, ux), to_xy, uy)
        to_uy = _plus(_plus(_times(l22, to_w), _TWO * to_yy, uy), to_xy, ux)
        # u_j = scale_j sum_k row_k matrix_kj, for both rows: linear in scales, rows and matrix.
        vx = to_ux[0] * s[0], to_ux[1] * s[1], to_ux[2] * s[2]
        vy = to_uy[0] * s[0], to_uy[1] * s[1], to_uy[2] * s[2]
        to_row_x = _dot(matrix[0:3], vx), _dot(matrix[3:6], vx), _dot(matrix[6:9], vx)
        to_row_y = _dot(matrix[0:3], vy), _dot(matrix[3:6], vy), _dot(matrix[6:9], vy)
        for j in range(3):
            column = (matrix[j], matrix[3 + j], matrix[6 + j])
            to_scales[i, j] = to_ux[j] * _dot(row_x, column) + to_uy[j] * _dot(row_y, column)
        # The gradient of matrix_kj is row_k v_j, summed over both rows; r0, r1, r2 are its rows.
        r0 = _plus(_times(row_x[0], vx), row_y[0], vy)
        r1 = _plus(_times(row_x[1], vx), row_y[1], vy)
        r2 = _plus(_times(row_x[2], vx), row_y[2], vy)
        # Each component of the quaternion stands in pairs of mirrored entries, such as 2 (xy - wz)
        # and 2 (xy + wz). Products with w take the difference of the pair's gradients (x12, ...),
        # products of two other components their sum (y12, ...).
        x12, x20, x01 = r2[1] - r1[2], r0[2] - r2[0], r1[0] - r0[1]
        y12, y20, y01 = r2[1] + r1[2], r0[2] + r2[0], r1[0] + r0[1]
        to_qw = _TWO * (qx * x12 + qy * x20 + qz * x01)
        to_qx = _TWO * (qy * y01 + qz * y20 + qw * x12 - _TWO * qx * (r1[1] + r2[2]))
        to_qy = _TWO * (qx * y01 + qz * y12 + qw * x20 - _TWO * qy * (r0[0] + r2[2]))
        to_qz = _TWO * (qx * y20 + qy * y12 + qw * x01 - _TWO * qz * (r0[0] + r1[1]))
        # q / |q| is the same for every length: the gradient's part along q is 0, the rest over |q|.
        along = qw * to_qw + qx * to_qx + qy * to_qy + qz * to_qz
        to_quaternions[i, 0] = scale * (to_qw - along * qw)
        to_quaternions[i, 1] = scale * (to_qx - along * qx)
        to_quaternions[i, 2] = scale * (to_qy - along * qy)
        to_quaternions[i, 3] = scale * (to_qz - along * qz)
        # row = f / z (axis - clipped slope forward),   center = f slope + c: a slope beyond the
        # limit moves the center still, but no longer the rows.
        forward = view[2, 0], view[2, 1], view[2, 2]
        to_slope_x, to_slope_y = intrinsics[0] * to_centers[k, 0], intrinsics[1] * to_centers[k, 1]
        if abs(slope_x) <= intrinsics[4]:
            to_slope_x -= intrinsics[0] / z * _dot(forward, to_row_x)
        if abs(slope_y) <= intrinsics[5]:
            to_slope_y -= intrinsics[1] / z * _dot(forward, to_row_y)
        # row ~ 1 / z,   slope_x = x / z:   dslope_x / dx = 1 / z,   dslope_x / dz = -slope_x / z.
        to_z = to_depths[k] - (_dot(row_x, to_row_x) + _dot(row_y, to_row_y)) / z
        to_z -= (slope_x * to_slope_x + slope_y * to_slope_y) / z
        to_x, to_y = to_slope_x / z, to_slope_y / z
        # The camera's frame is a rotation of the world's: the transposed matrix carries gradients
        # back.
        for j in range(3):
            to_means[i, j] = view[0, j] * to_x + view[1, j] * to_y + view[2, j] * to_z
        if degree < 0:
            for c in range(3):
                to_sh[i, 0, c] = to_colors[k, c]
            continue
        # No gradient passes a color that was clamped at 0.
        r = to_colors[k, 0] if colors[k, 0] > _ZERO else _ZERO
        g = to_colors[k, 1] if colors[k, 1] > _ZERO else _ZERO
        b = to_colors[k, 2] if colors[k, 2] > _ZERO else _ZERO
        (dx, dy, dz), inverse = _towards(means, i, position)
        basis(dx, dy, dz, degree, values)
        # color_c = 1/2 + sum_j basis_j(direction) sh_jc: to the coefficients, and to the basis
        # functions.
        for j in range((degree + 1) * (degree + 1)):
            to_sh[i, j, 0], to_sh[i, j, 1], to_sh[i, j, 2] = values[j] * r, values[j] * g, values[j] * b
            values[j] = r * sh[i, j, 0] + g * sh[i, j, 1] + b * sh[i, j, 2]
        tx, ty, tz = basis_gradient(dx, dy, dz, degree, values)
        # direction = v / |v|:   ddirection / dv = (1 - direction direction') / |v|.
        along = dx * tx + dy * ty + dz * tz
        to_means[i, 0] += inverse * (tx - along * dx)
        to_means[i, 1] += inverse * (ty - along * dy)
        to_means[i, 2] += inverse * (tz - along * dz)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, scales: Tensor, sh: Tensor, indices: Tensor, camera: Camera,
        degree: int,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        count = indices.shape[0]
        fx, fy = camera.fx, camera.fy
        limits = FRUSTUM_MARGIN * (0.5 * camera.width / fx), FRUSTUM_MARGIN * (0.5 * camera.height / fy)
        inputs = [x.detach().contiguous() for x in (indices, means, quaternions, scales, sh)]
        view, position = (x.contiguous().numpy() for x in (camera.world_to_camera, camera.position))
        ctx.view = degree, view, np.array([fx, fy, camera.cx, camera.cy, *limits], f4), position
        outputs = tuple(means.new_empty(count, *shape) for shape in ((2,), (3,), (3,), (), (3,)))
        in_threads(_forward, count, *(x.numpy() for x in inputs), *ctx.view, *(x.numpy() for x in outputs), least=4096)
        ctx.save_for_backward(*inputs, outputs[-1])
        ctx.mark_non_differentiable(outputs[2])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        # Forward quantities are computed again, so that nothing per Gaussian has to be kept.
        *given, colors = ctx.saved_tensors
        to_centers, to_factors, _, to_depths, to_colors = gradients
        upstream = tuple(x.contiguous().numpy() for x in (colors, to_centers, to_factors, to_depths, to_colors))
        found = [torch.zeros_like(x) for x in given[1:]]
        arrays = *(x.numpy() for x in given), *ctx.view, *upstream, *(x.numpy() for x in found)
        in_threads(_backward, colors.shape[0], *arrays, least=4096)
        return (*found, None, None, None)


def project(
    inputs: dict[str, Tensor], camera: Camera, degree: int | None, background: Tensor | None = None
) -> Projected:
    """Project and color Gaussians, see `Engine.project`; no gradient reaches the camera's pose."""
    depths, indices = visible(inputs, camera)
    # Plain colors are passed as coefficients (N, 1, 3) of degree -1.
    sh, band = (inputs["colors"][:, None], -1) if degree is None else (inputs["sh"], degree)
    *found, colors = _Project.apply(  # type: ignore[no-untyped-call]
        inputs["means"], inputs["quaternions"], inputs["scales"], sh, indices, camera, band
    )
    projection, opacities = Projection(*found), inputs["opacities"]
    numbers = numbers_to_check(depths, opacities, projection, colors, camera, background)
    if indices.shape[0] < opacities.shape[0]:
        opacities = opacities.index_select(0, indices)
    return Projected(indices, projection, opacities, colors, numbers)
