"""What a sweep asks of the place where it runs: a task, what may come of it, and the protocol of an engine."""

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
        function: found there by its module and name.
        arguments: its arguments, which can be pickled.
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
    """The call raised, or none of its workers lived to answer.

    Args:
        error: type and message in one line.
        traceback: where it was raised; empty if no worker lived to say.
    """

    error: str
    traceback: str


@dataclass(frozen=True)
class Death:
    """The worker ended without an answer, which says nothing about the call itself.

    Args:
        reason: what is known, such as the signal.
    """

    reason: str


Answer: TypeAlias = Value | Failure | Death


class Engine(Protocol):
    """Starts calls elsewhere and tells how they ended. It neither queues nor retries: `run_all` does, for every engine.

    An engine is good for one sweep. Nothing is started before the first task: a sweep with nothing left to do costs
    nothing.
    """

    @property
    def jobs(self) -> int:
        """How many tasks may run at a time; each gets its share of the processors."""

    def start(self, number: int, task: Task) -> None:
        """Begin a task under a number of the caller's choice."""

    def wait(self) -> Sequence[tuple[int, Answer]]:
        """Wait until at least one of the tasks that were started ends; return those that did, by number."""

    def close(self) -> None:
        """Ask tasks that still run to save what they have, wait for them, and release everything."""


def attempt(task: Task, threads: int) -> Value | Failure:
    """Make the call of a task, in the worker; an error becomes data.

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
    import torch  # which the options of the command line, that name the engines, do without

    torch.set_num_threads(threads)
    try:
        return Value(task.function(*task.arguments))
    except Exception as error:  # one failing run must not stop the others; it is reported
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc())
