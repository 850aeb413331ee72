"""Running loops in parallel: ranges of a loop are handed to as many threads as PyTorch uses.

Kernels run without the GIL, so plain threads are enough. Unlike compilers' own thread pools they allow several threads
to call at once and processes to fork at any time (the child goes on with one thread), and ``OMP_NUM_THREADS`` and
`torch.set_num_threads` hold for them as for PyTorch. Every range writes to its own memory, and no sum crosses ranges:
results do not depend on the number of threads.
"""

from __future__ import annotations

import atexit
import collections
import contextlib
import os
import queue
import threading
from collections.abc import Callable, Iterator, Sized
from typing import Any

import torch

__all__ = ["in_threads"]

_RANGES = 32  # per thread, enough that none waits long for the others

# A SimpleQueue is written in C: unlike futures, it cannot be left locked by a Ctrl-C that comes at the wrong moment.
_Calls = queue.SimpleQueue[Callable[[], None] | None]  # None ends a thread
_calls: _Calls = queue.SimpleQueue()
_threads: list[threading.Thread] = []


def _begin_forked_process() -> None:
    """Forget the parent's threads, which do not exist here: ours, and PyTorch's own.

    PyTorch would wait for the latter forever; its DataLoader workers begin likewise.
    """
    global _calls
    _calls = queue.SimpleQueue()
    _threads.clear()
    torch.set_num_threads(1)


@atexit.register
def _end_threads() -> None:
    """End the threads before the interpreter takes itself apart.

    A thread that then still wants the GIL is unwound wherever it stands, which has aborted processes at their very end.
    The list stays full, so that none is started again; whoever calls later does the work alone.
    """
    for _ in _threads:
        _calls.put(None)
    for thread in _threads:
        thread.join()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_forked_process)


def in_threads(kernel: Callable[..., None], count: int, *arguments: Any, least: int) -> None:
    """Call ``kernel(first, last, *arguments)`` for ranges of at least ``least`` items that make up ``range(count)``.

    Once this returns, or raises a kernel's error or KeyboardInterrupt, no thread writes any more.
    """
    threads = torch.get_num_threads()
    size = max(least, -(-count // (_RANGES * threads)))
    if threads == 1 or count <= size:
        kernel(0, count, *arguments)
        return
    firsts = iter(range(0, count, size))  # shared: whoever is free takes the next
    begun: list[None] = []
    ended: list[BaseException | None] = []
    bell: queue.SimpleQueue[None] = queue.SimpleQueue()

    def work() -> None:
        begun.append(None)  # before it takes a range: whoever is not among these will find none
        error = None
        try:
            for first in firsts:
                kernel(first, min(first + size, count), *arguments)
        except BaseException as raised:
            error = raised
        ended.append(error)
        bell.put(None)

    try:
        _hand_out(work, threads - 1)
        for first in firsts:
            kernel(first, min(first + size, count), *arguments)
    finally:
        _finish(firsts, begun, ended, bell)
    for error in filter(None, ended):
        raise error


def _hand_out(work: Callable[[], None], count: int) -> None:
    """Ask so many other threads to work; none begins while the interpreter shuts down."""
    while len(_threads) < count:
        thread = threading.Thread(target=_serve, args=(_calls,), name=f"loops_{len(_threads)}", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            return
        _threads.append(thread)
    for _ in range(count):
        _calls.put(work)


def _serve(calls: _Calls) -> None:
    """Do what is asked for, until the end."""
    while (call := calls.get()) is not None:
        call()


def _finish(ranges: Iterator[int], begun: Sized, ended: Sized, bell: queue.SimpleQueue[None]) -> None:
    """Discard the ranges that are left after an error or Ctrl-C, and wait for all that have begun, despite Ctrl-C."""
    interruption = None
    while True:
        try:
            collections.deque(ranges, maxlen=0)
            while len(ended) < len(begun):
                with contextlib.suppress(queue.Empty):
                    bell.get(timeout=0.05)  # a ring may be lost to Ctrl-C
            break
        except KeyboardInterrupt as error:
            interruption = error
    if interruption is not None:
        raise interruption
