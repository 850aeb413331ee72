"""A penalty on needles, a candidate of the ninth choice: ``--loss "photometric + benchmarks.needles:Needles()"``."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Needles"]


class Needles(WeightedTerm):
    """``weight * mean(max(ln(longest / (limit * middle axis)), 0))`` over the Gaussians in front of the step's camera.

    An axis below a pixel counts as a pixel: the renderer shows no less. Flakes, whose two longer axes are alike, are
    left alone.

    Args:
        weight: at least 0, or a schedule.
        limit: ratio up to which nothing is penalized.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.02, limit: float = 5.0) -> None:
        super().__init__(weight)
        self.limit = limit

    def value(self, step: Step) -> Tensor:
        """Return the mean excess."""
        scales, means, camera = step.params.scales, step.params.means, step.view.camera
        assert scales is not None
        assert means is not None
        forward = camera.world_to_camera[2].to(means)
        depths = means.detach() @ forward[:3] + forward[3]
        longest, middle = scales.topk(2).values.unbind(1)
        excess = (longest / (self.limit * torch.maximum(middle, depths / camera.fx))).log().clamp_min(0)
        return torch.where(depths > 0, excess, 0.0).mean()
