"""The base module: a rate that may follow a schedule, and a range check of the first opacities."""

from __future__ import annotations

import inspect
import math
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ca_reg._check import Rate, check_count, check_finite, check_opacity, check_opacity_range
from ca_reg.schedules import Constant, Schedule, as_schedule

__all__ = ["Scheduled"]


class Scheduled(nn.Module):
    """A module without parameters whose rate may follow a schedule; it checks the range of the first opacities.

    If the rate follows a schedule, ``state_dict`` holds ``step``, a float64 scalar that may be averaged like a
    parameter; else it is empty. A checkpoint without ``step`` leaves it unchanged, even with ``strict``.

    Args:
        rate: a number, or a schedule of it; None for a module without one.
    """

    rate_name: ClassVar[str] = ""  # name of the rate's argument, if there is one

    def __init__(self, rate: float | Schedule | None = None) -> None:
        super().__init__()
        value = rate.value if isinstance(rate, Constant) else rate
        if not callable(value) and (value is not None or self.rate_name):
            self._check_rate(value, self.rate_name or "the rate")  # type: ignore[arg-type]  # refuses None
        self._schedule = as_schedule(0.0 if rate is None else rate)
        self._opacity_seen = False
        self._rate: Tensor | None = None
        self.step = 0

    def set_step(self, step: int) -> None:
        """Tell the module the training step, at least 0. Only schedules need it.

        With ``torch.compile`` call this outside the compiled function: a graph then serves all steps.

        Raises:
            TypeError: if ``step`` is not an integer.
            ValueError: if it is negative, or the schedule leaves its range there.
        """
        check_count(step, "step", minimum=0)
        self.step = int(step)
        if not isinstance(self._schedule, Constant):
            # A graph reads the rate from a tensor; a number would be baked in, with a recompilation at each step.
            # A new tensor, because one created in inference mode cannot be overwritten outside it.
            self._rate = torch.tensor(self._present_rate(), dtype=torch.float64, device="cpu")

    def _check_rate(self, rate: float, name: str) -> None:
        """Raise unless the rate is in range: finite and at least 0, unless overridden."""
        check_finite(rate, name, minimum=0.0)

    def _present_rate(self, step: int | None = None) -> float:
        """Return the rate at a step, by default the current one, after a check."""
        step = self.step if step is None else step
        rate = self._schedule(step)
        self._check_rate(rate, f"{self.rate_name or 'the rate'} at step {step}")
        return rate

    def rate_at(self, step: int | None) -> Rate:
        """Return the rate at a step, for a draw ``x.step``, None for the current one; a number, after a range check.

        Inside ``torch.compile`` it is that of the last :meth:`set_step`, a scalar tensor, so that one graph serves all.
        """
        if isinstance(self._schedule, Constant):
            return self._schedule.value  # checked at construction; does not read the step, which would recompile
        if self._rate is not None and torch.compiler.is_compiling():
            return self._rate
        return self._present_rate(step)

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if not isinstance(self._schedule, Constant):
            destination[prefix + "step"] = torch.tensor(float(self.step), dtype=torch.float64)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        step = state_dict.pop(prefix + "step", None)
        if step is not None:
            self.set_step(round(float(step)))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _check(self, opacity: Any) -> None:
        """Check shape and dtype, and at the first call the range of the values, which synchronizes a GPU.

        A compiled graph skips the range check: its control flow cannot depend on values.
        """
        check_opacity(opacity)
        if not torch.compiler.is_compiling() and not self._opacity_seen:
            # Compensated dropout before this module may have raised opacities above 1.
            check_opacity_range(opacity, upper=math.inf)
            self._opacity_seen = True

    def extra_repr(self) -> str:
        """Return the constructor arguments that are known from attributes of the same names, for ``print``."""
        rate = self._schedule.value if isinstance(self._schedule, Constant) else self._schedule
        known: dict[str, Any] = {name: x for name, x in vars(self).items() if isinstance(x, int | float | str | tuple)}
        known.setdefault(self.rate_name, rate)
        names = inspect.signature(type(self).__init__).parameters
        return ", ".join(f"{name}={known[name]}" for name in names if name in known)
