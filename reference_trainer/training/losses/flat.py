"""A penalty on elongated Gaussians."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import check_finite
from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Flat"]


class Flat(WeightedTerm):
    """``weight * mean(max(longest / shortest axis - limit, 0))`` over the Gaussians: against needles and flakes.

    Args:
        weight: at least 0, or a schedule. DNGaussian uses 0.002 on LLFF and 0.005 on DTU.
        limit: ratio up to which nothing is penalized, at least 1; 1 gives DNGaussian's term but for a constant.

    Raises:
        ValueError: if one is out of range, or ``limit`` not finite.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.002, limit: float = 1.0) -> None:
        super().__init__(weight)
        check_finite(limit, "limit", minimum=1, hint=": 1 is the ratio of a sphere")
        self.limit = limit

    def value(self, step: Step) -> Tensor:
        """Return the mean excess."""
        scales = step.params.scales
        assert scales is not None
        return (scales.amax(1) / scales.amin(1) - self.limit).clamp_min(0).mean()
