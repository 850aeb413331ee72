"""Dropout and noise on opacities, and what is rendered at test time in their place."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ca_reg._check import (
    Rate,
    check_count,
    check_factor,
    check_finite,
    check_floating,
    check_opacity,
    check_opacity_range,
    check_per_gaussian,
    check_rates,
    check_sigma,
    is_zero,
    kept_share,
)
from ca_reg._random import draw_numbers
from ca_reg.functional.multipliers import Multiplier

__all__ = [
    "apply_dropout", "apply_opacity_noise", "decayed_logits", "draw_keep_mask", "draw_opacity_noise",
    "expected_opacity", "gaussian_dropout", "opacity_noise", "scale_opacity",
]  # fmt: skip

FAINTEST = -16.0
"""The smallest logit that decay leaves, of an opacity of 1e-7."""


def draw_keep_mask(
    n: int, p: Rate, *, generator: torch.Generator | None = None, device: torch.device | str | None = None
) -> Tensor:
    """Draw which Gaussians stay: each one independently with probability ``1 - p``.

    The uniform numbers behind the mask are float32 whatever the opacities are, so float32 and float64 runs with equal
    seeds drop the same Gaussians.

    Args:
        n: number of Gaussians.
        p: drop rate in [0, 1); a number, or one for each Gaussian, shape (n,).
        generator: source of the draw, on whose device the numbers are drawn: a CPU generator gives the same mask on
            every device. The global random state is then untouched.
        device: device of the returned mask; by default where it was drawn.

    Returns:
        True where the Gaussian stays, shape (n,), bool.

    Raises:
        RuntimeError: if a draw with a generator is repeated by ``torch.utils.checkpoint``; draw outside it.

    Example:
        >>> keep = draw_keep_mask(1000, 0.2, generator=torch.Generator().manual_seed(0))
        >>> keep.dtype, 750 < keep.sum() < 850
        (torch.bool, tensor(True))
    """
    check_rates(p)
    return keep_mask(n, p, generator=generator, device=device)


def keep_mask(
    n: int, p: Rate, *, generator: torch.Generator | None = None, device: torch.device | str | None = None
) -> Tensor:
    """Draw as :func:`draw_keep_mask`, at rates that are known to be in [0, 1): reading them would wait for a card."""
    check_count(n, "n", minimum=0)
    uniform = draw_numbers(torch.rand, n, generator, device)
    if isinstance(p, Tensor) and p.ndim:
        check_per_gaussian(p, uniform, "p")
        p = p.to(uniform.device)
    return uniform >= p


def apply_dropout(opacity: Tensor, keep: Tensor, *, p: Rate = 0.0, compensate: bool = False) -> Tensor:
    """Set the opacities of dropped Gaussians to zero (paper, Eq. dropout_train).

    A dropped Gaussian gets an opacity and a gradient of exactly zero. The rasterizer may still report a radius for it:
    zero that as well (``radii * keep``) before density control sees it, or fewer Gaussians are densified.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
        keep: True where the Gaussian stays, shape (N,), bool.
        p: the rate or rates that ``keep`` was drawn with; used only by ``compensate``.
        compensate: multiply the survivors by ``1 / (1 - p)``, so that the mean over masks is ``opacity`` and nothing
            needs to be scaled at test time. They may then exceed 1; rasterizers clamp them, at 0.99 or 0.999, which
            lowers the mean alpha.

    Returns:
        The masked opacities, a new tensor of the same shape and dtype.

    Example:
        >>> opacity, keep = torch.tensor([0.5, 0.8]), torch.tensor([True, False])
        >>> apply_dropout(opacity, keep)
        tensor([0.5000, 0.0000])
        >>> apply_dropout(opacity, keep, p=0.2, compensate=True)
        tensor([0.6250, 0.0000])
    """
    check_opacity(opacity)
    check_per_gaussian(keep, opacity, "keep")
    check_rates(p)
    if keep.dtype != torch.bool:
        raise TypeError(f"keep must be a bool tensor, got {keep.dtype}; compare with a threshold to get a mask.")
    # Not a product: 0 * inf and 0 * nan would put nan where Gaussians are dropped, forward and backward.
    masked = opacity.masked_fill(~keep.view_as(opacity), 0.0)
    return compensated(masked, p) if compensate else masked


def compensated(opacity: Tensor, p: Rate) -> Tensor:
    """Multiply survivors by ``1 / (1 - p)``, at rates that are known to be in [0, 1): reading them waits for a card."""
    # Rounded last: in 16 bits a rate near 1 is 1, and dropped Gaussians would have 0 times infinity.
    return (opacity * (1.0 / kept_share(p, opacity))).to(opacity.dtype)


def gaussian_dropout(
    opacity: Tensor, p: Rate, *, compensate: bool = False, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor | None]:
    """Draw a mask and apply it: :func:`draw_keep_mask`, then :func:`apply_dropout`.

    Returns the masked opacities and the mask of shape (N,); with ``p = 0``, where nothing is drawn, the very same
    ``opacity`` and None.

    Example:
        >>> opacity, keep = gaussian_dropout(torch.full((4, 1), 0.5), 0.2)
        >>> opacity.shape, keep.shape
        (torch.Size([4, 1]), torch.Size([4]))
    """
    check_opacity(opacity)
    check_rates(p)
    if is_zero(p):
        return opacity, None
    keep = draw_keep_mask(opacity.shape[0], p, generator=generator, device=opacity.device)
    return apply_dropout(opacity, keep, p=p, compensate=compensate), keep


def draw_opacity_noise(
    n: int,
    sigma: Rate,
    *,
    clip: bool = False,
    generator: torch.Generator | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Draw one normal number of standard deviation ``sigma`` per Gaussian.

    Args:
        n: number of Gaussians.
        sigma: standard deviation, from 0 to 1e30.
        clip: clip the draw to [-sigma, sigma], as the authors' released code does but the paper does not mention. The
            variance is then 0.516 sigma^2.
        generator: source of the draw, with the limits of :func:`~ca_reg.functional.draw_keep_mask`.
        device: device of the returned noise; by default where it was drawn.

    Returns:
        The relative noise, shape (n,), float32 whatever the opacities are.

    Example:
        >>> noise = draw_opacity_noise(1000, 0.8, clip=True)
        >>> noise.shape, noise.abs().max() <= 0.8
        (torch.Size([1000]), tensor(True))
    """
    check_count(n, "n", minimum=0)
    check_sigma(sigma)
    noise = draw_numbers(torch.randn, n, generator, device)
    return (noise.clamp(-1.0, 1.0) if clip else noise) * sigma


