"""What the modules of this package share: a rate that follows the step, and a look at the first opacities."""

from __future__ import annotations

import math
from typing import Any

from torch import nn

from ca_reg._check import check_count, check_opacity, check_opacity_range
from ca_reg.schedules import Constant, Schedule

__all__ = ["Regularizer"]


class Regularizer(nn.Module):
    """A module without parameters whose rate may depend on the step, and that looks at the first opacities."""

    def __init__(self, schedule: Schedule) -> None:
        super().__init__()
        self._schedule = schedule
        self._opacity_seen = False
        self.step = 0

    def set_step(self, step: int) -> None:
        """Tell the module the training step, at least 0. Only schedules need it."""
        check_count(step, "step", minimum=0)
        self.step = int(step)

    def get_extra_state(self) -> dict[str, Any]:
        """Return what ``state_dict`` saves: the step."""
        return {"step": self.step}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take the step from a ``state_dict``."""
        self.set_step(state["step"])

    def _check(self, opacity: Any) -> None:
        """Check shape and type always, and once that the values are opacities: on a GPU that look costs a wait."""
        check_opacity(opacity)
        if not self._opacity_seen:
            # Compensated dropout may come before this module: it makes opacities above 1.
            check_opacity_range(opacity, upper=math.inf)
            self._opacity_seen = True

    def _rate_repr(self) -> str:
        return str(self._schedule.value) if isinstance(self._schedule, Constant) else repr(self._schedule)
