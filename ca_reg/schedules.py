"""Rates that change during training: small immutable callables ``schedule(step) -> float``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from ca_reg._check import check_count, check_finite

__all__ = ["SCHEDULES", "Constant", "ExponentialDecay", "LinearRamp", "Schedule", "StartStop", "as_schedule"]

Schedule = Callable[[int], float]
"""Any callable that maps a training step to a rate. Modules check the rate at each use."""


@dataclass(frozen=True)
class Constant:
    """The same rate at every step, as in the paper.

    Args:
        value: the rate.

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

    Raises:
        ValueError: if a value is not finite or ``end_step`` does not come after ``start_step``.

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

    Raises:
        ValueError: if ``value`` is not finite or ``stop`` does not come after ``start``.

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

    Raises:
        ValueError: if a value is not finite and above 0, or ``stop`` does not come after ``start``.

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
