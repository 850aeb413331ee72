"""The test-time counterparts of dropout and of opacity noise."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import Rate, check_finite, check_opacity, check_opacity_range, check_rates, is_zero, rate_like
from ca_reg.functional.multipliers import Multiplier

__all__ = ["expected_opacity", "scale_opacity"]


def scale_opacity(opacity: Tensor, p: Rate) -> Tensor:
    """Scale opacities by ``1 - p``, the mean of dropout at rate ``p`` (paper, strategy C).

    A pixel is linear in the factor of each of its splats, so the image of the scaled opacities *is* the mean image over
    all masks, up to the rasterizer's clamp and cut-off of alpha. Apply it once: to a model trained with uncompensated
    dropout, when it is rendered at test time or exported.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1); returned as they are with ``p = 0``.
        p: the drop rate in training, in [0, 1); a number, or one for each Gaussian, shape (N,).

    Raises:
        TypeError: if ``opacity`` is not a floating-point tensor.
        ValueError: if its shape is neither (N,) nor (N, 1), or ``p`` is outside [0, 1) or not one number per Gaussian.

    Example:
        >>> import torch
        >>> scale_opacity(torch.tensor([0.5, 1.0]), 0.2)
        tensor([0.4000, 0.8000])
    """
    check_opacity(opacity)
    check_rates(p)
    return opacity if is_zero(p) else opacity * (1.0 - rate_like(p, opacity))


def expected_opacity(opacity: Tensor, sigma: float, *, clip: bool = False) -> Tensor:
    """Return the mean of the opacities under clamped noise, the counterpart of :func:`scale_opacity`.

    The mean of :func:`~ca_reg.functional.opacity_noise` is not ``opacity``, because the clamp to [0, 1] cuts the draws
    of opaque Gaussians from above and those of all from below: at ``sigma = 0.8`` an opacity of 1 has the mean 0.72, a
    faint one 1.04 times itself. A pixel is linear in the opacity of each of its splats, so the image of the means *is*
    the mean image over all draws, up to the rasterizer's clamp and cut-off of alpha. The paper renders with
    ``opacity`` itself.

    Apply it once: to a model trained with the noise, when it is rendered at test time or exported. If dropout was used
    as well, ``scale_opacity(expected_opacity(opacity, sigma), p)`` is the mean under both. The other order is not,
    because the factor of the noise depends on the opacity.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1); returned as they are with ``sigma = 0``.
        sigma: standard deviation of the relative noise in training, at least 0.
        clip: whether the draws were clipped to [-sigma, sigma].

    Raises:
        TypeError: if ``opacity`` is not a floating-point tensor or ``sigma`` not a number.
        ValueError: if a shape is neither (N,) nor (N, 1), an opacity is outside [0, 1], or ``sigma`` is negative, not
            finite, or its square overflows.

    Example:
        >>> import torch
        >>> expected_opacity(torch.tensor([0.1, 0.5, 1.0]), 0.8)
        tensor([0.1040, 0.5000, 0.7213])
    """
    check_opacity(opacity)
    check_opacity_range(opacity)
    check_finite(sigma, "sigma", minimum=0.0)
    return opacity if sigma == 0 else opacity * Multiplier.clamped_noise(opacity, sigma, clip=clip).mean
