"""A Ray cluster as an executor: a temporary one on this machine, or a running one at an address."""

from __future__ import annotations

import os
from typing import Any

from reference_trainer.runs.executors.executor import Answer, Death, Failure, Task, attempt
from reference_trainer.threads import chosen_threads

__all__ = ["RayCluster"]

_OBJECT_STORE = 128 * 2**20  # bytes; answers are small, and by default Ray takes a third of the memory
_PATIENCE = 60.0  # seconds for the runs to save their checkpoints


class RayCluster:
    """Runs every task as a Ray task with reserved processors.

    Needs Ray (``ca_reg[ray]``). On a cluster of several machines all need the same installation, and a file system that
    they share with this machine under the same path.

    Args:
        jobs: tasks at a time; each reserves its share of the cluster's processors, at most those of one machine.
        address: of a running cluster, as for `ray.init`: ``"host:6379"``, ``"ray://host:10001"``, or ``"auto"`` for the
            one that this machine belongs to. None for ``$RAY_ADDRESS``, or if that is unset for a cluster on this
            machine that ends with the sweep.
        gpus: GPUs that a task reserves; fractions share one.

    Raises:
        ValueError: if ``jobs`` is not positive.
        ImportError: if Ray is not installed.
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
