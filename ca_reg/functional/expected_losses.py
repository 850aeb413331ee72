"""Expected pixel losses over the random factors, from the mean and the variance of the pixel alone.

Training with sampled dropout or noise minimizes an expected loss through single draws, whose noise is in every
gradient. From the exact moments of a pixel (:func:`~ca_reg.functional.pixel_moments`) follows the expectation itself:
exactly for the squared error, for the absolute error insofar as the pixel is normally distributed.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ca_reg._check import check_finite, check_floating

__all__ = ["expected_absolute_error", "expected_squared_error"]

# Standard deviation of what rounding to 8 bits adds to a photograph: uniform over one of 255 steps.
ROUNDING = 1.0 / (255.0 * math.sqrt(12.0))

# Beyond this erf(x) rounds to 1 and exp(-x^2) is negligible; further out it is subnormal, which is slow to compute.
_FAR = 9.0


def expected_squared_error(mean: Tensor, variance: Tensor, target: Tensor) -> Tensor:
    """Return ``E (x - t)^2 = (mean - t)^2 + variance``, pixel by pixel.

    Exact for every distribution of ``x``. Its average is what dropout training minimizes when the loss is the mean
    squared error. All arguments are floating-point tensors of one shape; the variance is at least 0.

    Example:
        One splat of alpha 0.8, white over black, is kept in half of the draws, so a pixel is 0 or 0.8:

        >>> mean, variance, target = torch.tensor([0.4]), torch.tensor([0.16]), torch.tensor([0.7])
        >>> expected_squared_error(mean, variance, target)  # (0.7^2 + 0.1^2) / 2
        tensor([0.2500])
    """
    _check(mean, variance, target)
    return (mean - target).square() + variance


def expected_absolute_error(mean: Tensor, variance: Tensor, target: Tensor, *, min_std: float = ROUNDING) -> Tensor:
    """Return ``E |x - t|`` for a normal ``x``, pixel by pixel: the mean of the folded normal distribution.

    With ``d = mean - t``, ``s^2 = variance + min_std^2``, and phi the density of the standard normal distribution,

        E = s sqrt(2 / pi) exp(-d^2 / (2 s^2)) + d erf(d / (s sqrt(2)))
        dE/dd = erf(d / (s sqrt(2))),        dE/dvariance = phi(d / s) / s

    An approximation, because few splats make up a pixel, and their sum is not normal. Against the enumeration of all
    masks of random lists of 8 splats with alphas up to 0.99, under dropout of 0.2, it is off by

    ======================================= ================= =================
    standard deviation of ``d``             0.05              0.2
    ======================================= ================= =================
    pixel by pixel, mean relative error     17 %              8 %
    sum over all pixels                     +6 %              +0.5 %
    sum of ``|d|`` instead, for comparison  -51 %             -11 %
    ======================================= ================= =================

    and in single pixels by up to a factor of 3. Like the exact value, it is never below ``|d|``, the error of the mean,
    nor above ``sqrt(d^2 + s^2)``.

    ``min_std`` bounds the gradient in the variance, ``1 / (s sqrt(2 pi))`` at ``d = 0``. The default is the rounding of
    a photograph to 8 bits, 0.29 / 255; it adds at most 0.23 / 255 to the result.

    Args:
        mean: expected value of ``x``, any shape, float32 or float64.
        variance: its variance, at least 0, same shape. Not checked, which would synchronize the GPU.
        target: ``t``, same shape.
        min_std: smallest standard deviation, above 0, in the units of ``x``; its square must not underflow.

    Example:
        The splat of :func:`expected_squared_error`. The exact value is (0.7 + 0.1) / 2 = 0.4:

        >>> mean, variance, target = torch.tensor([0.4]), torch.tensor([0.16]), torch.tensor([0.7])
        >>> expected_absolute_error(mean, variance, target)
        tensor([0.4049])
    """
    _check(mean, variance, target)
    check_finite(min_std, "min_std")
    floor = min_std * min_std
    if min_std <= 0 or floor < torch.finfo(variance.dtype).tiny:
        raise ValueError(
            f"min_std must be above 0 and its square must not underflow in {variance.dtype}, got {min_std}; "
            "it keeps the gradient finite where the variance is 0."
        )
    error: Tensor = _ExpectedAbsoluteError.apply(mean - target, variance + floor)[0]  # type: ignore[no-untyped-call]
    return error


class _ExpectedAbsoluteError(torch.autograd.Function):
    """``E |x|`` for a normal x of mean d and variance v, from its derivatives: ``E = d dE/dd + 2 v dE/dv``."""

    generate_vmap_rule = True

    @staticmethod
    def forward(d: Tensor, variance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        by_mean, by_variance = _slopes(d, variance)
        return d * by_mean + 2.0 * variance * by_variance, by_mean, by_variance

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        d, variance, *slopes = ctx.saved_tensors
        by_mean, by_variance = _slopes(d, variance) if torch.is_grad_enabled() else slopes  # to be differentiated again
        return gradient * by_mean, gradient * by_variance


def _slopes(d: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivatives of ``E |x|`` in mean and variance of a normal x."""
    # For a normal x, d/dd E f(x) = E f'(x) and d/dv E f(x) = E f''(x) / 2. With f = |x|, f' is the sign of x and f''
    # twice a delta at 0, so that with z = d / sqrt(2 v)
    #     dE/dd = P(x > 0) - P(x < 0) = erf(z),        dE/dv = the density of x at 0 = exp(-z^2) / sqrt(2 pi v).
    # E doubles where d and sqrt(v) double, so Euler's theorem gives E itself, d dE/dd + 2 v dE/dv.
    scale = (2.0 * variance).rsqrt()
    z = (d * scale).clamp(-_FAR, _FAR)  # which keeps 0 * inf out of second derivatives
    density = torch.nn.functional.threshold((-z.square()).exp(), 2.0 * math.exp(-_FAR * _FAR), 0.0)
    return z.erf(), density * (scale / math.sqrt(math.pi))


def _check(mean: Tensor, variance: Tensor, target: Tensor) -> None:
    """Raise unless all three are floating-point tensors of one shape."""
    for name, x in (("mean", mean), ("variance", variance), ("target", target)):
        check_floating(x, name, cast="scale images to [0, 1]")
        if x.shape != mean.shape:
            raise ValueError(f"{name} must have the shape of mean, {tuple(mean.shape)}, got {tuple(x.shape)}.")
