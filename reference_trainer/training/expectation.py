"""Training on the expectation over dropout and noise: no draws, no sampling noise in the gradient."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from ca_reg import CAPenalty
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import MomentImages, Splats, render_moments, splat
from reference_trainer.training.config import TrainConfig

__all__ = ["ExpectedRender", "multiplier_of", "render_expectation"]


class ExpectedRender(NamedTuple):
    """A view in expectation over the random factors.

    Args:
        image: expected colours, shape (3, H, W).
        variance: of the colours, shape (3, H, W).
        penalty: weighted mean of the variance, a scalar.
        splats: what was drawn, all Gaussians in view; the projected centres keep their gradient.
    """

    image: Tensor
    variance: Tensor
    penalty: Tensor
    splats: Splats


def multiplier_of(config: TrainConfig, opacities: Tensor) -> Multiplier:
    """Return the factor that the configured dropout and noise put on every opacity, shape (N,)."""
    dropout = Multiplier.dropout(config.dropout, compensate=config.compensate)
    if config.noise == 0:
        return dropout
    return dropout * Multiplier.clamped_noise(opacities, config.noise, clip=config.clip_noise)


def render_expectation(
    gaussians: Gaussians, camera: Camera, background: Tensor, config: TrainConfig, *, sh_degree: int
) -> ExpectedRender:
    """Render what training with the configured dropout and noise sees on average, and how it varies.

    Args:
        gaussians: the model.
        camera: the view.
        background: colour behind it, shape (3,).
        config: dropout, noise and the weight of the penalty.
        sh_degree: highest band of spherical harmonics to use.
    """
    opacities = gaussians.opacities
    splats = splat(
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales,
        opacities,
        camera,
        sh=gaussians.sh,
        sh_degree=sh_degree,
    )
    if splats.projection.means.requires_grad:
        splats.projection.means.retain_grad()

    def moments_fn(opacity: Tensor, view: Splats, multiplier: Multiplier, behind: Any) -> MomentImages:
        return render_moments(view, multiplier, background=background, alpha=False)

    ca_penalty = CAPenalty(moments_fn, lambda opacity: multiplier_of(config, opacity), weight=config.ca_weight)
    image, variance, penalty = ca_penalty(opacities, splats)
    return ExpectedRender(image, variance, penalty, splats)
