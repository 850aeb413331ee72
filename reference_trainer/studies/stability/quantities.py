"""Everything that the package computes from a scene, in a chosen precision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier, apply_dropout, apply_opacity_noise, draw_keep_mask, draw_opacity_noise
from reference_trainer.camera import Camera
from reference_trainer.render import Splats, rasterize, splat
from reference_trainer.render.renderer import render_moments
from reference_trainer.studies.stability.baseline import render_simply
from reference_trainer.studies.stability.scenes import PARAMETERS, StressScene

__all__ = [
    "IMAGES", "RATE", "SCENE_QUANTITIES", "Quantities",
    "independent_images", "loss_weights", "reference_quantities", "scene_quantities", "splats_of",
]  # fmt: skip

Quantities = Mapping[str, Tensor]

_GRADIENTS = tuple(f"d {name}" for name in PARAMETERS)
IMAGES = ("image", "alpha", *_GRADIENTS)
SCENE_QUANTITIES = (*IMAGES, "mean", "variance", "d variance", "CA", "dropout", "noise")

RATE = 0.3
"""Rate of dropout, unless a case sets another."""
_SIGMA, _SEED = 0.5, 7


def scene_quantities(
    scene: StressScene, dtype: torch.dtype, *, rate: float = RATE, sigma: float = _SIGMA, keep: Tensor | None = None
) -> Quantities:
    """Compute image, gradients, exact moments, score, and renders under one draw of dropout and of noise.

    Args:
        scene: what to render; its tensors are converted.
        dtype: the precision of the Gaussians. The pose stays in float64, as a careful caller would keep it.
        rate: of dropout, in the draw, the moments and the score.
        sigma: standard deviation of the opacity noise.
        keep: the dropout mask, shape (N,); drawn by default.

    Returns:
        `SCENE_QUANTITIES`.
    """
    scene = scene.to(dtype, camera=torch.float64)
    n = scene.means.shape[0]
    leaves = _leaves(scene)
    out = rasterize(splats_of(leaves), background=scene.background)
    result = {"image": out.image.detach(), "alpha": out.alpha.detach()}
    result |= _gradients(_loss(out.image, out.alpha, scene.camera), leaves.parameters, _GRADIENTS)

    multiplier = Multiplier.dropout(rate)
    leaves = _leaves(scene)
    moments = render_moments(splats_of(leaves), multiplier, background=scene.background)
    result |= {"mean": moments.mean.detach(), "variance": moments.variance.detach()}
    loss = _loss(moments.variance, moments.alpha_mean, scene.camera)
    result |= _gradients(loss, [leaves.means], ["d variance"])

    def exact(opacity: Tensor, view: None, multiplier: Multiplier, background: Tensor | None) -> object:
        behind = scene.background if background is None else background
        return render_moments(splats_of(replace(scene, opacities=opacity)), multiplier, background=behind)

    score = CAScore(exact=exact, drop_rate=rate, threshold=0.5)(scene.opacities, None)
    result["CA"] = torch.tensor([score.value], dtype=torch.float64)

    if keep is None:
        keep = draw_keep_mask(n, rate, generator=torch.Generator().manual_seed(_SEED))
    noise = draw_opacity_noise(n, sigma, generator=torch.Generator().manual_seed(_SEED))
    drawn = {"dropout": apply_dropout(scene.opacities, keep), "noise": apply_opacity_noise(scene.opacities, noise)}
    for name, opacities in drawn.items():
        result[name] = rasterize(splats_of(replace(scene, opacities=opacities)), background=scene.background).image
    return result


def reference_quantities(scene: StressScene, *, rate: float = RATE) -> Quantities:
    """Compute the same in float64, with image, alpha and gradients by the independent renderer `render_simply`.

    Returns:
        `SCENE_QUANTITIES`. Moments, score and draws are those of the package's renderer in float64.
    """
    return {**scene_quantities(scene, torch.float64, rate=rate), **independent_images(scene)}


def independent_images(scene: StressScene) -> Quantities:
    """Compute `IMAGES` in float64 with `render_simply`; a fourth color channel of ones gives alpha."""
    scene = _leaves(scene.to(torch.float64))
    means, quaternions, scales, opacities, colors = scene.parameters
    columns = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
    sums = render_simply(means, quaternions, scales, opacities, columns, scene.camera)
    image, alpha = sums[:3] + (1 - sums[3]) * scene.background[:, None, None], sums[3]
    result = {"image": image.detach(), "alpha": alpha.detach()}
    return result | _gradients(_loss(image, alpha, scene.camera), scene.parameters, _GRADIENTS)


def loss_weights(camera: Camera) -> Tensor:
    """Return the weights of red, green, blue and alpha in the loss: random, so that nothing cancels by symmetry.

    Returns:
        Multiples of 1/64, exact in every precision, shape (4, H, W), float64.
    """
    generator = torch.Generator().manual_seed(_SEED)
    return torch.randint(-20, 45, (4, camera.height, camera.width), generator=generator).double() / 64


def splats_of(scene: StressScene) -> Splats:
    """Project the Gaussians of a scene."""
    return splat(scene.means, scene.quaternions, scene.scales, scene.opacities, scene.camera, colors=scene.colors)


def _leaves(scene: StressScene) -> StressScene:
    """Return the scene with copies of its parameters that require gradients."""
    return replace(scene, **{name: getattr(scene, name).clone().requires_grad_() for name in PARAMETERS})


def _loss(image: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    weights = loss_weights(camera).to(alpha)
    return (image * weights[:3]).sum() + (alpha * weights[3]).sum()


def _gradients(loss: Tensor, leaves: Sequence[Tensor], names: Sequence[str]) -> dict[str, Tensor]:
    """Return the gradients of a loss by name, 0 for what it does not depend on."""
    if not loss.requires_grad:
        return dict(zip(names, map(torch.zeros_like, leaves), strict=True))
    with torch.autocast("cpu", enabled=False):  # as PyTorch recommends for backward passes
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True)
    return dict(zip(names, gradients, strict=True))
