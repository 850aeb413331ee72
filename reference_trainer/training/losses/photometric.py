"""The photometric loss, L1 + D-SSIM, of one or several views; optimized for being called at every step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ca_reg._check import check_count
from ca_reg.functional import expected_absolute_error
from ca_reg.schedules import Schedule
from reference_trainer.render.engine import engine_for
from reference_trainer.training.losses._ssim_constants import C1, C2, WEIGHTS
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Photometric", "Views", "check_lambda", "expected_photometric_loss", "photometric_loss", "ssim_map"]


class Photometric(WeightedTerm):
    """The loss of 3D Gaussian Splatting against the photograph, `photometric_loss`; in expectation if analytic.

    Args:
        lambda_dssim: weight of the structural term, in [0, 1].
        weight: of the whole, at least 0, or a schedule.
    """

    analytic = True

    def __init__(self, lambda_dssim: float = 0.2, *, weight: float | Schedule = 1.0) -> None:
        super().__init__(weight)
        check_lambda(lambda_dssim)
        self.lambda_dssim = lambda_dssim

    def value(self, step: Step) -> Tensor:
        """Compare the render of the step with its photograph."""
        return _loss(step.image, step.view.image, step.variance, self.lambda_dssim)


def photometric_loss(image: Tensor, target: Tensor, lambda_dssim: float = 0.2) -> Tensor:
    """Return ``(1 - lambda) mean|image - target| + lambda (1 - SSIM)``, the loss of Kerbl et al. 2023, equation 7.

    The rendering, whose colors may lie outside [0, 1], and the photograph, a constant, are (3, H, W), of one
    floating-point dtype; the scalar is differentiable (once) in the rendering. Raises ValueError if the images
    disagree, ``target`` requires a gradient or ``lambda_dssim`` lies outside [0, 1].

    Example:
        >>> image = torch.full((3, 16, 16), 0.5, requires_grad=True)
        >>> loss = photometric_loss(image, torch.full((3, 16, 16), 0.7), lambda_dssim=0.0)
        >>> round(loss.item(), 6)
        0.2
        >>> loss.backward()
        >>> image.grad.shape
        torch.Size([3, 16, 16])
    """
    return _loss(image, target, None, lambda_dssim)


def expected_photometric_loss(mean: Tensor, variance: Tensor, target: Tensor, lambda_dssim: float = 0.2) -> Tensor:
    """Return, approximately, the mean of `photometric_loss` over random images of this mean and variance.

    The absolute error is that of normal pixels (`ca_reg.functional.expected_absolute_error`). In SSIM every local
    moment is replaced by its expectation; all variance counts as contrast within the window and none as variance of the
    window's mean, which holds where splats are smaller than the window.

    Arguments and errors are those of `photometric_loss`; the variance (3, H, W) is at least 0. Differentiable (once) in
    mean and variance; for variance 0 it is `photometric_loss`, but for the rounding error that the photograph is
    assumed to have.

    Example:
        >>> mean, target = torch.full((3, 16, 16), 0.5), torch.full((3, 16, 16), 0.7)
        >>> losses = [expected_photometric_loss(mean, mean * v, target).item() for v in (0.0, 0.1)]
        >>> losses[0] < losses[1]
        True
    """
    return _loss(mean, target, variance, lambda_dssim)


def ssim_map(image: Tensor, target: Tensor, variance: Tensor | None = None) -> Tensor:
    """Return the SSIM of every pixel and channel: 11 x 11 Gaussian window, sigma 1.5, zeros beyond the border.

    The same quantity as `reference_trainer.evaluation.metrics.ssim` before its mean, reimplemented because forward and
    backward take a third of the time of ``kornia.metrics.ssim`` (one CPU thread, 252 x 189 and 504 x 378). In float32 a
    value errs by up to about 1e-3 in flat bright areas: for reports, take the float64 metric.

    Images and errors are those of `photometric_loss`; ``variance`` is that of a random image whose mean is ``image``,
    and is added to the variance within the window. Similarities are in [-1, 1] up to rounding, (C, H, W),
    differentiable (once) in ``image`` and ``variance``.

    Example:
        >>> image = torch.rand(3, 20, 30, dtype=torch.float64)
        >>> bool(torch.allclose(ssim_map(image, image), torch.ones_like(image)))
        True
    """
    _check_pair(image, target, variance)
    similarity: Tensor = _SSIMMap.apply(image, target, variance)  # type: ignore[no-untyped-call]
    return similarity


def _loss(image: Tensor, target: Tensor, variance: Tensor | None, lambda_dssim: float) -> Tensor:
    """Mix the error with the structural term, which is not computed if its weight is 0."""
    check_lambda(lambda_dssim)
    _check_pair(image, target, variance)
    if lambda_dssim != 0 and engine_for(image.device, image.dtype).name == "triton":
        from reference_trainer.training.losses import _ssim_triton

        return _ssim_triton.photometric_loss(image, target, variance, lambda_dssim)
    if variance is None:
        error = torch.nn.functional.l1_loss(image, target)
    else:
        error = expected_absolute_error(image, variance, target).mean()
    if lambda_dssim == 0:
        return error
    return error * (1 - lambda_dssim) + (1 - ssim_map(image, target, variance).mean()) * lambda_dssim


def _check_pair(image: Tensor, target: Tensor, variance: Tensor | None) -> None:
    """Raise unless a picture can be compared with a photograph."""
    if image.ndim != 3 or image.shape != target.shape:
        raise ValueError(
            f"image and target must share one shape (C, H, W), got {tuple(image.shape)} and {tuple(target.shape)}."
        )
    if image.dtype != target.dtype or image.device != target.device or not image.is_floating_point():
        raise ValueError(
            "image and target must share one floating-point dtype and one device, got "
            f"{image.dtype} on {image.device} and {target.dtype} on {target.device}."
        )
    if variance is not None and (variance.shape, variance.dtype, variance.device) != (
        image.shape,
        image.dtype,
        image.device,
    ):
        raise ValueError(
            f"the variance must have shape, dtype and device of its image, {tuple(image.shape)}, {image.dtype} and "
            f"{image.device}, got {tuple(variance.shape)}, {variance.dtype} and {variance.device}."
        )
    if target.requires_grad:
        raise ValueError("target is a constant here, but it requires a gradient: pass target.detach().")


def check_lambda(lambda_dssim: float) -> None:
    """Raise unless it is a weight in [0, 1]."""
    if not 0 <= lambda_dssim <= 1:
        raise ValueError(f"lambda_dssim must lie in [0, 1], got {lambda_dssim}.")


class _SSIMMap(torch.autograd.Function):
    """SSIM with hand-derived gradients with respect to image and variance."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, variance: Tensor | None) -> Tensor:
        # Only the sum of the two variances enters, so four maps are blurred and not five.
        maps = image.new_empty(4, *image.shape)
        maps[0], maps[1] = image, target
        torch.mul(image, target, out=maps[2])
        torch.mul(image, image, out=maps[3]).addcmul_(target, target)
        if variance is not None:
            maps[3] += variance
        similarity, slopes = _similarity(_blur(maps))
        ctx.save_for_backward(image, target, slopes)
        return similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, Tensor | None]:
        image, target, slopes = ctx.saved_tensors
        # The window is symmetric and the padding is zero, so the blur is its own transpose.
        # Blurred slopes are the gradients of the maps x, x^2 + y^2 and x y (and of the variance, which was added to the
        # second): d(x^2 + y^2)/dx = 2 x, d(x y)/dx = y.
        mean, squares, product = _blur(slopes * gradient)
        to_image = mean.addcmul_(image, squares, value=2).addcmul_(target, product)
        return to_image, None, squares if ctx.needs_input_grad[2] else None


