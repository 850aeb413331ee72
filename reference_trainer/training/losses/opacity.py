"""A penalty on opacities, or a reward of opaque Gaussians."""

from __future__ import annotations

from torch import Tensor

from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Opacity"]


class Opacity(WeightedTerm):
    """``weight`` times the mean opacity (3DGS-MCMC), or with ``split`` DNGaussian's reward of opaque Gaussians.

    Args:
        weight: at least 0, or a schedule. 3DGS-MCMC uses 0.01 for the mean, DNGaussian 0.001 for its reward.
        split: in (0, 1): the value is ``1 - mean(o^2 | o > split) + mean((1 - o)^2 | o < split)``, as in DNGaussian's
            code with 0.2; an empty part counts 0.

    Raises:
        ValueError: if one is out of range.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.01, split: float | None = None) -> None:
        super().__init__(weight)
        if split is not None and not 0 < split < 1:
            raise ValueError(f"split must be in (0, 1), got {split}.")
        self.split = split

    def value(self, step: Step) -> Tensor:
        """Return the mean, or one minus the reward."""
        opacities = step.params.opacities
        if self.split is None:
            return opacities.mean()
        above, below = opacities > self.split, opacities < self.split
        reward = (opacities.square() * above).sum() / above.sum().clamp_min(1)
        return 1 - reward + ((1 - opacities).square() * below).sum() / below.sum().clamp_min(1)
