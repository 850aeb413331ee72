"""Random streams that depend on the seed and the step alone, and computing without any other chance."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

__all__ = ["deterministic", "stream", "view_order"]


def stream(seed: int, step: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the random generator of one purpose, such as ``"dropout"``, at one step; other purposes are independent.

    Example:
        >>> a, b = (torch.rand(3, generator=stream(0, 7, "dropout")) for _ in range(2))
        >>> torch.equal(a, b)
        True
    """
    # Hashed, so that streams of neighboring seeds and steps have nothing in common.
    letters = purpose.encode(errors="surrogatepass")  # it may hold the name of a file, which need not be UTF-8
    words = np.random.SeedSequence([seed, step, *letters]).generate_state(2, np.uint32)
    return torch.Generator(device=device).manual_seed(int(words[0]) << 32 | int(words[1]))


def view_order(seed: int, step: int, count: int) -> int:
    """Return which of ``count`` views to train on: every epoch visits each once, in an order of its own.

    Example:
        >>> sorted(view_order(0, step, 3) for step in range(3))
        [0, 1, 2]
    """
    epoch, position = divmod(step, count)
    return _epoch_order(seed, epoch, count)[position]


@functools.lru_cache(maxsize=8)
def _epoch_order(seed: int, epoch: int, count: int) -> list[int]:
    """Return the order of the views in an epoch, from that alone: a resumed run needs no state to continue in one."""
    order: list[int] = torch.randperm(count, generator=stream(seed, epoch, "views")).tolist()
    return order


@contextmanager
def deterministic(device: torch.device | str = "cpu") -> Iterator[None]:
    """Compute in one thread, and on CUDA with deterministic algorithms, within a block.

    Without this a run on a CPU repeats bit for bit with the same number of threads. With another number, some
    exponentials differ in their last bit, because the ends of a thread's share are computed by other instructions, and
    training amplifies that. On CUDA, sums by atomic additions differ from run to run; there, enter the block before the
    first computation of the process, which is when cuBLAS reads its settings. An operation without a deterministic
    algorithm raises a RuntimeError.

    Example:
        >>> with deterministic():
        ...     torch.get_num_threads()
        1
    """
    threads, algorithms = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
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
        torch.use_deterministic_algorithms(algorithms, warn_only=warn_only)
        torch.utils.deterministic.fill_uninitialized_memory = fill  # type: ignore[attr-defined]
