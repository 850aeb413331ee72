"""Smoothness of the rendered inverse depth, away from the edges of the photograph."""

from __future__ import annotations

from kornia.losses import inverse_depth_smoothness_loss
from torch import Tensor

from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["SmoothDepth"]


class SmoothDepth(WeightedTerm):
    """``weight`` times kornia's inverse_depth_smoothness_loss of ``alpha / depth`` over its mean (Monodepth2, 2019).

    ``sum over x and y of mean |dD| exp(-mean |dI|)``: forward differences, I the photograph, D the inverse mean depth
    of a pixel, 0 where nothing is drawn, divided by its own mean so that the unit of length does not matter.

    Args:
        weight: at least 0, or a schedule. Monodepth2 uses 0.001.

    Raises:
        ValueError: if it is negative.
    """

    needs = frozenset({"depth"})

    def __init__(self, weight: float | Schedule = 0.001) -> None:
        super().__init__(weight)

    def value(self, step: Step) -> Tensor:
        """Return the smoothness of the view."""
        assert step.rendering is not None
        inverse = step.rendering.alpha / step.depth.clamp_min(1e-8)
        inverse = inverse / inverse.mean().clamp_min(1e-12)
        return inverse_depth_smoothness_loss(inverse[None, None], step.view.image[None])
