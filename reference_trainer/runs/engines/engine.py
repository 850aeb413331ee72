"""The interface between a sweep and where it runs: tasks, their outcomes, and the protocol of an engine."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

__all__ = ["Answer", "Death", "Engine", "Failure", "Task", "Value", "attempt"]


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


class Engine(Protocol):
    """Starts calls in other processes and reports how they ended; `run_all` queues and retries, for every engine.

    An engine serves one sweep after another. It starts nothing before the first task of each, so a sweep with nothing
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
