"""The photometric loss, SSIM included, as kernels: two launches forward, two back.

A step with few Gaussians waits for the host, which starts kernels one by one, so the formula and all that is added up
around it happen where the window's second axis is blurred. The first axis has kernels of its own: what they write
stays in a card's cache. A lane reads the pixels of its window itself, which its neighbors have read just before.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ca_reg.functional.expected_losses import ROUNDING
from reference_trainer.render.triton.launching import kernel, launch
from reference_trainer.render.triton.tiles import store3
from reference_trainer.training.losses._ssim_constants import C1, C2, WEIGHTS

__all__ = ["photometric_loss"]

_CENTER = tl.constexpr(WEIGHTS[0])
_RATIO = tl.constexpr(WEIGHTS[1] / WEIGHTS[0])  # a Gaussian's weight at k pixels is _CENTER _RATIO^(k^2)
_C1, _C2 = tl.constexpr(C1), tl.constexpr(C2)
_FLOOR = tl.constexpr(ROUNDING**2)  # of the variance, as in `expected_absolute_error`
_ROOT_PI = tl.constexpr(1 / math.sqrt(math.pi))
_WIDE, _HIGH, _WARPS = 32, 16, 8  # of a program: a warp reads rows of 32 pixels, a lane holds two


@triton.jit
def _tile(width, height, WIDE: tl.constexpr, HIGH: tl.constexpr):
    """Return a program's pixels x, y and their places in a plane; where that starts, and the size of all planes."""
    p = tl.arange(0, WIDE * HIGH)
    x, y = tl.program_id(0) * WIDE + p % WIDE, tl.program_id(1) * HIGH + p // WIDE
    size = (width * height).to(tl.int64)
    inside = (x < width) & (y < height)
    return x, y, y * width + x, inside, tl.program_id(2) * size, tl.num_programs(2) * size


@triton.jit
def _blur(pixels, step, at, end, inside):
    """Blur along the axis on which neighbors are a step apart, at a place before its end; zeros beyond the border."""
    total = tl.load(pixels, mask=inside, other=0.0) * _CENTER
    for shift in tl.static_range(1, 6):
        before = tl.load(pixels - step * shift, mask=inside & (at >= shift), other=0.0)
        after = tl.load(pixels + step * shift, mask=inside & (at + shift < end), other=0.0)
        total += (before + after) * (_CENTER * _RATIO ** (shift * shift))
    return total


@triton.jit
def _error(image, target, variance, place, inside, EXPECTED: tl.constexpr):
    """Return the absolute error, or its expectation, its derivatives in image and variance, and both pictures."""
    x, y = tl.load(image + place, mask=inside, other=0.0), tl.load(target + place, mask=inside, other=0.0)
    d = x - y
    if EXPECTED:
        # E = d dE/dd + 2 v dE/dv with z = d / sqrt(2 v): dE/dd = erf(z), dE/dv = exp(-z^2) / sqrt(2 pi v); why so is
        # derived in `ca_reg.functional.expected_losses`.
        v = tl.load(variance + place, mask=inside, other=0.0) + _FLOOR
        scale = 1 / tl.sqrt(2 * v)
        z = d * scale
        by_image, by_variance = tl.erf(z), tl.exp(-z * z) * scale * _ROOT_PI
        error = d * by_image + 2 * v * by_variance
    else:
        by_image, by_variance = tl.where(d > 0, 1.0, tl.where(d < 0, -1.0, 0 * d)), 0 * d
        error = tl.abs(d)
    return error, by_image, by_variance, x, y


