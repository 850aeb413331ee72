"""Exact mean and variance of a rendering under random factors on the alphas, and every Gaussian's share of it."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.checks import checked_background
from reference_trainer.render.splats import MomentImages, Splats

__all__ = ["render_moments", "variance_shares"]


def render_moments(splats: Splats, multiplier: Multiplier, *, background: Tensor | None = None) -> MomentImages:
    """Render the exact mean and variance of a view under random factors on the alphas; differentiable.

    The factors are independent per splat. There is no early stop: splats behind an opaque surface shine through its
    dropped ones.

    Args:
        splats: of the full model, with its plain opacities.
        multiplier: moments of the factor, numbers for all Gaussians, or tensors of shape (N,), one value each.
        background: fixed color behind everything, shape (3,), or one for each pixel, (3, H, W); black by default.

    Raises:
        ValueError: if the background has another shape, or is not finite.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> splats = splat(torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 1.0),
        ...                torch.tensor([0.8]), camera, colors=torch.ones(1, 3))
        >>> moments = render_moments(splats, Multiplier.dropout(0.5))
        >>> round(moments.mean[0, 8, 8].item(), 2), round(moments.variance[0, 8, 8].item(), 2)  # 0.5 x 0.8, 0.25 x 0.64
        (0.4, 0.16)
    """
    with torch.autocast(splats.colors.device.type, enabled=False):
        return splats.engine.moments(splats, _factors(multiplier, splats), _background_image(background, splats))


@torch.no_grad()
def variance_shares(
    splats: Splats, multiplier: Multiplier, weights: Tensor, *, background: Tensor | None = None
) -> Tensor:
    """Attribute a weighted sum of the variance over the pixels to the Gaussians; the shares add up to it.

    A Gaussian's share at a pixel is its summand of the variance, `ca_reg.functional.contributions`, mean over RGB.

    The weights have shape (H, W); 1 / count in the region of a score gives shares of that score. Other arguments are
    those of `render_moments`. Returns one share for every projected Gaussian (``splats.indices``), (M,), float64.

    Raises:
        ValueError: if the weights or the background have another shape.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.1, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.tensor([[0.0, 0, 0], [1.0, 1, 1]]))
        >>> shares = variance_shares(splats, Multiplier.dropout(0.5), torch.full((16, 16), 1 / 256))
        >>> variance = render_moments(splats, Multiplier.dropout(0.5)).variance
        >>> torch.allclose(shares.sum(), variance.double().mean())
        True
    """
    shape = (splats.lists.height, splats.lists.width)
    if weights.shape != shape:
        raise ValueError(f"weights must have one value per pixel, shape {shape}, got {tuple(weights.shape)}.")
    with torch.autocast(splats.colors.device.type, enabled=False):
        return splats.engine.shares(
            splats, _factors(multiplier, splats), _background_image(background, splats), weights.to(splats.colors)
        )


def _background_image(background: Tensor | None, splats: Splats) -> Tensor:
    """Return the background of every pixel, (3, H, W)."""
    shape = (3, splats.lists.height, splats.lists.width)
    found = checked_background(background, splats, (3,), shape)
    return (found if found.ndim == 3 else found[:, None, None]).expand(shape)


def _factors(multiplier: Multiplier, splats: Splats) -> Tensor:
    """Return mean and variance of every projected Gaussian's factor, (M, 2)."""
    columns = [
        x[splats.indices].to(splats.opacities) if isinstance(x, Tensor) else torch.full_like(splats.opacities, x)
        for x in (multiplier.mean, multiplier.variance)
    ]
    return torch.stack(columns, dim=1)
