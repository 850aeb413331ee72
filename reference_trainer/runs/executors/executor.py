"""Where the runs of a sweep execute: the protocol of an executor, and the queue that every executor serves."""

from __future__ import annotations

import logging
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

__all__ = ["Answer", "Death", "Executor", "Failure", "Task", "Value", "attempt", "run_all"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """A call to be made in another process, perhaps on another machine.

    Args:
        label: what to call it in messages.
        function: importable there by module and name.
        arguments: its arguments, picklable.
    """

    label: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Value:
    """The call returned."""

    value: Any


@dataclass(frozen=True)
class Failure:
    """The call raised, or all its workers died.

    Args:
        error: type and message of the exception, or how the last worker died.
        traceback: where it was raised; empty if the workers died.
    """

    error: str
    traceback: str


@dataclass(frozen=True)
class Death:
    """The worker died without an answer; the call itself may be fine.

    Args:
        reason: what is known, such as the signal.
    """

    reason: str


Answer: TypeAlias = Value | Failure | Death


class Executor(Protocol):
    """Starts calls in other processes and reports how they ended; `run_all` queues and retries, for every executor.

    An executor serves one sweep after another. It starts nothing before the first task of each, so a sweep with nothing
    left to do is free.
    """

    @property
    def jobs(self) -> int:
        """How many tasks may run at a time; each gets its share of the processors."""

    def start(self, number: int, task: Task) -> None:
        """Start a task under a number of the caller's choice."""

    def wait(self) -> Sequence[tuple[int, Answer]]:
        """Wait until at least one started task ends; return the ended ones by number."""

    def close(self) -> None:
        """Interrupt running tasks, which save what they have; wait for them, and release everything."""


def attempt(task: Task, threads: int) -> Value | Failure:
    """Execute a task in the worker, and return an exception as a `Failure`.

    Args:
        task: what to call.
        threads: how many threads torch may use.

    Example:
        >>> import torch
        >>> attempt(Task("eight", int, ("8",)), torch.get_num_threads())
        Value(value=8)
        >>> attempt(Task("many", int, ("many",)), torch.get_num_threads()).error
        "ValueError: invalid literal for int() with base 10: 'many'"
    """
    import torch  # not at the top: the command line imports this module for its options alone

    torch.set_num_threads(threads)
    try:
        return Value(task.function(*task.arguments))
    except Exception as error:  # one failing run must not stop the others
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc())


def run_all(executor: Executor, tasks: Sequence[Task], *, retries: int = 3) -> Iterator[tuple[int, Value | Failure]]:
    """Run tasks on an executor; yield the outcomes in the order in which they end, and close the executor.

    A task that raises is not retried: it would raise again. One whose worker died goes to the end of the queue, so that
    a task that kills its workers does not delay the others.

    Args:
        executor: where to run; closed at the end, also if the caller stops iterating or is interrupted.
        tasks: what to run.
        retries: how many dead workers of one task are replaced.

    Yields:
        The index of a task, and its outcome.
    """
    queue = deque(range(len(tasks)))
    running = 0
    deaths: Counter[int] = Counter()
    try:
        while queue or running:
            while queue and running < executor.jobs:
                number = queue.popleft()
                executor.start(number, tasks[number])
                running += 1
            for number, answer in executor.wait():
                running -= 1
                if not isinstance(answer, Death):
                    yield number, answer
                elif deaths[number] < retries:
                    deaths[number] += 1
                    again = f"again with another ({deaths[number]} of {retries})"
                    _log.warning("%s: %s; %s", tasks[number].label, answer.reason, again)
                    queue.append(number)
                else:
                    times = f" ({retries + 1} workers died)" if retries else ""
                    yield number, Failure(f"{answer.reason}{times}", "")
    finally:
        executor.close()
