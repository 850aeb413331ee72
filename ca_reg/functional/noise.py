"""Opacity noise: in each training step every opacity is multiplied by its own random factor around 1."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg._check import Rate, check_count, check_opacity, check_per_gaussian, check_sigma, is_zero
from ca_reg._random import draw_numbers

__all__ = ["apply_opacity_noise", "draw_opacity_noise", "opacity_noise"]


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

    Raises:
        TypeError: if ``n`` is not an integer or ``sigma`` not a number.
        ValueError: if ``n`` or ``sigma`` is negative, or ``sigma`` above 1e30.
        RuntimeError: if the draw with a generator is repeated during ``backward()``.

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

    Where the clamp acts, the gradient is 0. It removes some of the upward noise of opacities near 1, which lowers their
    mean.

    Args:
        opacity: activated opacities in [0, 1], shape (N,) or (N, 1); the result has the same shape and dtype.
        noise: relative noise, shape (N,).

    Raises:
        TypeError: if an argument is not a tensor, or ``opacity`` is not floating point.
        ValueError: if the shapes are not as above.

    Example:
        >>> apply_opacity_noise(torch.tensor([0.5, 0.5, 0.5]), torch.tensor([0.2, -1.5, 3.0]))
        tensor([0.6000, 0.0000, 1.0000])
    """
    check_opacity(opacity)
    check_per_gaussian(noise, opacity, "noise")
    # Computed in the wider of the two dtypes and rounded once: in bfloat16, 1 + noise would have 8 bits.
    noisy = opacity * (1.0 + noise.view_as(opacity))
    # Not clamp, whose gradient at the bounds is 1 in torch 2.13 and 0 in torch 2.15.
    return noisy.masked_fill(noisy < 0.0, 0.0).masked_fill(noisy > 1.0, 1.0).to(opacity.dtype)


def opacity_noise(
    opacity: Tensor, sigma: Rate, *, clip: bool = False, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor | None]:
    """Draw noise and apply it: :func:`draw_opacity_noise`, then :func:`apply_opacity_noise`.

    Arguments and errors are theirs; the paper tunes ``sigma`` in [0.05, 0.8]. Returns the noisy opacities in [0, 1] and
    the noise of shape (N,). With ``sigma = 0`` nothing is drawn: returns the very same ``opacity`` and None.

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
