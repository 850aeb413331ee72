"""Spherical harmonics of one direction, and their derivatives; the convention is that of `evaluate_sh`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from reference_trainer.compiled.compiling import inlined

__all__ = ["basis", "basis_gradient"]

f4 = np.float32
_A = f4(math.sqrt(1 / (4 * math.pi)))
_B = f4(math.sqrt(3 / (4 * math.pi)))
_C, _D = f4(math.sqrt(15 / (4 * math.pi))), f4(math.sqrt(5 / (16 * math.pi)))
_E, _F = f4(math.sqrt(35 / (32 * math.pi))), f4(math.sqrt(105 / (4 * math.pi)))
_G, _H = f4(math.sqrt(21 / (32 * math.pi))), f4(math.sqrt(7 / (16 * math.pi)))
_HALF, _TWO, _THREE, _FOUR, _SIX, _EIGHT = f4(0.5), f4(2), f4(3), f4(4), f4(6), f4(8)


@inlined
def basis(x: Any, y: Any, z: Any, degree: Any, values: Any) -> None:
    """Write the (degree + 1)^2 basis functions at a unit vector."""
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
    """Return the gradient with respect to (x, y, z), given that with respect to the basis functions."""
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
