"""The processes of this machine as an engine: one process per task, so that a death is the death of one task."""

from __future__ import annotations

import _thread
import os
import signal
import threading
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from reference_trainer.runs.engines.engine import Answer, Death, Task, attempt
from reference_trainer.threads import thread_count

__all__ = ["Processes"]

# Forked copies of a process that has used threads, as torch has, can hang.
_CONTEXT = get_context("spawn")


class Processes:
    """Every task in a new process of this machine, which ends with the task.

    A worker that loses its parent, however the parent ended, is interrupted as by Ctrl-C: the training saves a
    checkpoint and ends. Ctrl-C itself reaches the parent alone, which tells the workers once; a second one kills them.

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
        self._running: dict[Any, tuple[int, SpawnProcess]] = {}  # by the end of a pipe, whose class the system decides

    def start(self, number: int, task: Task) -> None:
        """Begin a task; see `Engine`."""
        here, there = _CONTEXT.Pipe()
        process = _CONTEXT.Process(target=_work, args=(there, task, self._threads), name=task.label)
        process.start()
        there.close()  # the worker's copy must be the last one: its death is the end of the pipe
        self._running[here] = number, process

    def wait(self) -> list[tuple[int, Answer]]:
        """Wait for at least one task; see `Engine`."""
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
        """Interrupt what still runs and wait for it; a second interruption kills it."""
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
    """Do one task in a process of its own and send the answer."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # out of the terminal's group: a Ctrl-C that came twice would not wait for the checkpoint
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a parent in the background may ignore
    answered = threading.Event()
    threading.Thread(target=_end_with_parent, args=(there, answered), daemon=True).start()
    try:
        answer = attempt(task, threads)
        answered.set()
        there.send(answer)
    except (KeyboardInterrupt, BrokenPipeError):
        pass  # nobody waits for the answer any more


def _end_with_parent(there: Connection, answered: threading.Event) -> None:
    """Interrupt the task when the parent closes its end of the pipe, or dies; the parent never sends anything."""
    try:
        there.recv()
    except (EOFError, OSError):
        if not answered.is_set():
            if os.name == "posix":
                os.kill(os.getpid(), signal.SIGINT)  # unlike interrupt_main, it also ends a wait in the system
            else:
                _thread.interrupt_main()


def _reason(code: int | None) -> str:
    """Return how a worker ended, given its exit code."""
    if code is not None and code < 0:
        hint = ", as the system does when memory runs out" if -code == 9 else ""
        return f"the worker was killed by {signal.Signals(-code).name}{hint}"
    return f"the worker ended with exit code {code} and no answer"
