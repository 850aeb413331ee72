"""Clocks, and interleaved timing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from time import perf_counter, process_time

import torch

__all__ = ["Clock", "in_turns", "now", "processor_clock"]

Clock = Callable[[], float]


def in_turns(calls: Mapping[str, Callable[[], object]], repeats: int, clock: Clock) -> dict[str, list[float]]:
    """Time several calls in turns, so that a change in the machine's load affects all of them alike.

    Args:
        calls: by name.
        repeats: number of timed rounds, after one untimed round.
        clock: returns seconds: `now` of a device, or `processor_clock`.

    Returns:
        Seconds of every round, by name.

    Example:
        >>> len(in_turns({"nothing": lambda: None}, 3, perf_counter)["nothing"])
        3
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(repeats):
        for name, call in calls.items():
            start = clock()
            call()
            seconds[name].append(clock() - start)
    return seconds


def now(device: torch.device) -> float:
    """Wait until all work queued on a device is done; return the wall-clock time in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return perf_counter()


def processor_clock(device: torch.device) -> Clock:
    """Return a clock less disturbed by other programs: CPU time of this process; on a GPU, `now`."""
    return process_time if device.type == "cpu" else partial(now, device)
