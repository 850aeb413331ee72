"""The photometric loss with the error of one render and the gradients of another: what it is in dropout that helps."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from ca_reg.schedules import Schedule
from reference_trainer.training.losses.photometric import check_lambda, photometric_loss
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["StraightThrough"]


class StraightThrough(WeightedTerm):
    """`photometric_loss` whose value is that of one render and whose gradients flow through another; an experiment.

    In place of ``photometric``, beside a dropout. A step of dropout takes two things from its dropped render: the
    error, and the derivatives, in which Gaussians behind a dropped one count for more. Each can be had without the
    other. ``"full"``: the error of the full render, the derivatives of the dropped one, so that hidden Gaussians learn
    as with dropout. What is then missing, for a squared error, is the gradient of the variance over masks, which is
    what the co-adaptation score measures: ``2 E[J'(I - T)] = 2 E[J]'(E[I] - T) + d sum(var I)`` for renders I,
    derivatives J and the photograph T. ``"dropped"``: the error of the dropped render, the derivatives of the full one.

    Density control counts the render through which the gradients flow. The full render is that of the step's parameters
    before any regularizer; a dropout should therefore be compensated, so that both renders have about the same mean.

    Args:
        error: the render whose error is taken, ``"full"`` or ``"dropped"``.
        lambda_dssim: weight of the structural term, in [0, 1].
        weight: of the whole, at least 0, or a schedule.

    Raises:
        ValueError: if one is none of these.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> (term,) = LOSSES.make("straight_through('full')")
        >>> term.error
        'full'
    """

    def __init__(
        self,
        error: Literal["full", "dropped"] = "full",
        lambda_dssim: float = 0.2,
        *,
        weight: float | Schedule = 1.0,
    ) -> None:
        super().__init__(weight)
        if error not in ("full", "dropped"):
            raise ValueError(f"error must be full or dropped, got {error!r}.")
        check_lambda(lambda_dssim)
        self.error, self.lambda_dssim = error, lambda_dssim

    def value(self, step: Step) -> Tensor:
        """Compare one render of the step's view with its photograph, and send the gradients through the other."""
        full = step.render(step.view.camera, observed=self.error == "dropped").image
        seen, through = (full, step.image) if self.error == "full" else (step.image, full)
        return photometric_loss(through + (seen - through).detach(), step.view.image, self.lambda_dssim)
