"""The costly parts of SSIM as compiled loops: the window, and the formula with its derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.compiled.compiling import kernel
from reference_trainer.compiled.threads import in_threads
from reference_trainer.training.losses._ssim_constants import C1, C2, WEIGHTS

__all__ = ["blur", "similarity"]

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


def blur(maps: Tensor) -> Tensor:
    """Blur images (..., H, W), float32 on the CPU, with the window of SSIM, zeros beyond the border."""
    images = maps.contiguous().view(-1, *maps.shape[-2:])
    blurred = torch.empty_like(images)
    in_threads(_blur, images.shape[0], images.numpy(), np.array(WEIGHTS, f4), blurred.numpy(), least=1)
    return blurred.view(maps.shape)


@kernel
def _similarity(first: int, last: int, blurred: Array, c1: float, c2: float, result: Array, slopes: Array) -> None:
    """Evaluate the formula at pixels."""
    one, two, of_means, of_variances = f4(1), f4(2), f4(c1), f4(c2)
    for i in range(first, last):
        x, y, xy, squared = blurred[0, i], blurred[1, i], blurred[2, i], blurred[3, i]
        # The formula and its derivatives are those of `photometric._similarity`, and derived there.
        product, squares = x * y, x * x + y * y
        a1, a2 = two * product + of_means, two * (xy - product) + of_variances
        b1, b2 = squares + of_means, squared - squares + of_variances
        weight = one / (b1 * b2)
        value = a1 * a2 * weight
        result[i] = value
        slopes[0, i] = two * weight * (y * (a2 - a1) + value * x * (b1 - b2))
        slopes[1, i] = -weight * value * b1
        slopes[2, i] = two * weight * a1


def similarity(blurred: Tensor) -> tuple[Tensor, Tensor]:
    """Return SSIM (C, H, W), and its derivatives (3, C, H, W) by the blurred x, x^2 + y^2 and x y.

    ``blurred`` holds x, y, x y and x^2 + y^2, float32 on the CPU, (4, C, H, W).
    """
    result, slopes = torch.empty_like(blurred[0]), torch.empty_like(blurred[:3])
    pixels = result.numel()
    arrays = (slopes.view(3, pixels), result.view(pixels), blurred.contiguous().view(4, pixels))
    of_slopes, of_result, of_blurred = (x.numpy() for x in arrays)
    in_threads(_similarity, pixels, of_blurred, C1, C2, of_result, of_slopes, least=4096)
    return result, slopes
