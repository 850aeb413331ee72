"""The numbers of the renderer, each with its reason.

They are the INRIA rasterizer's unless said otherwise.
"""

from __future__ import annotations

import math
from typing import Final

NEAR_PLANE: Final = 0.2
"""Gaussians whose center is nearer along the camera's z axis are not rendered: their linearized
projection explodes."""

DILATION: Final = 0.3
"""Added to the diagonal of every projected covariance, square pixels: no splat is thinner than
about one pixel."""

FRUSTUM_MARGIN: Final = 1.3
"""The projection is linearized at most this many half-fields of view off the axis; the Jacobian
explodes beyond."""

MAX_ROUNDING: Final = 0.25
"""Scenes whose coordinates round by more pixels than this are refused. Own choice: images are then
off by some 3 %."""

MAX_ALPHA: Final = 0.99
"""No splat is fully opaque, so 1 - alpha never vanishes and the backward pass may divide by it."""

MIN_ALPHA: Final = 1.0 / 255.0
"""Splats fainter than one 8-bit step are skipped at a pixel; this also bounds every splat to an
ellipse."""

MIN_TRANSMITTANCE: Final = 1e-4
"""A splat that would leave less transmittance than this terminates its pixel and is itself not
rendered."""

HARMONICS: Final = tuple(
    math.sqrt(numerator / (denominator * math.pi))
    for numerator, denominator in ((1, 4), (3, 4), (15, 4), (5, 16), (35, 32), (105, 4), (21, 32), (7, 16))
)
"""What normalizes the real spherical harmonics: a number each for bands 0 and 1, two for band 2, four for band 3."""

TILE: Final = 8
"""Side of a tile in pixels. Own choice: at the INRIA value of 16, about 1.6 times as many pairs are
evaluated."""

BLOCK_PAIRS_CPU: Final = 1 << 19
"""Pixel-Gaussian pairs that the torch engine holds at once on a CPU: temporaries of 2 MiB."""

BLOCK_PAIRS_CUDA: Final = 1 << 25
"""The same on a GPU, at most: temporaries of 128 MiB keep it busy and the number of launches low."""

BYTES_PER_PAIR_CUDA: Final = 1024
"""And one for so many bytes that the card has: a pair takes up to 215 bytes, of shares, so a fifth
of them. Of all its memory, not of what is free, so that a training repeats itself to the bit."""
