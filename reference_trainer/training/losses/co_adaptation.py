"""The exact co-adaptation of a view, with a photograph or without, as a term of the loss."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import check_count
from ca_reg.functional import Multiplier
from ca_reg.schedules import Schedule
from reference_trainer.scenes.pseudo import VIRTUAL_VIEWS
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["CoAdaptation"]


class CoAdaptation(WeightedTerm):
    """``weight`` times the mean variance of the colors when each Gaussian is dropped independently, with rate ``p``.

    The variance needs no photograph, so it can be taken at virtual views as well. At the training view an analytic step
    has computed its variance already, which costs nothing more; else the moments are rendered, which takes about as
    long as the render.

    Args:
        weight: at least 0, or a schedule.
        p: drop rate in [0, 1); in an analytic step the regularizer's own draws count at the training view instead.
        where: ``"training"``, the view of the step, or a camera drawn anew at each step: between two training cameras
            on a ``"line"`` or on an ``"arc"`` (`cameras_between`), on an arc extended by half its length ``"beyond"``
            either, or in their ``"box"`` (`pseudo_cameras`).
        every: the term acts once in so many steps, multiplied by their number, so that ``weight`` is the mean per step.

    Raises:
        TypeError: if ``every`` is no integer.
        ValueError: if one is out of range, or the scene has no such cameras.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> (term,) = LOSSES.make("co_adaptation(between(3.0, 200), where='arc', every=4)")
        >>> [number for number in range(190, 210) if term.acts(number)]
        [200, 204, 208]
    """

    needs = frozenset({"moments"})
    analytic = True

    def __init__(self, weight: float | Schedule = 1.0, p: float = 0.5, where: str = "training", every: int = 1) -> None:
        super().__init__(weight)
        self.multiplier = Multiplier.dropout(p)
        if where not in ("training", *VIRTUAL_VIEWS):
            raise ValueError(f"where must be training, {', '.join(VIRTUAL_VIEWS)}, got {where!r}.")
        check_count(every, "every", minimum=1, hint=": a term without steps is left out")
        self.where, self.every = where, every

    def begin(self, scene: Scene) -> None:
        """Prepare the virtual cameras."""
        if self.where != "training":
            self.draw = VIRTUAL_VIEWS[self.where](scene)

    def acts(self, number: int) -> bool:
        """Return whether the term is due at a step, with a weight that is not 0."""
        return number % self.every == 0 and super().acts(number)

    def value(self, step: Step) -> Tensor:
        """Return the mean variance, times the number of steps that it stands for."""
        camera, variance = step.view.camera, step.variance
        if self.where != "training":
            camera, variance = self.draw(step.generator("co_adaptation")), None
        if variance is None:
            variance = step.moments(camera, self.multiplier).variance
        return self.every * variance.mean()
