"""MVGS's further training views in the same step."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg._check import check_count
from ca_reg.schedules import Schedule
from reference_trainer.training.losses.photometric import Photometric
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Views"]


class Views(WeightedTerm):
    """``weight`` times the sum of the photometric losses of n - 1 further training views (MVGS, 2024).

    Each is drawn like the view of the step, with its own draw of the regularizers, and counted by density control (the
    source counts the last one alone). ``photometric + views(3)`` makes three views a step.

    Args:
        n: views in a step, including the step's own, at least 2; all, if there are fewer training views.
        weight: at least 0, or a schedule.
        lambda_dssim: of `photometric_loss`.

    Raises:
        TypeError: if ``n`` is no integer.
        ValueError: if one is out of range.
    """

    analytic = True

    def __init__(self, n: int = 3, weight: float | Schedule = 1.0, lambda_dssim: float = 0.2) -> None:
        super().__init__(weight)
        check_count(n, "n", minimum=2, hint=": one view is what photometric has")
        self.n, self.photometric = n, Photometric(lambda_dssim)

    def value(self, step: Step) -> Tensor:
        """Draw the views and compare each with its photograph."""
        others = [view for view in step.views if view.name != step.view.name]
        generator = step.generator("views")
        order = torch.randperm(len(others), generator=generator, device=generator.device)[: self.n - 1]
        losses = [self.photometric(step.at(others[i])) for i in order.tolist()]
        return sum(losses, start=step.image.new_zeros(()))
