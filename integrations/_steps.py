"""Track the training step of every model, one set of Gaussians each, and its renders in that step."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Iterator
from typing import Any, Literal

from torch import Tensor

Steps = Literal["updates", "parameters"]
"""What marks a new step: a call of ``update_learning_rate``, or a change of the parameters."""

FINISHED = 2**31  # the step of a model that is only evaluated: past the end of every schedule
_RENDERS_WITHOUT_STEP = 256  # of one model; no code base renders so many views in one step
_NODES = 1000  # largest number of autograd nodes to search for a parameter


class ModelSteps:
    """One set of Gaussians in training: its index, from 0, its step, 0 if unknown, and its renders in that step."""

    def __init__(self, index: int, step: int, steps: Steps) -> None:
        self.index = index
        self.renders = 0
        self.step = step
        self._by_parameters = steps == "parameters"
        self._updates_end_step: bool | None = None
        self._versions: list[tuple[int, int]] = []
        self._place: Hashable = None

    @property
    def training_step(self) -> int:
        """The step, from 1."""
        return max(self.step, 1)

    def begin(self, step: int) -> None:
        """Begin a step."""
        self.step, self.renders = step, 0

    def update(self, iteration: int) -> bool:
        """Process a call of update_learning_rate; return False if the step that ends had no training render.

        It is called once per step, but its argument may have an offset (DNGaussian), so calls are counted from the
        first argument on. FSGS and CoR-GS call it at the end of a step, which is detected at the first call.

        If parameters mark the steps, only the first call counts: it tells at which step a resumed training continues.
        """
        rendered = self._updates_end_step is None or self._by_parameters or self.renders > 0
        if self._updates_end_step is None:
            self._updates_end_step = self.renders > 0
            self.begin(max(iteration, 1) + self._updates_end_step)
        elif not self._by_parameters:
            self.begin(self.step + 1)
        return rendered

    def count_render(self, parameters: list[Tensor], place: Hashable) -> bool:
        """Count a training render; return whether it was requested at the same place as the first one of its step.

        A change of the parameters' versions shows that they were trained on, which begins a step. Where calls of
        update_learning_rate begin the steps, it raises a RuntimeError instead, because one of these calls is missing.
        """
        versions = [(id(x), x._version) for x in parameters]
        trained = self.renders > 0 and versions != self._versions
        self._versions = versions
        if trained and self._by_parameters:
            self.begin(self.training_step + 1)
        elif trained or (self.step == 0 and self.renders >= _RENDERS_WITHOUT_STEP):
            raise RuntimeError(
                "cannot tell the training steps apart: the Gaussians were trained on after their last render, but "
                "scene.gaussian_model.GaussianModel.update_learning_rate was not called for them since. Only the first "
                'step would be regularized. Take the changes of the parameters for the steps: steps="parameters", in '
                "the launcher --steps parameters; or call hook.step(iteration) at the start of every iteration."
            )
        self.renders += 1
        if self.renders == 1:
            self._place = place
        return place == self._place


class Iterations:
    """The models of one training, each identified by itself or, where it is unknown, by a parameter.

    ``lose_step`` is called when a step of a model ends without a training render.
    """

    def __init__(self, steps: Steps, lose_step: Callable[[], None]) -> None:
        self._steps = steps
        self._models: list[tuple[weakref.ref[Any], ModelSteps]] = []
        self._vacant: list[ModelSteps] = []
        self._step: int | None = None
        self._lose_step = lose_step

    def steps_of(self, owner: Any) -> ModelSteps:
        """Return the steps of a model or of a parameter; new ones if it was not seen before."""
        # Densification replaces parameters: a new one takes over the steps of one that is gone, one step later.
        if vacant := [steps for ref, steps in self._models if ref() is None]:
            self._vacant += vacant
            self._models = [(ref, steps) for ref, steps in self._models if ref() is not None]
        for ref, steps in self._models:
            if ref() is owner:
                return steps
        if self._vacant:
            gone = self._vacant.pop(0)
            index, step = gone.index, gone.step + (gone.renders > 0)
        else:
            index, step = len(self._models), max((steps.step for _, steps in self._models), default=0)
        steps = ModelSteps(index, step if self._step is None else self._step, self._steps)
        self._models.append((weakref.ref(owner), steps))
        return steps

    def evaluation_step(self, owner: Any) -> int:
        """Return the step of a model or parameter, else the latest of any; past all schedules if none was trained."""
        trained = [(ref(), steps.training_step) for ref, steps in self._models if steps.step or steps.renders]
        own = [step for known, step in trained if known is owner]
        return max(own or (step for _, step in trained), default=FINISHED)

    def update(self, model: Any, iteration: int) -> None:
        """Process a call of update_learning_rate, unless steps are set explicitly."""
        if self._step is None and not self.steps_of(model).update(iteration):
            self._lose_step()

    def step(self, step: int) -> None:
        """Begin a step of all models."""
        rendered = self._step is None
        self._step = step
        for _, steps in self._models:
            rendered |= steps.renders > 0
            steps.begin(step)
        if not rendered:
            self._lose_step()


def leaves_of(x: Tensor) -> Iterator[Tensor]:
    """Iterate over the parameters that a tensor was computed from, nearest first and in an order of their own."""
    if x.is_leaf:
        yield x
        return
    nodes: list[Any] = [x.grad_fn]
    for node in nodes:
        if isinstance(leaf := getattr(node, "variable", None), Tensor):
            yield leaf
        if len(nodes) < _NODES:
            nodes += [node for node, _ in node.next_functions if node is not None]
