"""Local processes as an executor: one process per task, so that a death affects one task only."""

from __future__ import annotations

import _thread
import os
import signal
import threading
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from reference_trainer.runs.executors.executor import Answer, Death, Task, attempt
from reference_trainer.threads import thread_count

__all__ = ["Processes"]

# A process forked after threads have been used, as by torch, can hang.
_CONTEXT = get_context("spawn")


class Processes:
    """Runs every task in a new local process, which ends with the task.

    A worker that loses its parent, however the parent ended, is interrupted as by Ctrl-C: the training saves a
    checkpoint and ends. Ctrl-C itself reaches only the parent, which interrupts its workers; a second one kills them.

    Args:
        jobs: tasks at a time; each may use its share of the processors, or ``OMP_NUM_THREADS`` if that is set.

    Raises:
        ValueError: if ``jobs`` is not positive.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise ValueError(f"expected at least 1 job, got {jobs}.")
        self.jobs = jobs
        self._threads = thread_count(jobs=jobs)
        self._running: dict[Any, tuple[int, SpawnProcess]] = {}  # by pipe end, whose class depends on the platform

    def start(self, number: int, task: Task) -> None:
        """Start a task; see `Executor`."""
        here, there = _CONTEXT.Pipe()
        process = _CONTEXT.Process(target=_work, args=(there, task, self._threads), name=task.label)
        process.start()
        there.close()  # so that the worker holds the only copy, and its death closes the pipe
        self._running[here] = number, process

    def wait(self) -> list[tuple[int, Answer]]:
        """Wait for at least one task; see `Executor`."""
        ended: list[tuple[int, Answer]] = []
        answering: list[Any] = wait([*self._running])
        for here in answering:
            number, process = self._running.pop(here)
            try:
                answer: Answer | None = here.recv()
            except (EOFError, OSError):
                answer = None
            here.close()
            process.join()
            ended.append((number, Death(_reason(process.exitcode)) if answer is None else answer))
        return ended

    def close(self) -> None:
        """Interrupt running tasks and wait for them; a second interruption kills them."""
        for here in self._running:
            here.close()
        processes = [process for _, process in self._running.values()]
        self._running.clear()
        try:
            for process in processes:
                process.join()
        except BaseException:
            for process in processes:
                process.kill()
            raise


def _work(there: Connection, task: Task, threads: int) -> None:
    """Execute one task in the worker process and send the answer."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # out of the terminal's group: a second interrupt from there would cut off the checkpoint
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background parent may ignore it
    answered = threading.Event()
    threading.Thread(target=_end_with_parent, args=(there, answered), daemon=True).start()
    try:
        answer = attempt(task, threads)
        answered.set()
        there.send(answer)
    except (KeyboardInterrupt, BrokenPipeError):
        pass  # nobody is waiting for the answer anymore


def _end_with_parent(there: Connection, answered: threading.Event) -> None:
    """Interrupt the task when the parent closes its end of the pipe, or dies; the parent never sends anything."""
    try:
        there.recv()
    except (EOFError, OSError):
        if not answered.is_set():
            if os.name == "posix":
                os.kill(os.getpid(), signal.SIGINT)  # unlike interrupt_main, also ends a blocking system call
            else:
                _thread.interrupt_main()


def _reason(code: int | None) -> str:
    """Return how a worker ended, given its exit code."""
    if code is not None and code < 0:
        hint = ", as the system does when memory runs out" if -code == 9 else ""
        return f"the worker was killed by {signal.Signals(-code).name}{hint}"
    return f"the worker ended with exit code {code} and no answer"
