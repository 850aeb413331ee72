"""How many threads to compute with."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["chosen_threads", "thread_count", "threads_for"]

PIXELS_PER_THREAD = 65_536
"""Below twice this a picture gets one thread. Its steps are many operations of microseconds, at the end of each of
which the threads wait for each other: a second one gains little on an idle machine, and where another process has its
processor they wait until the system takes that away (a step at 96x64 takes 14 times as long, docs/reliability.md)."""


def chosen_threads() -> int | None:
    """Return the number that the user has set, as ``OMP_NUM_THREADS``; None if there is none."""
    word = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # a list is for nested regions
    return int(word) if word.isdecimal() and int(word) > 0 else None


def thread_count(pixels: int | None = None, *, jobs: int = 1) -> int:
    """Return how many threads a computation on pictures of so many pixels gets, with so many processes side by side.

    What the user has set wins. Else it is the share of the processors that this process may run on, and for small
    pictures fewer. It does not depend on how busy the machine is: a training repeats bit for bit with the same number.

    Example:
        >>> thread_count(96 * 64, jobs=2) == (chosen_threads() or 1)
        True
    """
    chosen = chosen_threads()
    if chosen is not None:
        return chosen
    affinity = getattr(os, "sched_getaffinity", None)  # Linux: fewer than the machine has, in a container or by taskset
    processors = len(affinity(0)) if affinity else os.cpu_count() or 1
    most = max(1, processors // jobs)
    return most if pixels is None else min(most, max(1, pixels // PIXELS_PER_THREAD))


@contextmanager
def threads_for(pixels: int) -> Iterator[None]:
    """Compute on pictures of so many pixels with at most `thread_count` threads, and with as many as before afterwards.

    Example:
        >>> import torch
        >>> with threads_for(96 * 64):
        ...     torch.get_num_threads() <= thread_count(96 * 64)
        True
    """
    import torch

    before = torch.get_num_threads()  # perhaps fewer: one for --deterministic, a worker's share
    torch.set_num_threads(min(before, thread_count(pixels)))
    try:
        yield
    finally:
        torch.set_num_threads(before)
