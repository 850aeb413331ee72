"""Loops side by side: ranges of one loop are handed to threads, as many as PyTorch uses.

Kernels run without the interpreter's lock, so plain threads are enough, and with them what compilers' own thread pools
break holds: several threads may call at once, processes may fork at any time, and ``OMP_NUM_THREADS`` and
`torch.set_num_threads` decide for both libraries. Every range writes to places of its own, and no sum crosses ranges:
results do not depend on the number of threads.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import torch

__all__ = ["in_threads"]

_RANGES = 8  # for each thread: so many that none waits long for the others
_LEAST = 64  # items worth a call

_pools: dict[int, ThreadPoolExecutor] = {}
os.register_at_fork(after_in_child=_pools.clear)  # a forked process has none of its parent's threads


def in_threads(kernel: Callable[..., Any], count: int, *arguments: Any, least: int = _LEAST) -> list[Any]:
    """Call ``kernel(first, last, *arguments)`` for ranges that make up ``range(count)``; return what they return.

    Args:
        kernel: compiled with `reference_trainer.render.loops.compiling.kernel`.
        count: of items.
        arguments: of the kernel after the first two.
        least: items worth a range of their own.
    """
    threads = torch.get_num_threads()
    size = max(least, -(-count // (_RANGES * threads)))
    if threads == 1 or count <= size:
        return [kernel(0, count, *arguments)]
    firsts = iter(range(0, count, size))  # shared: whoever is free takes the next

    def work() -> list[Any]:
        return [kernel(first, min(first + size, count), *arguments) for first in firsts]

    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads - 1, thread_name_prefix="loops")
    others = [_pools[threads].submit(work) for _ in range(threads - 1)]
    try:
        results = work()
    finally:  # after Ctrl-C, too, nothing is written any more when the caller goes on
        firsts = iter(())
        wait(others)
    return list(itertools.chain(results, *(other.result() for other in others)))
