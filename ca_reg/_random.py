"""Random numbers: draws from an optional generator, and seeded generators."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor


def draw_numbers(
    sample: Callable[..., Tensor], n: int, generator: torch.Generator | None, device: torch.device | str | None
) -> Tensor:
    """Return n float32 numbers of ``torch.rand`` or ``torch.randn``, drawn on the generator's device if one is given.

    A generator need not be on the device of the Gaussians: that of a score is on the CPU, so that its masks are the
    same on every device. Without a generator, the global one of ``device`` is taken.

    Raises:
        RuntimeError: if a generator is used during a backward pass, where a recomputed draw would differ.

    Example:
        >>> draw_numbers(torch.rand, 3, torch.Generator().manual_seed(0), "cpu")
        tensor([0.4963, 0.7682, 0.0885])
    """
    if generator is not None and torch._C._current_graph_task_id() != -1:
        raise RuntimeError(
            "a draw with generator= was repeated during backward(): torch.utils.checkpoint restores the global random "
            "state and no other, so the gradient would be that of another draw. Draw outside the checkpointed function "
            "and give it drawn=, or leave out generator."
        )
    if generator is None:  # and unnamed: a compiled graph could not draw for a number of Gaussians that changes
        return sample(n, dtype=torch.float32, device=device)
    x = sample(n, generator=generator, dtype=torch.float32, device=generator.device)
    return x if device is None else x.to(device)


def seeded(*entropy: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator seeded by all of these non-negative integers."""
    (word,) = np.random.SeedSequence(entropy).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(word) >> 1)
