"""Running loops in parallel: ranges of a loop are handed to as many threads as PyTorch uses.

Kernels run without the GIL, so plain threads are enough. Unlike compilers' own thread pools they allow several threads
to call at once and processes to fork at any time (the child goes on with one thread), and ``OMP_NUM_THREADS`` and
`torch.set_num_threads` hold for them as for PyTorch. Every range writes to its own memory, and no sum crosses ranges:
results do not depend on the number of threads.
"""

from __future__ import annotations

import collections
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import torch

__all__ = ["in_threads"]

_RANGES = 32  # per thread, enough that none waits long for the others

_pools: dict[int, ThreadPoolExecutor] = {}


def _begin_forked_process() -> None:
    """Forget the parent's threads, which do not exist here: ours, and PyTorch's own.

    PyTorch would wait for the latter forever; its DataLoader workers begin likewise.
    """
    _pools.clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_forked_process)


def in_threads(kernel: Callable[..., None], count: int, *arguments: Any, least: int) -> None:
    """Call ``kernel(first, last, *arguments)`` for ranges that make up ``range(count)``.

    Once this returns, or raises a kernel's error or KeyboardInterrupt, no thread writes any more.

    Args:
        kernel: compiled with `reference_trainer.compiled.compiling.kernel`.
        count: number of items.
        arguments: of the kernel, after the first two.
        least: number of items that is worth a range.
    """
    threads = torch.get_num_threads()
    size = max(least, -(-count // (_RANGES * threads)))
    if threads == 1 or count <= size:
        kernel(0, count, *arguments)
        return
    firsts = iter(range(0, count, size))  # shared: whoever is free takes the next

    def work() -> None:
        for first in firsts:
            kernel(first, min(first + size, count), *arguments)

    others: list[Future[None]] = []
    try:
        _start(work, threads - 1, others)
        work()
    finally:
        started = _finish(firsts, others)
    for other in started:
        other.result()  # raises what it raised


def _start(work: Callable[[], None], count: int, futures: list[Future[None]]) -> None:
    """Submit work to other threads; to none while the interpreter shuts down."""
    pool = _pools.get(count)
    if pool is None:
        pool = _pools.setdefault(count, ThreadPoolExecutor(count, thread_name_prefix="loops"))
    for _ in range(count):
        try:
            futures.append(pool.submit(work))
        except RuntimeError:
            return


def _finish(ranges: Iterator[int], futures: list[Future[None]]) -> list[Future[None]]:
    """Wait for all calls that have begun, despite Ctrl-C, and return them; the others never begin.

    Ranges that are left after an error or Ctrl-C are discarded.
    """
    interruption = None
    while True:
        try:
            collections.deque(ranges, maxlen=0)
            started = [future for future in futures if not future.cancel()]
            wait(started)
            break
        except KeyboardInterrupt as error:
            interruption = error
    if interruption is not None:
        raise interruption
    return started
