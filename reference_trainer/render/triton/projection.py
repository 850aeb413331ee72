"""From 3D Gaussians to colored 2D ellipses, a Gaussian per lane; formulas as in the engine of PyTorch operations."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION, FRUSTUM_MARGIN, HARMONICS, MIN_ALPHA, NEAR_PLANE
from reference_trainer.render.splats import Projected, Projection
from reference_trainer.render.triton.binning import count_tiles
from reference_trainer.render.triton.launching import kernel, launch
from reference_trainer.render.triton.tiles import ENTRIES, SEEN

__all__ = ["project"]

_DILATION = tl.constexpr(DILATION)
_MIN_ALPHA, _NEAR_PLANE = tl.constexpr(MIN_ALPHA), tl.constexpr(NEAR_PLANE)
_A, _B, _C, _D, _E, _F, _G, _H = (tl.constexpr(x) for x in HARMONICS)
_BLOCK = 128  # Gaussians of a program, one per lane: neighbors in memory, whose rows share cache lines


@triton.jit
def _load3(at, mask):
    return (
        tl.load(at, mask=mask, other=1.0),
        tl.load(at + 1, mask=mask, other=1.0),
        tl.load(at + 2, mask=mask, other=1.0),
    )


@triton.jit
def _store3(at, a, mask):
    tl.store(at, a[0], mask=mask)
    tl.store(at + 1, a[1], mask=mask)
    tl.store(at + 2, a[2], mask=mask)


@triton.jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def _plus(a, scale, b):
    """Return a + scale b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@triton.jit
def _times(scale, a):
    return scale * a[0], scale * a[1], scale * a[2]


@triton.jit
def _by_column(row, r0, r1, r2):
    """Return a row vector times the matrix with rows r0, r1, r2."""
    return _plus(_plus(_times(row[0], r0), row[1], r1), row[2], r2)


@triton.jit
def _rotation(at, mask):
    """Return a quaternion's rotation matrix by rows, the unit quaternion, and the factor that normalizes it."""
    w, x = tl.load(at, mask=mask, other=1.0), tl.load(at + 1, mask=mask, other=0.0)
    y, z = tl.load(at + 2, mask=mask, other=0.0), tl.load(at + 3, mask=mask, other=0.0)
    # Divided by the largest component first: its square would overflow from 1e19 on, or underflow.
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    scale = 1 / tl.maximum(largest, 1e-30)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    norm = tl.sqrt(w * w + x * x + y * y + z * z)
    inverse = tl.where(norm > 1e-12, 1 / tl.maximum(norm, 1e-12), 0.0)  # a zero quaternion gives the identity
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    r0 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r1 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r2 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return r0, r1, r2, (w, x, y, z), scale * inverse


@triton.jit
def _view(view):
    """Return the three rows of the view rotation."""
    right = tl.load(view), tl.load(view + 1), tl.load(view + 2)
    down = tl.load(view + 4), tl.load(view + 5), tl.load(view + 6)
    return right, down, (tl.load(view + 8), tl.load(view + 9), tl.load(view + 10))


@triton.jit
def _ellipse(mean, r0, r1, r2, s, view, fx, fy, limit_x, limit_y):
    """Project a Gaussian; return all that its gradient needs.

    The covariance is u u^T + dilation with rows u_x, u_y = (Jacobian x view rotation) x rotation x scales. Its
    determinant is a sum of squares (Cauchy-Binet), det = |u_x x u_y|^2 + dilation (xx + yy - dilation), where
    xx yy - xy^2 would cancel for needles; divided by yy before it is squared, so that it does not overflow.
    """
    right, down, forward = _view(view)
    x, y = _dot(right, mean) + tl.load(view + 3), _dot(down, mean) + tl.load(view + 7)
    z = _dot(forward, mean) + tl.load(view + 11)
    slope_x, slope_y = x / z, y / z
    clipped_x = tl.minimum(tl.maximum(slope_x, -limit_x), limit_x)
    clipped_y = tl.minimum(tl.maximum(slope_y, -limit_y), limit_y)
    row_x = _times(fx / z, _plus(right, -clipped_x, forward))
    row_y = _times(fy / z, _plus(down, -clipped_y, forward))
    ax, ay = _by_column(row_x, r0, r1, r2), _by_column(row_y, r0, r1, r2)
    ux, uy = (s[0] * ax[0], s[1] * ax[1], s[2] * ax[2]), (s[0] * ay[0], s[1] * ay[1], s[2] * ay[2])
    xx, xy, yy = _dot(ux, ux) + _DILATION, _dot(ux, uy), _dot(uy, uy) + _DILATION
    l22 = 1 / tl.sqrt(yy)
    cross, spread = _cross(ux, _times(l22, uy)), (xx + yy - _DILATION) * _DILATION
    l11 = 1 / tl.sqrt(_dot(cross, cross) + spread * (l22 * l22))
    return (slope_x, slope_y, z), (row_x, row_y), (ax, ay), (ux, uy), (cross, spread), (xx, xy, yy), (l11, l22)


