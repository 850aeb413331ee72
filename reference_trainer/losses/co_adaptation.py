"""The exact co-adaptation of the view of a step as a term of the loss."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from ca_reg.functional import Multiplier
from ca_reg.schedules import Schedule
from reference_trainer.losses.term import WeightedTerm

if TYPE_CHECKING:
    from reference_trainer.training.step import Step

__all__ = ["CoAdaptation"]


class CoAdaptation(WeightedTerm):
    """``weight`` times the mean variance of the colours when each Gaussian is dropped with a rate of its own.

    In an analytic step the variance of its expectation is taken, which costs nothing; in others the moments are
    rendered, which takes about as long as the render.

    Args:
        weight: at least 0, or a schedule.
        p: drop rate in [0, 1); in an analytic step the regularizer's own draws count instead.

    Raises:
        ValueError: if one is out of range.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"moments"})
    analytic: ClassVar[bool] = True

    def __init__(self, weight: float | Schedule = 1.0, p: float = 0.5) -> None:
        super().__init__(weight)
        self.multiplier = Multiplier.dropout(p)

    def value(self, step: Step) -> Tensor:
        """Return the mean variance."""
        variance = step.variance
        if variance is None:
            variance = step.moments(step.view.camera, self.multiplier).variance
        return variance.mean()
