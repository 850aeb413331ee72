"""What all hooks share: what they did, and an eye on a training that goes on without being regularized."""

from __future__ import annotations

import abc
from types import TracebackType
from typing import Any, Self

from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook

from ca_reg._check import check_count

from ._tally import Tally

__all__ = ["Hook"]

_NAMES = ("opacity", "opacities")  # of the group of parameters, in the INRIA family and in gsplat's trainers


class Hook(abc.ABC):
    """Regularizes scripts that are not edited, from `install` to `uninstall`, or in a ``with`` block.

    Steps of an optimizer count if one of its groups of parameters is named ``opacity`` or ``opacities``: others train
    networks, poses or exposures.

    Args:
        patience: how many steps may go by without a regularized render: such steps in a row, or training steps without
            a render in all; 0 for any number.

    Attributes:
        tally: what was done so far.

    Raises:
        TypeError: if ``patience`` is no integer.
        ValueError: if it is negative.
    """

    def __init__(self, patience: int) -> None:
        check_count(patience, "patience", minimum=0)
        self.tally = Tally()
        self._patience = patience
        self._optimized = self._idle = 0  # steps of optimizers: all, and those since the last regularized render
        self._handle: Any = None

    @abc.abstractmethod
    def install(self) -> Self:
        """Put the hook in force, `_watch` among it, and return it."""

    @abc.abstractmethod
    def uninstall(self) -> None:
        """Put back what was there, `_unwatch` among it."""

    @abc.abstractmethod
    def _explain(self) -> str:
        """Say what may be the cause of a training that is not regularized, and what to do."""

    def problem(self) -> str | None:
        """Say what went wrong unnoticed, and the way out; None if all is well, and with a patience of 0."""
        shortfall = self._patience and self.tally.shortfall(self._optimized)
        return f"{shortfall} {self._explain()}" if shortfall else None

    def __enter__(self) -> Self:
        """Install the hook, unless it is."""
        return self.install() if self._handle is None else self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Uninstall the hook.

        Raises:
            RuntimeError: if a training came to its end without being regularized, see :meth:`problem`.
        """
        self.uninstall()
        if error is None and self._optimized and (problem := self.problem()):
            raise RuntimeError(problem)

    def note_regularized(self) -> None:
        """Take note of a training render that was regularized, or that the schedule leaves alone."""
        self._idle = 0

    def note_lost(self) -> None:
        """Take note of a training step without a render."""
        self.tally.lost += 1
        self._check(self.tally.lost, "training steps had no render that could be regularized")

    def _watch(self) -> None:
        """Look at the steps of all optimizers."""
        self._handle = register_optimizer_step_post_hook(self._stepped)

    def _unwatch(self) -> None:
        """Look at them no longer; without effect if it did not."""
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def _stepped(self, optimizer: Optimizer, args: Any, kwargs: Any) -> None:
        if any(group.get("name") in _NAMES for group in optimizer.param_groups):
            self._optimized += 1
            self._idle += 1
            self._check(self._idle, "optimizer steps of the Gaussians in a row, and no render was regularized")

    def _check(self, count: int, what: str) -> None:
        if 0 < self._patience < count:
            raise RuntimeError(f"{count} {what}. {self._explain()}")
