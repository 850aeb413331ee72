"""Where the runs of a sweep execute: processes on this machine or a Ray cluster, behind one protocol."""

from __future__ import annotations

import os
from typing import Literal, TypeAlias

from reference_trainer.runs.executors.executor import Executor
from reference_trainer.runs.executors.processes import Processes
from reference_trainer.runs.executors.ray_cluster import RayCluster

__all__ = ["ExecutorName", "choose_executor"]

ExecutorName: TypeAlias = Literal["auto", "processes", "ray"]


def choose_executor(name: ExecutorName, *, jobs: int, address: str | None = None, device: str = "cpu") -> Executor:
    """Return the executor of the given name.

    Args:
        name: ``"auto"`` is Ray if ``address`` or ``$RAY_ADDRESS`` names a cluster, else local processes: on a single
            machine Ray has no advantage over them.
        jobs: tasks at a time.
        address: of a Ray cluster; see `RayCluster`.
        device: where the tasks compute; on a Ray cluster a task on ``"cuda"`` reserves one GPU.

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
