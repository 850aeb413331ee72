"""A limit to the size of Gaussians, the seventeenth choice: ``--density "benchmarks.limited:LimitedDensity(0.1)"``."""

from __future__ import annotations

import torch

from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.training.density.adaptive import AdaptiveDensity

__all__ = ["LimitedDensity"]


class LimitedDensity(AdaptiveDensity):
    """`AdaptiveDensity` whose Gaussians are no larger than a fraction of their distance to the nearest training camera.

    Before every step each standard deviation above the limit is set to it: no Gaussian has more than ``largest`` focal
    lengths of standard deviation in a training picture.

    Args:
        largest: the fraction, positive.
    """

    def __init__(self, largest: float = 0.1) -> None:
        self.largest = largest

    @torch.no_grad()
    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Do as the base class, and then limit."""
        super().before_step(optimizer, step)
        gaussians = optimizer.gaussians
        cameras = torch.stack([view.camera.position for view in self.scene.train]).to(gaussians.means)
        distances = torch.cdist(gaussians.means, cameras).amin(1, keepdim=True)
        gaussians.log_scales.clamp_(max=(self.largest * distances).log())
