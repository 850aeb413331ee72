"""Which training step every field of Gaussians is in, and how often it was rendered in that step."""

from __future__ import annotations

import weakref
from typing import Any

from torch import Tensor

__all__ = ["Field", "Iterations"]

_FINISHED = 2**31  # the step of a field that is only evaluated: every schedule has come to its end
_RENDERS_WITHOUT_STEP = 256  # of one field; no code base renders so many views in one step


class Field:
    """One set of Gaussians in training.

    Args:
        index: tells the fields of one training apart, from 0.
        step: the step that it starts in, 0 if that is not known.
    """

    def __init__(self, index: int, step: int) -> None:
        self.index = index
        self.renders = 0
        self._step = step
        self._updates_end_step: bool | None = None
        self._version: int | None = None

    @property
    def training_step(self) -> int:
        """The step, from 1."""
        return max(self._step, 1)

    @property
    def evaluation_step(self) -> int:
        """The step; after all schedules if nothing was ever trained, as in a script that only renders."""
        return self.training_step if self._step or self.renders else _FINISHED

    def begin(self, step: int) -> None:
        """Enter a step."""
        self._step = step
        self.renders = 0

    def update(self, iteration: int) -> None:
        """Take note of a call of update_learning_rate.

        It is called once per step, but its argument may have an offset (DNGaussian), so that calls are counted from the
        first argument on. FSGS and CoR-GS call it at the end of a step, which shows at the first call.
        """
        if self._updates_end_step is None:
            self._updates_end_step = self.renders > 0
            self.begin(max(iteration, 1) + self._updates_end_step)
        else:
            self.begin(self._step + 1)

    def count_render(self, means: Tensor) -> None:
        """Count a training render.

        Raises:
            RuntimeError: if steps go by without anyone saying so.
        """
        self.renders += 1
        self._version = means._version if self._version is None else self._version
        unknown = self._step == 0
        if unknown and (means._version != self._version or self.renders > _RENDERS_WITHOUT_STEP):
            raise RuntimeError(
                "cannot tell the training steps apart: scene.gaussian_model.GaussianModel.update_learning_rate was not "
                "called for the Gaussians that are rendered. Call hook.step(iteration) at the start of every iteration."
            )


class Iterations:
    """The fields of one training, found by their model or, where that is not known, by their positions."""

    def __init__(self) -> None:
        self._fields: list[tuple[weakref.ref[Any], Field]] = []
        self._step: int | None = None

    def field(self, owner: Any) -> Field:
        """Return the field of a model or of a tensor of positions; a new one at first sight."""
        # Densification replaces the positions: the fields of dead tensors make room for their successors.
        self._fields = [(ref, field) for ref, field in self._fields if ref() is not None]
        for ref, field in self._fields:
            if ref() is owner:
                return field
        taken = {field.index for _, field in self._fields}
        index = next(i for i in range(len(taken) + 1) if i not in taken)
        field = Field(index, self._step or 0)
        self._fields.append((weakref.ref(owner), field))
        return field

    def update(self, model: Any, iteration: int) -> None:
        """Take note of a call of update_learning_rate, unless the steps are said explicitly."""
        if self._step is None:
            self.field(model).update(iteration)

    def step(self, step: int) -> None:
        """Enter a step with all fields."""
        self._step = step
        for _, field in self._fields:
            field.begin(step)
