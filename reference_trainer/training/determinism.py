"""Computing so that the result depends on the seed and the machine alone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["deterministic"]


@contextmanager
def deterministic(device: torch.device | str = "cpu") -> Iterator[None]:
    """Compute in one thread, and on CUDA with the algorithms that repeat themselves; afterwards as before.

    Without this a run on a CPU repeats bit for bit with the same number of threads. With another number single results
    of an exponential differ in their last bit, because the ends of a thread's share are computed by other instructions,
    and training amplifies that. On CUDA sums by atomic additions differ from run to run.

    Args:
        device: where is computed. On CUDA this is to be entered before the first computation of the process, which is
            when cuBLAS reads its settings.

    Raises:
        RuntimeError: from within, on CUDA, if an operation has no algorithm that repeats itself.

    Example:
        >>> with deterministic():
        ...     torch.get_num_threads()
        1
    """
    threads, algorithms = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory  # type: ignore[attr-defined]
    torch.set_num_threads(1)
    if torch.device(device).type != "cpu":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True)
        # All buffers are written before they are read.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(algorithms)
        torch.utils.deterministic.fill_uninitialized_memory = fill  # type: ignore[attr-defined]
