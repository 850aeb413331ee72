"""What the loops share: the pixels of a tile, and powers of two that become vector instructions."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from reference_trainer.render.constants import TILE
from reference_trainer.render.loops.compiling import inlined

__all__ = ["PIXELS", "X", "Y", "exp2"]

f4 = np.float32

PIXELS = TILE * TILE
X = np.tile(np.arange(TILE, dtype=f4) - f4((TILE - 1) / 2), TILE)
"""x of every pixel of a tile from its centre, row by row."""
Y = np.repeat(np.arange(TILE, dtype=f4) - f4((TILE - 1) / 2), TILE)
"""y likewise."""

# The polynomial of degree 5 with the least relative error (7.5e-8) of 2^x on [-1/2, 1/2].
_P0, _P1, _P2 = f4(1.00000007165467), f4(0.69314696706436), f4(0.24022119723882)
_P3, _P4, _P5 = f4(0.05550713274154), f4(0.00967554133273), f4(0.00132764717803)
_LEAST = f4(-126.0)  # the least exponent of a normal float32; all alphas so small are cut off
_HALF, _BIAS, _MANTISSA = f4(0.5), np.int32(127), np.int32(23)


@intrinsic
def _as_float(context: Any, bits: Any) -> Any:
    """Read the bits of an int32 as a float32."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@inlined
def exp2(x: Any) -> Any:
    """Return 2^x in float32 for x up to 127; what is below 2^-126 becomes that.

    `math.exp2` is a call for every number; this is a dozen instructions for eight or sixteen of them.
    """
    x = x if x > _LEAST else _LEAST
    whole = np.floor(x + _HALF)
    part = x - whole
    power = _P0 + part * (_P1 + part * (_P2 + part * (_P3 + part * (_P4 + part * _P5))))
    return power * _as_float((np.int32(whole) + _BIAS) << _MANTISSA)
