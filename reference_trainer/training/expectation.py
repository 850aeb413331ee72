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

__all__ = ["ExpectedRender", "expected_draw", "render_expectation"]


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


def expected_draw(config: TrainConfig, opacities: Tensor) -> tuple[Tensor, Multiplier]:
    """Return the opacities to render, and the random factor on the alphas, that are the configured draws together.

    After compensated dropout the rasterizer gets ``o / (1 - p)`` of the survivors and clamps their alphas at 0.99; the
    factor of that is the one of plain dropout. The noise acts on ``o / (1 - p)`` too, and leaves at most 1.

    Dropout of either kind is exact. With noise the renderer's clamp of the noisy alphas is left out, which moves a
    colour by at most 1/99 of the range of the colours, see `Multiplier.clamped_noise`.

    Args:
        config: dropout and noise.
        opacities: activated, shape (N,).

    Returns:
        Opacities, shape (N,), above 1 where those of survivors are, and the factor.
    """
    gain = 1 / (1 - config.dropout) if config.compensate else 1.0
    dropout, survivors = Multiplier.dropout(config.dropout), opacities * gain
    if config.noise == 0:
        return survivors, dropout
    noise = Multiplier.clamped_noise(opacities, config.noise, clip=config.clip_noise, gain=gain)
    return survivors.clamp(max=1), dropout * noise


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
    opacities, multiplier = expected_draw(config, gaussians.opacities)
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
        return render_moments(view, multiplier, background=background)

    ca_penalty = CAPenalty(moments_fn, multiplier, weight=config.ca_weight)
    image, variance, penalty = ca_penalty(opacities, splats)
    return ExpectedRender(image, variance, penalty, splats)