@kernel
def blur_images(
    image, target, variance, blurred, width, height,
    EXPECTED: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """Blur x, y, x y and x^2 + y^2 of image x and target y along their rows, (4, C, H, W)."""
    x, _y, place, inside, plane, size = _tile(width, height, WIDE, HIGH)
    mean_x = tl.zeros((WIDE * HIGH,), tl.float32)
    mean_y, mean_xy, mean_squares = tl.zeros_like(mean_x), tl.zeros_like(mean_x), tl.zeros_like(mean_x)
    for i in tl.static_range(11):
        mask = inside & (x + i >= 5) & (x + i < width + 5)
        at = plane + (place + (i - 5))
        p, q = tl.load(image + at, mask=mask, other=0.0), tl.load(target + at, mask=mask, other=0.0)
        squares = p * p + q * q
        if EXPECTED:
            squares += tl.load(variance + at, mask=mask, other=0.0)
        mean_x += p * (_CENTER * _RATIO ** ((i - 5) * (i - 5)))
        mean_y += q * (_CENTER * _RATIO ** ((i - 5) * (i - 5)))
        mean_xy += p * q * (_CENTER * _RATIO ** ((i - 5) * (i - 5)))
        mean_squares += squares * (_CENTER * _RATIO ** ((i - 5) * (i - 5)))
    store3(blurred + plane, place, size, inside, mean_x, mean_y, mean_xy)
    tl.store(blurred + plane + 3 * size + place, mean_squares, mask=inside)


@kernel
def compare_images(
    blurred, image, target, variance, slopes, sums, width, height, of_error, of_ssim,
    EXPECTED: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """Blur along the columns, evaluate SSIM, and add up a program's part of the loss.

    ``slopes`` (3, C, H, W) are the derivatives of SSIM by the blurred x, x^2 + y^2 and x y.
    """
    _x, y, place, inside, plane, size = _tile(width, height, WIDE, HIGH)
    pixels = blurred + plane + place
    mean_x = _blur(pixels, width, y, height, inside)
    mean_y = _blur(pixels + size, width, y, height, inside)
    mean_xy = _blur(pixels + 2 * size, width, y, height, inside)
    mean_squares = _blur(pixels + 3 * size, width, y, height, inside)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    a1, a2 = 2 * product + _C1, 2 * (mean_xy - product) + _C2
    b1, b2 = squares + _C1, mean_squares - squares + _C2
    weight = 1 / (b1 * b2)
    ssim = a1 * a2 * weight
    # The derivatives are derived in `photometric._similarity`.
    to_mean = 2 * weight * (mean_y * (a2 - a1) + ssim * mean_x * (b1 - b2))
    store3(slopes + plane, place, size, inside, to_mean, -weight * ssim * b1, 2 * weight * a1)
    error, _i, _v, _p, _q = _error(image + plane, target + plane, variance + plane, place, inside, EXPECTED)
    loss = tl.sum(tl.where(inside, of_error * error + of_ssim * (1 - ssim), 0.0))
    program = (tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0)
    tl.store(sums + program, loss)


@kernel
def blur_slopes(slopes, blurred, width, height, WIDE: tl.constexpr, HIGH: tl.constexpr):
    """Blur along the rows: the window is symmetric and the padding is zero, so the blur is its own transpose."""
    x, _y, place, inside, plane, size = _tile(width, height, WIDE, HIGH)
    pixels = slopes + plane + place
    to_mean, to_squares = _blur(pixels, 1, x, width, inside), _blur(pixels + size, 1, x, width, inside)
    to_product = _blur(pixels + 2 * size, 1, x, width, inside)
    store3(blurred + plane, place, size, inside, to_mean, to_squares, to_product)


@kernel
def gather_gradients(
    blurred, image, target, variance, upstream, to_image, to_variance, width, height, of_error, of_ssim,
    EXPECTED: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """Blur along the columns, and carry the gradients to the image and its variance."""
    _x, y, place, inside, plane, size = _tile(width, height, WIDE, HIGH)
    pixels = blurred + plane + place
    to_mean = _blur(pixels, width, y, height, inside)
    to_squares = _blur(pixels + size, width, y, height, inside)
    to_product = _blur(pixels + 2 * size, width, y, height, inside)
    _e, by_image, by_variance, p, q = _error(image + plane, target + plane, variance + plane, place, inside, EXPECTED)
    # x itself, x^2 + y^2 (to which the variance was added) and x y were blurred: their derivatives in x are 1, 2 x and
    # y. SSIM enters the loss as 1 - SSIM, hence the minus below.
    in_image = to_mean + 2 * p * to_squares + q * to_product
    given = tl.load(upstream)
    of_error, of_ssim = given * of_error, given * of_ssim
    tl.store(to_image + plane + place, of_error * by_image - of_ssim * in_image, mask=inside)
    if EXPECTED:
        tl.store(to_variance + plane + place, of_error * by_variance - of_ssim * to_squares, mask=inside)


class _Photometric(torch.autograd.Function):
    """The sum over pixels of the absolute error and of 1 - SSIM, each with a weight."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, variance: Tensor | None, weights: tuple[float, float]
    ) -> Tensor:
        planes, height, width = image.shape
        image, target = image.contiguous(), target.contiguous()
        images = image, target, image if variance is None else variance.contiguous()  # read only if there is one
        ctx.grid = -(-width // _WIDE), -(-height // _HIGH), planes
        ctx.constants = {"WIDE": _WIDE, "HIGH": _HIGH, "warps": _WARPS}
        ctx.expected, ctx.weights = variance is not None, weights
        blurred, slopes = image.new_empty(4, *image.shape), image.new_empty(3, *image.shape)
        sums = image.new_empty(math.prod(ctx.grid))
        launch(blur_images, ctx.grid, *images, blurred, width, height, EXPECTED=ctx.expected, **ctx.constants)
        launch(
            compare_images, ctx.grid, blurred, *images, slopes, sums, width, height, *weights,
            EXPECTED=ctx.expected, **ctx.constants,
        )  # fmt: skip
        ctx.save_for_backward(*images, slopes)
        return sums.sum()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *images, slopes = ctx.saved_tensors
        _, height, width = images[0].shape
        blurred, to_image = torch.empty_like(slopes), torch.empty_like(images[0])
        to_variance = torch.empty_like(to_image) if ctx.expected else to_image  # written only if there is one
        launch(blur_slopes, ctx.grid, slopes, blurred, width, height, **ctx.constants)
        launch(
            gather_gradients, ctx.grid, blurred, *images, gradient, to_image, to_variance, width, height, *ctx.weights,
            EXPECTED=ctx.expected, **ctx.constants,
        )  # fmt: skip
        return to_image, None, to_variance if ctx.expected else None, None


def photometric_loss(image: Tensor, target: Tensor, variance: Tensor | None, lambda_dssim: float) -> Tensor:
    """Return L1 + D-SSIM of float32 pictures (C, H, W), in expectation if there is a variance."""
    weights = (1 - lambda_dssim) / image.numel(), lambda_dssim / image.numel()
    loss: Tensor = _Photometric.apply(image, target, variance, weights)  # type: ignore[no-untyped-call]
    return loss
