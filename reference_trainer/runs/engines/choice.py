"""The choice of a sweep's engine."""

from __future__ import annotations

import os
from typing import Literal, TypeAlias

from reference_trainer.runs.engines.engine import Engine
from reference_trainer.runs.engines.processes import Processes
from reference_trainer.runs.engines.ray_cluster import RayCluster

__all__ = ["EngineName", "choose_engine"]

EngineName: TypeAlias = Literal["auto", "processes", "ray"]


def choose_engine(name: EngineName, *, jobs: int, address: str | None = None, device: str = "cpu") -> Engine:
    """Return the engine of the given name.

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
        >>> choose_engine("processes", jobs=2).jobs
        2
    """
    if name == "processes" and address is not None:
        raise ValueError(f"--address {address} is that of a Ray cluster: use --executor ray, or leave the address out.")
    if name == "ray" or (name == "auto" and (address or os.environ.get("RAY_ADDRESS"))):
        return RayCluster(jobs, address=address, gpus=1.0 if device.startswith("cuda") else 0.0)
    return Processes(jobs)
