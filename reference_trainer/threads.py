"""Choosing the number of threads."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["chosen_threads", "processors", "thread_count", "threads_for"]

PIXELS_PER_THREAD = 65_536
"""A picture of less than twice this gets one thread. Its steps are many operations of microseconds, each of which ends
in a barrier: a second thread gains little on an idle machine, and where another process occupies its core, the first
waits for the scheduler (a step at 96x64 takes 14 times as long, docs/reliability.md)."""


def chosen_threads() -> int | None:
    """Return the number of threads that the user has set in ``OMP_NUM_THREADS``, or None."""
    word = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # a list is for nested regions
    return int(word) if word.isdecimal() and int(word) > 0 else None


def processors() -> int:
    """Return how many processors this process may run on, in a container perhaps fewer than the machine has.

    Example:
        >>> processors() >= 1
        True
    """
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def thread_count(pixels: int | None = None, *, jobs: int = 1) -> int:
    """Return how many threads to use for pictures of ``pixels`` pixels, with ``jobs`` processes side by side.

    The user's choice wins. Else it is a job's share of the processors that this process may run on, and fewer for small
    pictures. The machine's load does not matter: a training repeats bit for bit only with the same number.

    Example:
        >>> thread_count(96 * 64, jobs=2) == (chosen_threads() or 1)
        True
    """
    chosen = chosen_threads()
    if chosen is not None:
        return chosen
    most = max(1, processors() // jobs)
    return most if pixels is None else min(most, max(1, pixels // PIXELS_PER_THREAD))


@contextmanager
def threads_for(pixels: int) -> Iterator[None]:
    """Limit PyTorch to `thread_count` threads for pictures of ``pixels`` pixels within a block.

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