def apply_opacity_noise(opacity: Tensor, noise: Tensor) -> Tensor:
    """Return ``opacity * (1 + noise)``, clamped to [0, 1] (paper, opacity noise injection).

    Where the clamp acts, the gradient is 0. The clamp lowers the mean of opacities near 1.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1); the result has the same shape and dtype.
        noise: relative noise, shape (N,).

    Example:
        >>> apply_opacity_noise(torch.tensor([0.5, 0.5, 0.5]), torch.tensor([0.2, -1.5, 3.0]))
        tensor([0.6000, 0.0000, 1.0000])
    """
    check_opacity(opacity)
    check_per_gaussian(noise, opacity, "noise")
    check_floating(noise, "noise")
    # Computed in the wider of the two dtypes and rounded once: in bfloat16, 1 + noise would have 8 bits.
    noisy = opacity * (1.0 + noise.view_as(opacity))
    # Not clamp, whose gradient at the bounds is 1 in torch 2.13 and 0 in torch 2.15.
    return noisy.masked_fill(noisy < 0.0, 0.0).masked_fill(noisy > 1.0, 1.0).to(opacity.dtype)


def opacity_noise(
    opacity: Tensor, sigma: Rate, *, clip: bool = False, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor | None]:
    """Draw noise and apply it: :func:`draw_opacity_noise`, then :func:`apply_opacity_noise`.

    The paper tunes ``sigma`` in [0.05, 0.8]. Returns the noisy opacities in [0, 1] and the noise of shape (N,); with
    ``sigma = 0``, where nothing is drawn, the very same ``opacity`` and None.

    Example:
        >>> noisy, noise = opacity_noise(torch.full((4,), 0.5), 0.1)
        >>> torch.equal(noisy, apply_opacity_noise(torch.full((4,), 0.5), noise))
        True
    """
    check_opacity(opacity)
    check_sigma(sigma)
    if is_zero(sigma):
        return opacity, None
    noise = draw_opacity_noise(opacity.shape[0], sigma, clip=clip, generator=generator, device=opacity.device)
    return apply_opacity_noise(opacity, noise), noise


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
    return opacity if is_zero(p) else (opacity * kept_share(p, opacity)).to(opacity.dtype)


def expected_opacity(opacity: Tensor, sigma: float, *, clip: bool = False) -> Tensor:
    """Return the mean of the opacities under clamped noise, the counterpart of :func:`scale_opacity`.

    The clamp to [0, 1] cuts off high draws of opaque Gaussians and low draws of all: at ``sigma = 0.8`` an opacity of 1
    has the mean 0.72, a faint one 1.04 times itself. As with :func:`scale_opacity`, the image of the means *is* the
    mean image, up to the rasterizer's clamp and cut-off of alpha. The paper renders with ``opacity`` itself.

    Apply it once: to a model trained with the noise, when it is rendered at test time or exported. If dropout was used
    as well, take ``scale_opacity(expected_opacity(opacity, sigma), p)``; the other order is not the mean under both.

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


def decayed_logits(logits: Tensor, factor: float) -> Tensor:
    """Return the logits of opacities that are multiplied by a factor, ``logit(factor * sigmoid(logits))``.

    Args:
        logits: the trained parameter whose sigmoid is the opacity, of any shape.
        factor: in (0, 1].

    Returns:
        A new tensor. What has faded to a logit of -16, an opacity of 1e-7, stays there, or it would be exactly 0 later.

    Raises:
        TypeError: if the logits are no floating-point tensor, or of bfloat16, whose spacing swallows a factor of 0.995,
            or the factor is no number.
        ValueError: if the factor is outside (0, 1].

    Example:
        >>> decayed_logits(torch.tensor([0.0, 3.0]), 0.5).sigmoid()
        tensor([0.2500, 0.4763])
    """
    check_floating(logits, "logits", "give the parameter whose sigmoid is the opacity")
    if logits.dtype == torch.bfloat16:
        raise TypeError("bfloat16 is too coarse for opacities that decay: keep the trained logits in float32.")
    check_factor(factor)
    if factor == 1:
        return logits.clone()
    # f s / (1 - f s) = f / ((1 - f) + e^-x) for s = sigmoid(x): neither overflows nor cancels.
    rest = logits.new_full((), math.log1p(-factor))
    return (math.log(factor) - torch.logaddexp(rest, -logits)).clamp(min=FAINTEST)
