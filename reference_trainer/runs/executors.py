"""Where the runs of a sweep execute: processes of this machine or a Ray cluster, behind one protocol and one queue."""

from __future__ import annotations

import _thread
import logging
import os
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Literal, Protocol, TypeAlias

from reference_trainer.threads import chosen_threads, thread_count

__all__ = [
    "Answer", "Death", "Executor", "ExecutorName", "Failure", "Processes", "RayCluster", "Task", "Value", "attempt",
    "choose_executor", "run_all",
]  # fmt: skip

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """A call to be made in another process, perhaps on another machine; ``label`` names it in messages.

    The function is importable there by module and name, and its arguments are picklable.
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
    """The call raised, or all its workers died."""

    error: str  # type and message of the exception, or how the last worker died
    traceback: str  # where it was raised; empty if the workers died


@dataclass(frozen=True)
class Death:
    """The worker died without an answer; the call itself may be fine. The reason is what is known of it."""

    reason: str


Answer: TypeAlias = Value | Failure | Death


class Executor(Protocol):
    """Starts calls in other processes and reports how they ended; `run_all` queues and retries, for every executor.

    An executor serves one sweep after another, and starts nothing before the first task of each.
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
    """Execute a task in the worker, on so many threads, and return an exception as a `Failure`.

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
    a task that kills its workers, of which ``retries`` are replaced, does not delay the others. The executor is closed
    also if the caller stops iterating or is interrupted. Yields the index of a task, and its outcome.
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
                    of = f"{deaths[number]} of {retries}"
                    _log.warning("%s: %s; again with another (%s)", tasks[number].label, answer.reason, of)
                    queue.append(number)
                else:
                    times = f" ({retries + 1} workers died)" if retries else ""
                    yield number, Failure(f"{answer.reason}{times}", "")
    finally:
        executor.close()


_CONTEXT = get_context("spawn")  # a process forked after threads have been used, as by torch, can hang


class Processes:
    """Runs every task in a new local process, which ends with the task.

    A worker that loses its parent, however the parent ended, is interrupted as by Ctrl-C: the training saves a
    checkpoint and ends. Ctrl-C itself reaches only the parent, which interrupts its workers; a second one kills them.
    Each of ``jobs`` tasks at a time may use its share of the processors, or ``OMP_NUM_THREADS`` if that is set. Raises
    ValueError if ``jobs`` is not positive.
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
            answer: Answer | None = None
            with here, suppress(EOFError, OSError):  # as when the worker has died
                answer = here.recv()
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
    with suppress(EOFError, OSError):
        there.recv()
    if answered.is_set():
        return
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


_OBJECT_STORE = 128 * 2**20  # bytes; answers are small, and by default Ray takes a third of the memory
_PATIENCE = 60.0  # seconds for the runs to save their checkpoints


