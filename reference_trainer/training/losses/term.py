"""The base classes of the terms of the training loss."""

from __future__ import annotations

import abc
from typing import ClassVar

from torch import Tensor

from ca_reg.schedules import Schedule, as_schedule
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.step import Step

__all__ = ["LossTerm", "PriorTerm", "WeightedTerm"]


class LossTerm(abc.ABC):
    """A summand of a step's loss, its weight included; custom terms are subclasses.

    Attributes:
        needs: what it requires besides image and alpha: ``"depth"`` of the renderer, which the step's render then has,
            or ``"moments"``; ``"models"`` of the training, at least two.
        analytic: whether the term works with an expected image and its variance, without a draw.
    """

    needs: frozenset[str] = frozenset()
    analytic: ClassVar[bool] = False

    def begin(self, scene: Scene) -> None:  # noqa: B027
        """Examine the training views and the initial points before the first step.

        Raises:
            ValueError: if they lack what the term compares with.
        """

    def acts(self, number: int) -> bool:
        """Return whether the term counts at a step; at others it is not called, and its needs are not met."""
        return True

    @abc.abstractmethod
    def __call__(self, step: Step) -> Tensor:
        """Return a scalar, differentiable in the parameters of the model."""


class WeightedTerm(LossTerm):
    """A term with a weight, which may follow a schedule; where that is 0 the term costs nothing.

    Args:
        weight: at least 0, or a schedule: ``between(1.0, 20_000)``, ``ramp(0.0, 0.5, 2_000, 2_500)``, ``decay(...)``.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> (term,) = LOSSES.make("opacity(between(0.01, 500))")
        >>> term.acts(499), term.acts(500)
        (False, True)
    """

    def __init__(self, weight: float | Schedule) -> None:
        self.weight = weight
        if not callable(weight):
            self._weight(0)

    def _weight(self, number: int) -> float:
        weight = as_schedule(self.weight)(number)
        if not weight >= 0:
            raise ValueError(f"weight must not be negative, got {weight}.")
        return weight

    def acts(self, number: int) -> bool:
        """Return whether the weight at this step is not 0."""
        return self._weight(number) != 0

    def __call__(self, step: Step) -> Tensor:
        """Return the weighted value."""
        # The schedule is asked again at every step: it is a function of the step, and of nothing else.
        weight, value = self._weight(step.number), self.value(step)
        return value if weight == 1 else weight * value

    @abc.abstractmethod
    def value(self, step: Step) -> Tensor:
        """Return the term without its weight, a scalar."""


class PriorTerm(WeightedTerm):
    """A term that compares the rendered depth with `View.depth_prior`."""

    needs = frozenset({"depth"})

    def begin(self, scene: Scene) -> None:
        """Raise a ValueError that names the photographs without a prior, if any."""
        if lacking := [view.name for view in scene.train if view.depth_prior is None]:
            raise ValueError(
                f"{type(self).__name__} compares with a depth of every training photograph, which {lacking} lack: name "
                'a folder of PNG or NPY files with --depth, or "points" for what the initial points tell.'
            )
