"""What a hook did, a watchdog for training that is not regularized, and the decay of opacities in scripts."""

from __future__ import annotations

import abc
from collections import Counter
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from types import TracebackType
from typing import Any, Self
from weakref import WeakKeyDictionary

from torch import Tensor
from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook

from ca_reg._check import check_count
from ca_reg.decay import OpacityDecay

from ._steps import leaves_of


class Skip(StrEnum):
    """Why a render was left alone."""

    FURTHER_VIEW = (
        "render of another place in the script, after the first of its iteration (scope main); if it is a training "
        "view like the first: --scope all"
    )
    CONSTANT_OPACITY = "opacities that are not trained, such as a depth render with constant ones"
    DETACHED_MEANS = "positions that are not trained, such as a depth render for the opacities"
    RATE_ZERO = "training render at a step where the rate is 0"
    NOTHING_TO_SCALE = "test render of a regularizer that scales nothing"
    SCORE = "render of a co-adaptation score"


@dataclass
class Tally:
    """Counts of rasterizer calls; the steps are those of the first and the last regularized render, if there is one."""

    regularized: int = 0  # training renders whose Gaussians were dropped or perturbed
    scaled: int = 0  # renders without gradients, or for a viewer, with test-time values
    skipped: Counter[Skip] = field(default_factory=Counter)  # renders left alone, by reason
    first_step: int | None = None
    last_step: int | None = None
    lost: int = 0  # training steps without a render that could be regularized
    decayed: int = 0  # optimizer steps after which opacities were decayed

    def count_regularized(self, step: int) -> None:
        """Count a regularized render."""
        self.regularized += 1
        self.first_step = step if self.first_step is None else self.first_step
        self.last_step = step

    @property
    def used(self) -> bool:
        """Whether anything was counted."""
        return bool(self.regularized or self.scaled or self.skipped.total() or self.lost)

    def shortfall(self, optimizer_steps: int) -> str | None:
        """Describe how a run fell short of being regularized; None if it did not.

        Training counts as regularized if some render was, and renders that were, or had a rate of 0, outnumber lost
        steps nine to one. A script that only renders, without optimizer steps of Gaussians, needs a test render.
        """
        rendered = self.regularized + self.skipped[Skip.RATE_ZERO]
        if not (rendered or optimizer_steps or self.lost):
            tested = self.scaled or self.skipped[Skip.NOTHING_TO_SCALE]
            return None if tested else "No render was regularized or scaled."
        if not self.regularized:
            return "The training was not regularized."
        if self.lost > rendered / 9:
            return f"{self.lost} training steps had no render that could be regularized."
        return None

    def as_dict(self) -> dict[str, Any]:
        """Return the counts for JSON."""
        return vars(self) | {"skipped": {reason.name.lower(): count for reason, count in self.skipped.items()}}

    def lines(self) -> list[str]:
        """Return the counts in words, one per line."""
        steps = "" if self.first_step is None else f", steps {self.first_step} to {self.last_step}"
        lines = [f"{self.regularized} renders regularized{steps}", f"{self.scaled} renders scaled for evaluation"]
        lines += [f"{count} renders left alone: {reason.value}" for reason, count in self.skipped.most_common()]
        if self.decayed:
            lines.append(f"opacities decayed after {self.decayed} optimizer steps")
        if self.lost:
            lines.append(f"{self.lost} training steps without a render that could be regularized")
        if not self.regularized + self.scaled:
            lines.append("NOTHING was regularized or scaled")
        return lines


_OPACITY_GROUPS = ("opacity", "opacities")  # parameter groups in the INRIA family and in gsplat's trainers


class _ScriptDecay:
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
                f"{' or '.join(_OPACITY_GROUPS)}. Leave out --opacity-decay, and call ca_reg.decay.OpacityDecay in the "
                "script, after its optimizer's step; nerfstudio's splatfacto-ca has --pipeline.model.opacity-decay."
            )
        if not self.count:
            return f"Opacities did not decay: the training ended before step {self._decay.start + 1} (--decay-start)."
        return None


