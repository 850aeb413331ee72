"""Where random numbers come from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

__all__ = ["draw_numbers", "seeded"]


def draw_numbers(
    sample: Callable[..., Tensor], n: int, generator: torch.Generator | None, device: torch.device | str | None
) -> Tensor:
    """Return n float32 numbers of ``torch.rand`` or ``torch.randn``, drawn where the generator is.

    Raises a RuntimeError if they are drawn from one while gradients are computed: they would be other ones.
    """
    if generator is not None and torch._C._current_graph_task_id() != -1:
        raise RuntimeError(
            "a draw with generator= was repeated during backward(): torch.utils.checkpoint restores the global random "
            "state and no other, so the gradient would be that of another draw. Draw outside the checkpointed function "
            "and give it keep= or noise=, or leave out generator."
        )
    x = sample(n, generator=generator, dtype=torch.float32, device=device if generator is None else generator.device)
    return x if device is None else x.to(device)


def seeded(*entropy: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator whose numbers follow from integers of at least 0, and differ with each of them."""
    (word,) = np.random.SeedSequence(entropy).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(word) >> 1)
