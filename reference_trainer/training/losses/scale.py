"""A penalty on large Gaussians."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import check_finite
from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Scale"]


class Scale(WeightedTerm):
    """``weight * mean(max(longest axis - limit, 0)^2)`` over the Gaussians.

    Args:
        weight: at least 0, or a schedule. DNGaussian uses 0.001 on LLFF and 0.005 on DTU, per squared world unit.
        limit: standard deviation up to which nothing is penalized, at least 0, world units; DNGaussian has none.

    Raises:
        ValueError: if one is out of range, or ``limit`` not finite.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.001, limit: float = 0.0) -> None:
        super().__init__(weight)
        check_finite(limit, "limit", minimum=0)
        self.limit = limit

    def value(self, step: Step) -> Tensor:
        """Return the mean squared excess."""
        scales = step.params.scales
        assert scales is not None
        return (scales.amax(1) - self.limit).clamp_min(0).square().mean()
