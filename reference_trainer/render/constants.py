"""The numbers of the renderer, each with its reason. They are the INRIA rasterizer's unless said otherwise."""

from __future__ import annotations

from typing import Final

NEAR_PLANE: Final = 0.2
"""Gaussians whose centre is nearer along the camera's z axis are not drawn: their linearised projection explodes."""

DILATION: Final = 0.3
"""Added to the diagonal of every projected covariance, square pixels: no splat is thinner than about one pixel."""

FRUSTUM_MARGIN: Final = 1.3
"""The projection is linearised at most this many half-fields of view off the axis; the Jacobian explodes beyond."""

MAX_ROUNDING: Final = 0.25
"""Gaussians whose coordinates round to more pixels than this are refused. Own choice: images are off by some 3 %."""

MAX_ALPHA: Final = 0.99
"""No splat is fully opaque, so 1 - alpha never vanishes and the backward pass may divide by it."""

MIN_ALPHA: Final = 1.0 / 255.0
"""Splats fainter than one 8-bit step are skipped at a pixel; this also bounds every splat to an ellipse."""

MIN_TRANSMITTANCE: Final = 1e-4
"""A splat that would leave less light than this ends its pixel and is itself not drawn."""

TILE: Final = 8
"""Side of a tile in pixels. Own choice: at the INRIA value of 16, about 1.6 times as many pairs are evaluated."""

BLOCK_ELEMENTS_CPU: Final = 1 << 17
"""Pixel-Gaussian pairs held at once on a CPU: temporaries of 512 KiB in float32 stay in the cache."""

CHUNK_ENTRIES: Final = 1 << 19
"""List entries (a Gaussian in a tile) expanded at once: some 100 bytes each while they are composited."""

BLOCK_ELEMENTS_CUDA: Final = 1 << 25
"""Pixel-Gaussian pairs held at once on a GPU: 128 MiB temporaries keep it busy and the number of launches low."""

SLICE_ENTRIES: Final = 8
"""Entries of a tile that compiled moments take at once: twice as many take twice as long to compile."""
