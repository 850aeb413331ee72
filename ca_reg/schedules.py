"""Rates that change during training, as callables ``schedule(step) -> float``, and the modules that follow them.

Schedules raise a ValueError if a rate is not finite or the steps are not in order.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ca_reg._check import Rate, check_count, check_finite, check_opacity, check_opacity_range

__all__ = [
    "SCHEDULES", "Constant", "ExponentialDecay", "LinearRamp", "Schedule", "Scheduled", "StartStop", "as_schedule"
]  # fmt: skip

Schedule = Callable[[int], float]
"""Any callable that maps a training step to a rate. Modules check the rate at each use."""


@dataclass(frozen=True)
class Constant:
    """The same rate at every step, as in the paper.

    Example:
        >>> Constant(0.2)(1000)
        0.2
    """

    value: float

    def __post_init__(self) -> None:
        check_finite(self.value, "value")

    def __call__(self, step: int) -> float:
        """Return the rate at ``step``."""
        return self.value


@dataclass(frozen=True)
class LinearRamp:
    """A linear ramp from one rate to another, constant before and after.

    Args:
        start_value: rate up to ``start_step``.
        end_value: rate from ``end_step`` on.
        start_step: first step of the ramp.
        end_step: last step of the ramp, greater than ``start_step``.

    Example:
        The schedule of DropGaussian, whose rate grows from 0 to 0.2 over 10,000 steps:

        >>> ramp = LinearRamp(0.0, 0.2, 0, 10_000)
        >>> ramp(0), ramp(5_000), ramp(20_000)
        (0.0, 0.1, 0.2)
    """

    start_value: float
    end_value: float
    start_step: int
    end_step: int

    def __post_init__(self) -> None:
        check_finite(self.start_value, "start_value")
        check_finite(self.end_value, "end_value")
        check_count(self.start_step, "start_step", minimum=0)
        check_count(self.end_step, "end_step", minimum=0)
        if self.end_step <= self.start_step:
            raise ValueError(f"end_step must come after start_step {self.start_step}, got {self.end_step}.")

    def __call__(self, step: int) -> float:
        """Return the rate at ``step``."""
        within = min(max(step, self.start_step), self.end_step)
        done = (within - self.start_step) / (self.end_step - self.start_step)
        # This form, not start + done * (end - start), is exact at both ends.
        return (1.0 - done) * self.start_value + done * self.end_value


@dataclass(frozen=True)
class StartStop:
    """A constant rate between two steps, 0 outside.

    Args:
        value: the rate while ``start <= step < stop``.
        start: first step with the rate.
        stop: first step at which the rate is 0 again; None for never.

    Example:
        >>> late = StartStop(0.2, start=500)
        >>> late(499), late(500)
        (0.0, 0.2)
    """

    value: float
    start: int = 0
    stop: int | None = None

    def __post_init__(self) -> None:
        check_finite(self.value, "value")
        check_count(self.start, "start", minimum=0)
        if self.stop is not None:
            check_count(self.stop, "stop", minimum=0)
            if self.stop <= self.start:
                raise ValueError(f"stop must come after start {self.start}, got {self.stop}.")

    def __call__(self, step: int) -> float:
        """Return the rate at ``step``."""
        on = step >= self.start and (self.stop is None or step < self.stop)
        return self.value if on else 0.0


@dataclass(frozen=True)
class ExponentialDecay:
    """Exponential decay, or growth, from one rate to another between two steps, 0 outside.

    Args:
        start_value: rate at ``start``, above 0.
        end_value: rate approached at ``stop``, above 0.
        start: first step of the decay.
        stop: first step at which the rate is 0 again, greater than ``start``.

    Example:
        >>> decay = ExponentialDecay(0.08, 0.02, 2_000, 9_500)
        >>> decay(1_999), decay(2_000), round(decay(5_750), 6), decay(9_500)
        (0.0, 0.08, 0.04, 0.0)
    """

    start_value: float
    end_value: float
    start: int
    stop: int

    def __post_init__(self) -> None:
        check_count(self.stop, "stop", minimum=0)  # None, which StartStop takes, has no decay
        StartStop(self.start_value, self.start, self.stop)  # checks
        check_finite(self.end_value, "end_value")
        if not (self.start_value > 0 and self.end_value > 0):
            raise ValueError(f"both values must be above 0, got {self.start_value} and {self.end_value}.")

    def __call__(self, step: int) -> float:
        """Return the rate at ``step``."""
        if not self.start <= step < self.stop:
            return 0.0
        done = (step - self.start) / (self.stop - self.start)
        return self.start_value * math.pow(self.end_value / self.start_value, done)


SCHEDULES = {"ramp": LinearRamp, "between": StartStop, "decay": ExponentialDecay}
"""Schedules by their names in expressions, such as ``dropout(ramp(0, 0.2, 0, 10_000))``."""


def as_schedule(rate: float | Schedule) -> Schedule:
    """Return ``rate`` if it is callable, else the constant schedule of that rate.

    Example:
        >>> as_schedule(0.2)
        Constant(value=0.2)
    """
    return rate if callable(rate) else Constant(rate)


def is_captured() -> bool:
    """Whether what is computed becomes part of a CUDA graph. PyTorch without CUDA has no answer."""
    initialized: bool = torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
    return initialized and torch.cuda.is_current_stream_capturing()


def refuse_capture(what: str, remedy: str = "draw outside the graph") -> None:
    """Raise a RuntimeError while a CUDA graph is captured: all replays would keep ``what``, which belongs to a step.

    ``what`` ends with that step, as in "the degree 1 of the step 30".
    """
    if is_captured():
        raise RuntimeError(f"a CUDA graph would keep {what} at which it is captured, for all replays: {remedy}.")


class Scheduled(nn.Module):
    """A module without parameters whose rate may follow a schedule; it checks the range of the first opacities.

    If the rate follows a schedule, ``state_dict`` holds ``step``, a float64 scalar that may be averaged like a
    parameter; else it is empty. A checkpoint without ``step`` leaves it unchanged, even with ``strict``.

    Args:
        rate: a number, or a schedule of it; None for a module without one.
    """

    rate_name: ClassVar[str] = ""  # name of the rate's argument, if there is one
    _check_rate: ClassVar[staticmethod[[Any, str], None]] = staticmethod(partial(check_finite, minimum=0.0))

    def __init__(self, rate: float | Schedule | None = None) -> None:
        super().__init__()
        value = rate.value if isinstance(rate, Constant) else rate
        if not callable(value) and (value is not None or self.rate_name):
            self._check_rate(value, self.rate_name or "the rate")  # refuses None
        self._schedule = as_schedule(0.0 if rate is None else rate)
        self._opacity_seen = False
        self._rate: Tensor | None = None
        self.step = 0

    def set_step(self, step: int) -> None:
        """Tell the module the training step, at least 0. Only schedules need it.

        With ``torch.compile`` call this outside the compiled function: a graph then serves all steps.

        Raises a TypeError if it is no integer, a ValueError if it is negative or the schedule leaves its range there.
        """
        check_count(step, "step", minimum=0)
        vars(self)["step"] = int(step)  # an assignment to an attribute of a module takes ten times as long
        if not isinstance(self._schedule, Constant):
            # A graph reads the rate from a tensor; a number would be baked in, with a recompilation at each step.
            # A new tensor, because one created in inference mode cannot be overwritten outside it.
            self._rate = torch.tensor(self._present_rate(), dtype=torch.float64, device="cpu")

    def hold(self, step: int) -> None:
        """Keep the rate of a step from now on, such as the last of a training that is continued.

        Raises a ValueError if the schedule leaves its range there.
        """
        self._schedule, self._rate = Constant(self._present_rate(step)), None

    def _present_rate(self, step: int | None = None) -> float:
        """Return the rate at a step, by default the current one, after a check."""
        step = self.step if step is None else step
        rate = self._schedule(step)
        self._check_rate(rate, f"{self.rate_name or 'the rate'} at step {step}")
        return rate

    def rate_at(self, step: int | None) -> Rate:
        """Return the rate at a step, for a draw ``x.step``, None for the current one; a number, after a range check.

        Inside ``torch.compile`` it is that of the last :meth:`set_step`, a scalar tensor, so that one graph serves all.

        Raises a RuntimeError in the capture of a CUDA graph, unless the rate is constant.
        """
        if isinstance(self._schedule, Constant):
            return self._schedule.value  # checked at construction; does not read the step, which would recompile
        if self._rate is not None and torch.compiler.is_compiling():
            return self._rate
        refuse_capture(
            f"{self.rate_name or 'the rate'} of the step",
            f"{self._schedule} is not constant. Capture with a constant rate, or draw outside the graph",
        )
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

        Graphs, compiled or captured, skip the range check: their control flow cannot depend on values.
        """
        check_opacity(opacity)
        if torch.compiler.is_compiling() or self._opacity_seen or is_captured():
            return
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
