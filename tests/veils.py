"""Models with a veil: opaque Gaussians close before cameras that nobody took."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians

__all__ = ["veiled_at"]


def veiled_at(cameras: Sequence[Camera], gaussians: Gaussians, more: float = 4.0) -> tuple[Gaussians, Gaussians]:
    """Gaussians with one more before each camera, and those alone; all opacity logits are raised by ``more``."""
    veil = gaussians[: len(cameras)]
    veil = replace(
        veil,
        means=torch.stack([camera.position + 0.4 * camera.forward for camera in cameras]),
        log_scales=torch.full_like(veil.log_scales, -2.5),
        opacity_logits=torch.full_like(veil.opacity_logits, 5.0),
    )
    named = dict(veil.named())
    both = Gaussians.from_named({name: torch.cat([x, named[name]]) for name, x in gaussians.named()})
    return replace(both, opacity_logits=both.opacity_logits + more), veil
