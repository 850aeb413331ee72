"""The window of SSIM as a loop: rows are added with weights, first across the picture, then down."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.render.loops.compiling import kernel
from reference_trainer.render.loops.threads import in_threads

__all__ = ["blur"]

Array = Any
f4 = np.float32


_RADIUS = 5


@kernel
def _blur(first: int, last: int, maps: Array, weights: Array, blurred: Array) -> None:
    """Blur images with a symmetric window, zeros beyond the border."""
    _, height, width = maps.shape
    padded = np.zeros((height + 2 * _RADIUS, width + 2 * _RADIUS), f4)
    down = np.zeros(width + 2 * _RADIUS, f4)
    w0, w1, w2, w3, w4, w5 = weights[0], weights[1], weights[2], weights[3], weights[4], weights[5]
    for image in range(first, last):
        padded[_RADIUS : _RADIUS + height, _RADIUS : _RADIUS + width] = maps[image]
        for y in range(height):
            a, b, c, d, e = padded[y], padded[y + 1], padded[y + 2], padded[y + 3], padded[y + 4]
            f = padded[y + 5]
            g, h, i, j, k = padded[y + 6], padded[y + 7], padded[y + 8], padded[y + 9], padded[y + 10]
            for x in range(width + 2 * _RADIUS):
                inner = w0 * f[x] + w1 * (e[x] + g[x]) + w2 * (d[x] + h[x])
                down[x] = inner + w3 * (c[x] + i[x]) + w4 * (b[x] + j[x]) + w5 * (a[x] + k[x])
            out = blurred[image, y]
            for x in range(width):
                inner = w0 * down[x + 5] + w1 * (down[x + 4] + down[x + 6]) + w2 * (down[x + 3] + down[x + 7])
                inner += w3 * (down[x + 2] + down[x + 8]) + w4 * (down[x + 1] + down[x + 9])
                out[x] = inner + w5 * (down[x] + down[x + 10])


def blur(maps: Tensor, weights: list[float]) -> Tensor:
    """Blur images (..., H, W) with a symmetric separable window, zeros beyond the border.

    Args:
        maps: float32, on the processor.
        weights: of the window's centre and of the pixels to one side of it.
    """
    images = maps.contiguous().view(-1, *maps.shape[-2:])
    blurred = torch.empty_like(images)
    in_threads(_blur, images.shape[0], images.numpy(), np.array(weights, f4), blurred.numpy(), least=1)
    return blurred.view(maps.shape)