def _similarity(blurred: Tensor) -> tuple[Tensor, Tensor]:
    """Return SSIM = a1 a2 / (b1 b2), and its derivatives with respect to the blurred x, x^2 + y^2 and x y.

    ``blurred`` holds x, y, x y and x^2 + y^2, (4, C, H, W).
    """
    if engine_for(blurred.device, blurred.dtype).name == "numba":
        from reference_trainer.training.losses._ssim_numba import similarity

        return similarity(blurred)
    mean_x, mean_y, mean_xy, mean_squares = blurred
    product, squares = mean_x * mean_y, torch.addcmul(mean_x * mean_x, mean_y, mean_y)
    a1, a2 = 2 * product + C1, (mean_xy - product).mul_(2).add_(C2)
    b1, b2 = squares + C1, (mean_squares - squares).add_(C2)
    weight = 1 / (b1 * b2)
    result = a1 * a2 * weight
    # In the blurred x, a1 grows by 2 y and a2 shrinks by it, b1 grows by 2 x and b2 shrinks by it: w 2 y (a2 - a1) from
    # the numerator, SSIM (2 x / b2 - 2 x / b1) = w SSIM 2 x (b1 - b2) from the denominator, w the weight. The blurred
    # x^2 + y^2 stands in b2 alone, -SSIM / b2 = -w SSIM b1, and x y, twice, in a2: 2 a1 w.
    to_mean = 2 * weight * (mean_y * (a2 - a1) + result * mean_x * (b1 - b2))
    return result, torch.stack([to_mean, -weight * result * b1, 2 * weight * a1])


def _blur(maps: Tensor) -> Tensor:
    """Blur maps (..., H, W) with the zero-padded window."""
    if engine_for(maps.device, maps.dtype).name == "numba":
        from reference_trainer.training.losses._ssim_numba import blur

        return blur(maps)
    # Sums of shifted slices: on a CPU faster than a depthwise convolution, whose speed depends on the memory layout.
    center, *sides = WEIGHTS
    for axis in (-2, -1):
        size = maps.shape[axis]
        blurred = maps * center
        for offset, weight in enumerate(sides[: size - 1], start=1):
            length = size - offset
            blurred.narrow(axis, offset, length).add_(maps.narrow(axis, 0, length), alpha=weight)
            blurred.narrow(axis, 0, length).add_(maps.narrow(axis, offset, length), alpha=weight)
        maps = blurred
    return maps


class Views(WeightedTerm):
    """``weight`` times the sum of the photometric losses of n - 1 further training views (MVGS, 2024).

    Each is rendered like the view of the step, with its own draw of the regularizers, and counted by density control
    (the source counts the last one alone). ``photometric + views(3)`` makes three views a step.

    Args:
        n: views in a step, including the step's own, at least 2; all, if there are fewer training views.
        weight: at least 0, or a schedule.
        lambda_dssim: of `photometric_loss`.
    """

    analytic = True

    def __init__(self, n: int = 3, weight: float | Schedule = 1.0, lambda_dssim: float = 0.2) -> None:
        super().__init__(weight)
        check_count(n, "n", minimum=2, hint=": one view is what photometric has")
        self.n, self.photometric = n, Photometric(lambda_dssim)

    def value(self, step: Step) -> Tensor:
        """Render the views and compare each with its photograph."""
        others = [view for view in step.views if view.name != step.view.name]
        generator = step.generator("views")
        order = torch.randperm(len(others), generator=generator, device=generator.device)[: self.n - 1]
        losses = [self.photometric(step.at(others[i])) for i in order.tolist()]
        return sum(losses, start=step.image.new_zeros(()))
