"""Notice a training of Gaussians that goes on without being regularized, and stop it early."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook

from ca_reg._check import check_count

__all__ = ["Watch"]

_NAMES = ("opacity", "opacities")  # of the group of parameters, in the INRIA family and in gsplat's trainers


class Watch:
    """Counts what training goes by without a regularized render.

    Steps of an optimizer are counted if one of its groups of parameters is named ``opacity`` or ``opacities``: others
    train networks, poses or exposures.

    Args:
        patience: how many such steps in a row, or training steps without a render in all, are put up with; 0 for any
            number.
        explain: returns what the user should know and do.

    Attributes:
        patience: as given.
        steps: of optimizers of Gaussians, since it was made.

    Raises:
        TypeError: if ``patience`` is no integer.
        ValueError: if it is negative.
    """

    def __init__(self, patience: int, explain: Callable[[], str]) -> None:
        check_count(patience, "patience", minimum=0)
        self.steps = 0
        self._idle = 0
        self.patience = patience
        self._explain = explain
        self._handle: Any = None

    def start(self) -> None:
        """Look at the steps of all optimizers."""
        self._handle = register_optimizer_step_post_hook(self._stepped)

    def stop(self) -> None:
        """Look at them no longer; without effect if it did not."""
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def regularized(self) -> None:
        """Take note of a training render that was regularized, or that the schedule leaves alone."""
        self._idle = 0

    def check_lost(self, steps: int) -> None:
        """Raise RuntimeError if so many training steps without a render in all are too many."""
        self._check(steps, "training steps had no render that could be regularized")

    def _stepped(self, optimizer: Optimizer, args: Any, kwargs: Any) -> None:
        """Count a step of any optimizer."""
        if any(group.get("name") in _NAMES for group in optimizer.param_groups):
            self.steps += 1
            self._idle += 1
            self._check(self._idle, "optimizer steps of the Gaussians in a row, and no render was regularized")

    def _check(self, count: int, what: str) -> None:
        if 0 < self.patience < count:
            raise RuntimeError(f"{count} {what}. {self._explain()}")
