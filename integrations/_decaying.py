"""The decay of opacities in scripts that are not edited."""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from weakref import WeakKeyDictionary

from torch import Tensor
from torch.optim import Optimizer

from ca_reg.decay import OpacityDecay

from ._steps import leaves_of

__all__ = ["OPACITY_GROUPS", "ScriptDecay"]

OPACITY_GROUPS = ("opacity", "opacities")
"""Names of the parameter groups in the INRIA family and in gsplat's trainers."""


class ScriptDecay:
    """Fades a script's opacities after its optimizers' steps, once rendered ones are seen to be computed from them.

    ``count`` is the number of optimizer steps after which they faded, ``found`` whether an optimizer was seen to train
    what the rendered opacities are computed from.
    """

    def __init__(self, decay: OpacityDecay) -> None:
        self.count = 0
        self.found = False
        self._decay = decay
        self._rendered: list[Tensor] = []  # parameters that the opacities of the last render were computed from
        self._training_step: int | None = None
        self._steps: MutableMapping[Optimizer, int] = WeakKeyDictionary()  # of the last decay

    def note_render(self, opacities: Tensor, step: int | None) -> None:
        """Take note of the opacities of a training render, and of its training step, None if it is not known."""
        self._training_step = step
        if not self.found:  # the first time is before any densification, which replaces parameters
            self._rendered = list(leaves_of(opacities))

    def follow(self, optimizer: Optimizer, logits: Sequence[Tensor]) -> None:
        """Decay after a step of an optimizer that trains these logits, once for each training step that is known."""
        if not self.found and any(x is y for x in logits for y in self._rendered):
            self.found = True
            self._rendered.clear()  # a densification replaces them, and they need not stay
        last = self._steps.get(optimizer, 0)
        # The optimizer's own steps begin anew where a training is resumed.
        step = last + 1 if self._training_step is None else self._training_step
        self._steps[optimizer] = step
        if self.found and step != last:  # torch tells the step of a subclass that calls its base's twice
            for x in logits:
                self._decay(x, step)
            self.count += step > self._decay.start

    def problem(self) -> str | None:
        """Describe why nothing decayed, and what to do; None if something did."""
        if not self.found:
            return (
                "Opacities do not decay: those that are rendered are computed from no parameter group that is named "
                f"{' or '.join(OPACITY_GROUPS)}. Leave out --opacity-decay, and call ca_reg.decay.OpacityDecay in the "
                "script, after its optimizer's step; nerfstudio's splatfacto-ca has --pipeline.model.opacity-decay."
            )
        if not self.count:
            return f"Opacities did not decay: the training ended before step {self._decay.start + 1} (--decay-start)."
        return None