class RayCluster:
    """Runs every task as a Ray task with reserved processors.

    Needs Ray (``ca_reg[ray]``). On a cluster of several machines all need the same installation, and a file system that
    they share with this machine under the same path.

    Of ``jobs`` tasks at a time, each reserves its share of the cluster's processors, at most those of one machine, and
    so many ``gpus``; fractions share one. ``address`` names a running cluster, as for `ray.init`: ``"host:6379"``,
    ``"ray://host:10001"``, or ``"auto"`` for the one that this machine belongs to; by default ``$RAY_ADDRESS``, or if
    that is unset a cluster on this machine that ends with the sweep. Raises ValueError if ``jobs`` is not positive, and
    ImportError if Ray is not installed.
    """

    def __init__(self, jobs: int, *, address: str | None = None, gpus: float = 0.0) -> None:
        if jobs < 1:
            raise ValueError(f"expected at least 1 job, got {jobs}.")
        try:
            import ray
        except ImportError as error:
            raise ImportError(
                "running on Ray needs Ray: pip install 'ca_reg[ray]'; --executor processes does without."
            ) from error
        self.jobs = jobs
        self._address = address or os.environ.get("RAY_ADDRESS") or "local"
        self._gpus = gpus
        self._ray: Any = ray
        self._mine = False
        self._attempt: Any = None
        self._threads = 1
        self._running: dict[Any, int] = {}

    def start(self, number: int, task: Task) -> None:
        """Start a task; see `Executor`."""
        if self._attempt is None:
            self._connect()
        self._running[self._attempt.options(name=task.label).remote(task, self._threads)] = number

    def wait(self) -> list[tuple[int, Answer]]:
        """Wait for at least one task; see `Executor`."""
        ended, _ = self._ray.wait(list(self._running))
        return [(self._running.pop(reference), self._answer(reference)) for reference in ended]

    def close(self) -> None:
        """Interrupt running tasks, wait up to a minute for them, and leave the cluster; a temporary one ends."""
        for reference in self._running:
            self._ray.cancel(reference)
        if self._running:
            self._ray.wait(list(self._running), num_returns=len(self._running), timeout=_PATIENCE)
        self._running.clear()
        self._attempt = None
        if self._mine:
            self._ray.shutdown()
            self._mine = False

    def _connect(self) -> None:
        """Join the cluster or start one, and compute how many processors a task gets."""
        ray = self._ray
        if not ray.is_initialized():  # else the caller has connected already, and also disconnects
            local: dict[str, Any] = {}
            if self._address == "local":
                os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry from a local sweep
                # The user may ask for more jobs than processors; Ray would wait for the missing ones forever.
                local = {"num_cpus": max(self.jobs, os.cpu_count() or 1), "object_store_memory": _OBJECT_STORE,
                         "include_dashboard": False}  # fmt: skip
            ray.init(address=self._address, log_to_driver=False, logging_level="warning", **local)
            self._mine = True
        machines = [node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]]
        share = min(sum(machines) // self.jobs, max(machines, default=1.0))
        processors = max(1, int(share))
        self._threads = chosen_threads() or processors
        # Ray's own retries are off: `run_all` retries, counts and reports alike for every executor.
        self._attempt = ray.remote(num_cpus=processors, num_gpus=self._gpus, max_retries=0)(attempt)

    def _answer(self, reference: Any) -> Answer:
        """Return the answer of an ended task, or how its worker died."""
        exceptions = self._ray.exceptions
        try:
            answer: Answer = self._ray.get(reference)
        except exceptions.RayTaskError as error:  # raised outside the call, such as on a machine without this package
            first, *_ = str(error.cause).splitlines() or [""]
            return Failure(f"{type(error.cause).__name__}: {first}", str(error))
        except exceptions.RayError as error:
            sentence = " ".join(str(error).split()).partition(". ")[0]
            return Death(f"the worker died ({type(error).__name__}: {sentence})")
        return answer


ExecutorName: TypeAlias = Literal["auto", "processes", "ray"]


def choose_executor(name: ExecutorName, *, jobs: int, address: str | None = None, device: str = "cpu") -> Executor:
    """Return the executor of the given name, for so many tasks at a time.

    ``"auto"`` is Ray if ``address`` or ``$RAY_ADDRESS`` names a cluster, else local processes: on a single machine Ray
    has no advantage over them. On a Ray cluster a task on the device ``"cuda"`` reserves one GPU.

    Raises:
        ValueError: if ``"processes"`` is given an address, or ``jobs`` is not positive.
        ImportError: if Ray is needed and not installed.

    Example:
        >>> choose_executor("processes", jobs=2).jobs
        2
    """
    if name == "processes" and address is not None:
        raise ValueError(f"--address {address} is that of a Ray cluster: use --executor ray, or leave the address out.")
    if name == "ray" or (name == "auto" and (address or os.environ.get("RAY_ADDRESS"))):
        return RayCluster(jobs, address=address, gpus=1.0 if device.startswith("cuda") else 0.0)
    return Processes(jobs)
