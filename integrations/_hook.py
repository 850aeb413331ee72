"""The base class of hooks: installation, counts, and a watchdog for training that is not regularized."""

from __future__ import annotations

import abc
from types import TracebackType
from typing import Any, Self

from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook

from ca_reg._check import check_count

from ._tally import Tally

__all__ = ["Hook"]

_NAMES = ("opacity", "opacities")  # parameter groups in the INRIA family and in gsplat's trainers


class Hook(abc.ABC):
    """Regularizes scripts without edits, from `install` to `uninstall`, or within a ``with`` block.

    Optimizer steps count if a parameter group is named ``opacity`` or ``opacities``: other optimizers train networks,
    poses or exposures.

    Args:
        patience: number of optimizer steps in a row without a regularized render, and total number of training steps
            without a render, beyond which an error is raised; 0 for no limit.

    Attributes:
        tally: counts of what was done so far.

    Raises:
        TypeError: if ``patience`` is not an integer.
        ValueError: if it is negative.
    """

    def __init__(self, patience: int) -> None:
        check_count(patience, "patience", minimum=0)
        self.tally = Tally()
        self._patience = patience
        self._optimized = self._idle = 0  # optimizer steps: all, and those since the last regularized render
        self._handle: Any = None

    @abc.abstractmethod
    def install(self) -> Self:
        """Install the hook, call `_watch`, and return the hook."""

    @abc.abstractmethod
    def uninstall(self) -> None:
        """Restore the original state, and call `_unwatch`."""

    @abc.abstractmethod
    def _explain(self) -> str:
        """Explain why training may not have been regularized, and what to do."""

    def problem(self) -> str | None:
        """Describe a failure to regularize and its remedy; None if there was none, and with a patience of 0."""
        shortfall = self._patience and self.tally.shortfall(self._optimized)
        return f"{shortfall} {self._explain()}" if shortfall else None

    def __enter__(self) -> Self:
        """Install the hook unless it is installed."""
        return self.install() if self._handle is None else self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Uninstall the hook.

        Raises:
            RuntimeError: if training ended without being regularized, see :meth:`problem`.
        """
        self.uninstall()
        if error is None and self._optimized and (problem := self.problem()):
            raise RuntimeError(problem)

    def note_regularized(self) -> None:
        """Record a training render that was regularized, or whose scheduled rate is 0."""
        self._idle = 0

    def note_lost(self) -> None:
        """Record a training step without a render; raise RuntimeError if there are too many."""
        self.tally.lost += 1
        self._check(self.tally.lost, "training steps had no render that could be regularized")

    def _watch(self) -> None:
        """Start watching the steps of all optimizers."""
        self._handle = register_optimizer_step_post_hook(self._stepped)

    def _unwatch(self) -> None:
        """Stop watching; no effect if not watching."""
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
