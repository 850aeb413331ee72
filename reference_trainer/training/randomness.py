"""Random streams that depend on the seed and the step alone, so that a resumed run draws what it would have drawn."""

from __future__ import annotations

import numpy as np
import torch

__all__ = ["stream", "view_order"]


def stream(seed: int, step: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the random generator for one purpose at one step.

    Args:
        seed: of the run, not negative.
        step: not negative.
        purpose: a label, such as ``"dropout"``; different labels give independent streams.
        device: of the numbers to be drawn.

    Example:
        >>> a, b = (torch.rand(3, generator=stream(0, 7, "dropout")) for _ in range(2))
        >>> torch.equal(a, b)
        True
    """
    words = np.random.SeedSequence([seed, step, *purpose.encode()]).generate_state(2, np.uint32)
    return torch.Generator(device=device).manual_seed(int(words[0]) << 32 | int(words[1]))


def view_order(seed: int, step: int, count: int) -> int:
    """Return which of ``count`` views to train on: every epoch visits each once, in an order of its own.

    Example:
        >>> sorted(view_order(0, step, 3) for step in range(3))
        [0, 1, 2]
    """
    epoch, position = divmod(step, count)
    order = torch.randperm(count, generator=stream(seed, epoch, "views"))
    return int(order[position])