@triton.jit
def _basis(x, y, z):
    """Return the 16 real spherical harmonics up to degree 3; those that nobody reads are never computed.

    Constants stand on the right: in the interpreter, a `tl.constexpr` times a tensor would be a `tl.constexpr`.
    """
    xx, yy, zz = x * x, y * y, z * z
    return (
        0 * x + _A, y * -_B, z * _B, x * -_B,
        x * y * _C, y * z * -_C, (2 * zz - xx - yy) * _D, x * z * -_C, (xx - yy) * (0.5 * _C),
        y * (3 * xx - yy) * -_E, x * y * z * _F, y * (4 * zz - xx - yy) * -_G, z * (2 * zz - 3 * xx - 3 * yy) * _H,
        x * (4 * zz - xx - yy) * -_G, z * (xx - yy) * (0.5 * _F), x * (xx - 3 * yy) * -_E,
    )  # fmt: skip


@triton.jit
def _basis_slopes(x, y, z):
    """Return the derivatives of the harmonics in x, y and z."""
    # Term by term the derivatives of the polynomials in `_basis`, in all of space: D (2 zz - xx - yy), for example, has
    # -2 D x, -2 D y and 4 D z. `project_backward` removes the part along the direction, which would leave the sphere.
    xx, yy, zz, no = x * x, y * y, z * z, 0 * x
    in_x = (
        no, no, no, no - _B, y * _C, no, x * (-2 * _D), z * -_C, x * _C, x * y * (-6 * _E), y * z * _F,
        x * y * (2 * _G), x * z * (-6 * _H), (4 * zz - 3 * xx - yy) * -_G, x * z * _F, (xx - yy) * (-3 * _E),
    )  # fmt: skip
    in_y = (
        no, no - _B, no, no, x * _C, z * -_C, y * (-2 * _D), no, y * -_C, (xx - yy) * (-3 * _E), x * z * _F,
        (4 * zz - xx - 3 * yy) * -_G, y * z * (-6 * _H), x * y * (2 * _G), y * z * -_F, x * y * (6 * _E),
    )  # fmt: skip
    in_z = (
        no, no, no + _B, no, no, y * -_C, z * (4 * _D), x * -_C, no, no, x * y * _F, y * z * (-8 * _G),
        (2 * zz - xx - yy) * (3 * _H), x * z * (-8 * _G), (xx - yy) * (0.5 * _F), no,
    )  # fmt: skip
    return in_x, in_y, in_z


@triton.jit
def _towards(mean, view):
    """Return the unit vector from the camera, at -R^T t, to a mean, and one over their distance."""
    right, down, forward = _view(view)
    at = _plus(_plus(_times(tl.load(view + 3), right), tl.load(view + 7), down), tl.load(view + 11), forward)
    offset = _plus(mean, 1.0, at)
    inverse = 1 / tl.maximum(tl.sqrt(_dot(offset, offset)), 1e-12)
    return _times(inverse, offset), inverse


@triton.jit
def _add_unless_finite(numbers, x):
    """Make the second number nan if one of x is nan or infinite, whose product with 0 is nan."""
    bad = tl.sum(0 * x)
    if bad != 0:
        tl.atomic_add(numbers + 1, bad.to(tl.float64), sem="relaxed")


