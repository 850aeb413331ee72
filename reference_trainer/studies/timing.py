"""The clock of the studies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import perf_counter

import torch

__all__ = ["in_turns", "now"]


def in_turns(calls: Mapping[str, Callable[[], object]], repeats: int, device: torch.device) -> dict[str, list[float]]:
    """Time several calls in turns, so that a change of the machine's load meets all of them.

    Args:
        calls: by name.
        repeats: number of timed rounds; one round before them is not timed.
        device: whose work to wait for.

    Returns:
        Seconds of every round, by name.

    Example:
        >>> len(in_turns({"nothing": lambda: None}, 3, torch.device("cpu"))["nothing"])
        3
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(repeats):
        for name, call in calls.items():
            start = now(device)
            call()
            seconds[name].append(now(device) - start)
    return seconds


def now(device: torch.device) -> float:
    """Return the time at which all work given to a device is done, seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return perf_counter()
