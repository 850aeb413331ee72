"""Making results depend on the seed and the machine alone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["deterministic"]


@contextmanager
def deterministic(device: torch.device | str = "cpu") -> Iterator[None]:
    """Compute in one thread, and on CUDA with deterministic algorithms, within a block.

    Without this a run on a CPU repeats bit for bit with the same number of threads. With another number, some
    exponentials differ in their last bit, because the ends of a thread's share are computed by other instructions, and
    training amplifies that. On CUDA, sums by atomic additions differ from run to run.

    Args:
        device: where to compute. On CUDA, enter the block before the first computation of the process, which is when
            cuBLAS reads its settings.

    Raises:
        RuntimeError: from within, on CUDA, if an operation has no deterministic algorithm.

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
        # Not needed: all buffers are written before they are read.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(algorithms)
        torch.utils.deterministic.fill_uninitialized_memory = fill  # type: ignore[attr-defined]