@kernel
def find_visible(means, opacities, view, background, visible, numbers, count, BLOCK: tl.constexpr):
    """Tell who is in view; the first numbers, zeros before, are those of `check_projection`."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = i < count
    opacity = tl.load(opacities + i, mask=real, other=0.0)
    _right, _down, forward = _view(view)
    z = tl.where(real, _dot(forward, _load3(means + 3 * i, real)) + tl.load(view + 11), 0.0)
    tl.store(visible + i, ((z > _NEAR_PLANE) & (opacity >= _MIN_ALPHA)).to(tl.int32), mask=real)
    _add_unless_finite(numbers, z + 0 * opacity)
    if tl.program_id(0) == 0:
        # The pose travels with the sums that the processor waits for: to read it on its own would be another wait.
        j = tl.arange(0, 16)
        tl.store(numbers + 2 + j, tl.load(view + j).to(tl.float64))
        _add_unless_finite(numbers, tl.load(background + j, mask=j < 3, other=0.0))


@kernel
def index_visible(places, indices, numbers, count, BLOCK: tl.constexpr):
    """List who is in view, in order, from the running number of these, and tell how many they are."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = i < count
    place = tl.load(places + i, mask=real, other=0)
    before = tl.load(places + i - 1, mask=real & (i > 0), other=0)
    tl.store(indices + before, i.to(tl.int64), mask=place > before)
    tl.store(numbers + (0 * i + SEEN), place.to(tl.float64), mask=i == count - 1)