class Hook(abc.ABC):
    """Regularizes scripts without edits, from `install` to `uninstall`, or within a ``with`` block.

    Optimizer steps count if a parameter group is named ``opacity`` or ``opacities``: other optimizers train networks,
    poses or exposures. After each of them ``decay`` fades the logits of that group; its steps are those of the training
    where they are known, and else the optimizer's own.

    It is an error if more than ``patience`` optimizer steps in a row have no regularized render, or if more than that
    many training steps in all have no render; 0 for no limit. ``tally`` counts what was done so far.
    """

    def __init__(self, patience: int, decay: OpacityDecay | None = None) -> None:
        check_count(patience, "patience", minimum=0)
        self.tally = Tally()
        self._decay = None if decay is None else _ScriptDecay(decay)
        self._patience = patience
        self._optimized = self._idle = 0  # optimizer steps: all, and those since the last regularized render
        self._handle: Any = None

    @abc.abstractmethod
    def install(self) -> Self:
        """Install the hook, call `_count_steps`, and return the hook."""

    @abc.abstractmethod
    def uninstall(self) -> None:
        """Restore the original state, and call `_stop_counting`."""

    @abc.abstractmethod
    def _explain(self) -> str:
        """Explain why training may not have been regularized, and what to do."""

    def restart(self) -> None:
        """Forget what was counted, in a process that is a fork of the one that counted it."""
        vars(self.tally).update(vars(Tally()))
        self._optimized = self._idle = 0

    @property
    def used(self) -> bool:
        """Whether Gaussians were rendered or trained in this process."""
        return self.tally.used or self._optimized > 0

    def problem(self) -> str | None:
        """Describe a failure to regularize, or to decay, and its remedy; else None. A patience of 0 takes any."""
        if not self._patience:
            return None
        if shortfall := self.tally.shortfall(self._optimized):
            return f"{shortfall} {self._explain()}"
        return self._decay.problem() if self._decay is not None and self.tally.regularized else None

    def __enter__(self) -> Self:
        """Install the hook unless it is installed."""
        return self.install() if self._handle is None else self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Uninstall the hook; raise a RuntimeError if training was not regularized, see :meth:`problem`."""
        self.uninstall()
        if error is None and self._optimized and (problem := self.problem()):
            raise RuntimeError(problem)

    def note_regularized(self, opacities: Tensor, step: int | None = None) -> None:
        """Record a training render that was regularized, or whose rate is 0: its opacities and its step, if known.

        Raises a RuntimeError if nothing can decay.
        """
        self._idle = 0
        if self._decay is not None:
            self._decay.note_render(opacities, step)
            if not self._decay.found and 0 < self._patience < self.tally.regularized:
                raise RuntimeError(self._decay.problem())

    def note_lost(self) -> None:
        """Record a training step without a render; raise RuntimeError if there are too many."""
        self.tally.lost += 1
        self._check(self.tally.lost, "training steps had no render that could be regularized")

    def _count_steps(self) -> None:
        """Start counting the steps of all optimizers."""
        self._handle = register_optimizer_step_post_hook(self._stepped)

    def _stop_counting(self) -> None:
        """Stop counting; no effect if not counting."""
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def _stepped(self, optimizer: Optimizer, args: Any, kwargs: Any) -> None:
        groups = [group for group in optimizer.param_groups if group.get("name") in _OPACITY_GROUPS]
        logits = [x for group in groups for x in group["params"]]
        self._optimized += bool(logits)
        # A last stage may freeze the Gaussians, and step their optimizers all the same (gsplat 1.6 with PPISP).
        if any(x.requires_grad for x in logits):
            self._idle += 1
            self._check(self._idle, "optimizer steps of the Gaussians in a row, and no render was regularized")
            if self._decay is not None:
                self._decay.follow(optimizer, logits)
                self.tally.decayed = self._decay.count

    def _check(self, count: int, what: str) -> None:
        if 0 < self._patience < count:
            raise RuntimeError(f"{count} {what}. {self._explain()}")