@kernel
def project_forward(
    indices, means, quaternions, scales, sh, opacities, view, centers,
    factors, covariances, depths, colors, shown_opacities, numbers, fx, fy, cx, cy,
    limit_x, limit_y, BANDS: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Project and color who is in view; BANDS harmonics of the ROW given ones, or plain colors if it is 0."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(numbers + SEEN).to(tl.int32)
    if tl.program_id(0) * BLOCK >= count:
        return
    real = k < count
    i = tl.load(indices + k, mask=real, other=0)
    tl.store(shown_opacities + k, tl.load(opacities + i, mask=real), mask=real)
    mean, s = _load3(means + 3 * i, real), _load3(scales + 3 * i, real)
    r0, r1, r2, _unit, _scale = _rotation(quaternions + 4 * i, real)
    slopes, _rows, _axes, _u, _det, covariance, factor = _ellipse(mean, r0, r1, r2, s, view, fx, fy, limit_x, limit_y)
    l11, l22 = factor
    x, y = fx * slopes[0] + cx, fy * slopes[1] + cy
    tl.store(centers + 2 * k, x, mask=real)
    tl.store(centers + 2 * k + 1, y, mask=real)
    _store3(factors + 3 * k, (l11, -covariance[1] * (l22 * l22) * l11, l22), real)
    _store3(covariances + 3 * k, covariance, real)
    tl.store(depths + k, slopes[2], mask=real)
    given = sh + i * (3 * ROW)
    color = _load3(given, real)
    if BANDS > 0:
        direction, _inverse = _towards(mean, view)
        values = _basis(direction[0], direction[1], direction[2])
        color = 0.5 + values[0] * color[0], 0.5 + values[0] * color[1], 0.5 + values[0] * color[2]
        for j in tl.static_range(1, BANDS):
            color = _plus(color, values[j], _load3(given + 3 * j, real))
        # Minus infinity gives nan, and is refused, where a plain maximum with 0 would hide it.
        r, g, b = color
        color = tl.where(r < 0, 0 * r, r), tl.where(g < 0, 0 * g, g), tl.where(b < 0, 0 * b, b)
    _store3(colors + 3 * k, color, real)
    nothing = 0 * (color[0] + color[1] + color[2]) + 0 * (covariance[0] + covariance[1] + covariance[2]) + 0 * (x + y)
    _add_unless_finite(numbers, tl.where(real, nothing, 0.0))
    tl.atomic_add(numbers, tl.sum(tl.where(real, slopes[2], 0.0)).to(tl.float64), sem="relaxed")


@kernel
def project_backward(
    indices, means, quaternions, scales, sh, view, colors,
    to_centers, to_factors, to_depths, to_colors, to_shown_opacities, to_means, to_quaternions,
    to_scales, to_sh, to_opacities, count, fx, fy, limit_x, limit_y,
    row_centers, row_factors, row_depths, row_colors, row_opacities,
    DEPTHS: tl.constexpr, BANDS: tl.constexpr, ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Carry gradients back to the Gaussians; nothing is kept of the forward pass but the colors that were cut at 0.

    The gradients come as columns of larger rows, of ``row_`` numbers each.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = k < count
    i = tl.load(indices + k, mask=real, other=0)
    mean, s = _load3(means + 3 * i, real), _load3(scales + 3 * i, real)
    r0, r1, r2, unit, scale = _rotation(quaternions + 4 * i, real)
    slopes, rows, axes, u, det, covariance, factor = _ellipse(mean, r0, r1, r2, s, view, fx, fy, limit_x, limit_y)
    slope_x, slope_y, z = slopes
    row_x, row_y = rows
    ux, uy = u
    cross, spread = det
    xy = covariance[1]
    l11, l22 = factor
    to_opacity = tl.load(to_shown_opacities + row_opacities * k, mask=real, other=0.0)
    tl.store(to_opacities + i, to_opacity, mask=real)
    t11, t21, t22 = _load3(to_factors + row_factors * k, real)
    # l21 = -xy l22^2 l11; l11 = square^(-1/2) with square = |cross|^2 + spread l22^2, cross = u_x x (l22 u_y), and
    # spread = dilation (xx + yy - dilation); l22 = yy^(-1/2).
    to_xy = -t21 * l22 * l22 * l11
    to_square = -0.5 * l11 * l11 * l11 * (t11 - t21 * xy * l22 * l22)
    to_cross = _times(2 * to_square, cross)
    w = _times(l22, uy)
    to_w = _cross(to_cross, ux)
    to_l22 = t22 - 2 * t21 * xy * l22 * l11 + 2 * spread * l22 * to_square + _dot(to_w, uy)
    to_xx = l22 * l22 * to_square * _DILATION
    to_yy = to_xx - 0.5 * l22 * l22 * l22 * to_l22
    to_ux = _plus(_plus(_cross(w, to_cross), 2 * to_xx, ux), to_xy, uy)
    to_uy = _plus(_plus(_times(l22, to_w), 2 * to_yy, uy), to_xy, ux)
    # u_j = s_j (row R)_j in both rows, so a scale meets the axis (row R)_j, and the row and R meet v = s to_u.
    ax, ay = axes
    to_s = to_ux[0] * ax[0] + to_uy[0] * ay[0], to_ux[1] * ax[1] + to_uy[1] * ay[1], to_ux[2] * ax[2] + to_uy[2] * ay[2]
    _store3(to_scales + 3 * i, to_s, real)
    vx, vy = (to_ux[0] * s[0], to_ux[1] * s[1], to_ux[2] * s[2]), (to_uy[0] * s[0], to_uy[1] * s[1], to_uy[2] * s[2])
    to_row_x, to_row_y = (_dot(r0, vx), _dot(r1, vx), _dot(r2, vx)), (_dot(r0, vy), _dot(r1, vy), _dot(r2, vy))
    m0 = _plus(_times(row_x[0], vx), row_y[0], vy)  # the gradient of the rotation matrix, by rows
    m1 = _plus(_times(row_x[1], vx), row_y[1], vy)
    m2 = _plus(_times(row_x[2], vx), row_y[2], vy)
    # The matrix holds w in differences of mirrored entries, such as 2 (yz + wx) and 2 (yz - wx), and products of two
    # other components in their sums: hence the differences a and the sums b of mirrored gradients. The diagonal has
    # -2 xx in the entries of the two other axes, and so on.
    qw, qx, qy, qz = unit
    a12, a20, a01 = m2[1] - m1[2], m0[2] - m2[0], m1[0] - m0[1]
    b12, b20, b01 = m2[1] + m1[2], m0[2] + m2[0], m1[0] + m0[1]
    to_w_ = 2 * (qx * a12 + qy * a20 + qz * a01)
    to_x_ = 2 * (qy * b01 + qz * b20 + qw * a12 - 2 * qx * (m1[1] + m2[2]))
    to_y_ = 2 * (qx * b01 + qz * b12 + qw * a20 - 2 * qy * (m0[0] + m2[2]))
    to_z_ = 2 * (qx * b20 + qy * b12 + qw * a01 - 2 * qz * (m0[0] + m1[1]))
    along = qw * to_w_ + qx * to_x_ + qy * to_y_ + qz * to_z_  # a quaternion's length does not matter
    tl.store(to_quaternions + 4 * i, scale * (to_w_ - along * qw), mask=real)
    _store3(
        to_quaternions + 4 * i + 1,
        (scale * (to_x_ - along * qx), scale * (to_y_ - along * qy), scale * (to_z_ - along * qz)), real,
    )  # fmt: skip
    # row = f / z (axis - clipped slope x forward), center = f slope + c, slope = x / z; the clip passes no gradient.
    right, down, forward = _view(view)
    to_slope_x = fx * tl.load(to_centers + row_centers * k, mask=real, other=0.0)
    to_slope_y = fy * tl.load(to_centers + row_centers * k + 1, mask=real, other=0.0)
    to_slope_x -= tl.where(tl.abs(slope_x) <= limit_x, fx / z * _dot(forward, to_row_x), 0.0)
    to_slope_y -= tl.where(tl.abs(slope_y) <= limit_y, fy / z * _dot(forward, to_row_y), 0.0)
    to_z = tl.zeros_like(z)
    if DEPTHS:
        to_z = tl.load(to_depths + row_depths * k, mask=real, other=0.0)
    to_z -= (_dot(row_x, to_row_x) + _dot(row_y, to_row_y) + slope_x * to_slope_x + slope_y * to_slope_y) / z
    to_mean = _plus(_plus(_times(to_slope_x / z, right), to_slope_y / z, down), to_z, forward)
    shown, to_color = _load3(colors + 3 * k, real), _load3(to_colors + row_colors * k, real)
    if BANDS == 0:
        _store3(to_sh + 3 * i, to_color, real)
    else:
        r, g, b = to_color
        r, g, b = tl.where(shown[0] > 0, r, 0.0), tl.where(shown[1] > 0, g, 0.0), tl.where(shown[2] > 0, b, 0.0)
        direction, inverse = _towards(mean, view)
        values = _basis(direction[0], direction[1], direction[2])
        in_x, in_y, in_z = _basis_slopes(direction[0], direction[1], direction[2])
        at, to_at = sh + i * (3 * ROW), to_sh + i * (3 * ROW)
        to_direction = 0 * r, 0 * r, 0 * r
        for j in tl.static_range(BANDS):
            _store3(to_at + 3 * j, (values[j] * r, values[j] * g, values[j] * b), real)
            to_value = _dot(_load3(at + 3 * j, real), (r, g, b))
            to_direction = _plus(to_direction, to_value, (in_x[j], in_y[j], in_z[j]))
        # direction = offset / |offset|: only what is across the direction turns it.
        across = _plus(to_direction, -_dot(direction, to_direction), direction)
        to_mean = _plus(to_mean, inverse, across)
    _store3(to_means + 3 * i, to_mean, real)


class _Project(torch.autograd.Function):
    """Means, factors, covariances, depths, colors and opacities of the Gaussians at the indices."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, scales: Tensor, sh: Tensor, opacities: Tensor,
        outputs: list[Tensor], saved: list[Tensor], size: tuple[float, ...], constants: dict[str, int],
    ) -> tuple[Tensor, ...]:  # fmt: skip
        ctx.size, ctx.constants = size, constants
        ctx.save_for_backward(*saved, outputs[4])
        # The covariances only decide on tiles and radii, which have no gradient.
        ctx.mark_non_differentiable(outputs[2])
        # Gradients that nobody asked for stay None: the kernel then leaves the depths out instead of adding zeros.
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        (indices, *given, _, colors), depths = saved, gradients[3] is not None
        upstream = [
            _rows(colors.new_zeros(len(colors), *shape) if x is None else x)
            for x, shape in zip((*gradients[:2], *gradients[4:]), ((2,), (3,), (3,), ()), strict=True)
        ]
        # A kernel takes an address in every place: without depths another, which it does not read.
        upstream.insert(2, _rows(gradients[3]) if depths else upstream[-1])
        # One fill for all of them, and none if everything is written.
        shapes = [x.shape for x in given] + [given[0].shape[:1]]
        whole = len(indices) == len(given[0]) and max(1, ctx.constants["BANDS"]) == ctx.constants["ROW"]
        sizes = [shape.numel() for shape in shapes]
        parts = (colors.new_empty if whole else colors.new_zeros)(sum(sizes)).split(sizes)
        found = [x.view(shape) for x, shape in zip(parts, shapes, strict=True)]
        launch(
            project_backward, (triton.cdiv(len(indices), _BLOCK),), *saved, *upstream, *found, len(indices), *ctx.size,
            *(x.stride(0) for x in upstream), DEPTHS=depths, **ctx.constants,
        )  # fmt: skip
        return (*found, None, None, None, None)


def _rows(x: Tensor) -> Tensor:
    """Return a tensor whose rows may lie apart, but not their numbers."""
    return x if x.ndim == 1 or x.stride(1) == 1 else x.contiguous()


def project(
    inputs: dict[str, Tensor], camera: Camera, degree: int | None, background: Tensor | None = None
) -> Projected:
    """Project and color Gaussians, see `Engine.project`; no gradient reaches the camera's pose.

    How many are in view, and how many tiles they touch, is read back with the numbers to check, the one wait for a
    card: until then all has room for all Gaussians.
    """
    means, opacities = inputs["means"], inputs["opacities"]
    sh, bands = (inputs["colors"][:, None], 0) if degree is None else (inputs["sh"], (degree + 1) ** 2)
    differentiable = means, inputs["quaternions"], inputs["scales"], sh, opacities
    *given, plain = (x.detach().contiguous() for x in differentiable)
    view, count = camera.world_to_camera.detach().contiguous(), len(means)
    numbers = torch.zeros(ENTRIES.value + 1, dtype=torch.float64, device=means.device)
    visible = torch.empty(count, dtype=torch.int32, device=means.device)
    color = view if background is None else background.detach().to(view).contiguous()  # the pose is checked anyway
    grid, block = (triton.cdiv(count, 1024),), {"warps": 4, "BLOCK": 1024}
    launch(find_visible, grid, given[0], plain, view, color, visible, numbers, count, **block)
    indices = torch.empty_like(visible, dtype=torch.int64)
    launch(index_visible, grid, torch.cumsum(visible, 0, dtype=torch.int32), indices, numbers, count, **block)
    outputs = [means.new_empty(count, *shape) for shape in ((2,), (3,), (3,), (), (3,), ())]
    limits = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx, FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    constants = {"warps": 4, "BANDS": bands, "ROW": sh.shape[1], "BLOCK": _BLOCK}
    launch(
        project_forward, (triton.cdiv(count, _BLOCK),), indices, *given, plain, view, *outputs, numbers,
        camera.fx, camera.fy, camera.cx, camera.cy, *limits, **constants,
    )  # fmt: skip
    counts = count_tiles([*outputs[:3], outputs[5]], numbers, camera.width, camera.height)
    read = numbers.cpu()  # the one wait for the card
    seen = int(read[SEEN.value])
    indices, *outputs = (x[:seen] for x in (indices, *outputs))
    *found, colors, shown = _Project.apply(  # type: ignore[no-untyped-call]
        *differentiable, outputs, [indices, *given, view], (camera.fx, camera.fy, *limits), constants
    )
    counts = counts._replace(each=counts.each[:seen], touched=counts.touched[:seen], total=int(read[ENTRIES.value]))
    return Projected(indices, Projection(*found), shown, colors, read[: SEEN.value], counts)
