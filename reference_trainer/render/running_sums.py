"""Running sums that can be repeated to the last bit on every device."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["running_sums_"]


def running_sums_(x: Tensor) -> Tensor:
    """Replace the numbers of a tensor by their running sums along the last dimension, in place, and return it.

    `torch.cumsum` has no algorithm on CUDA that repeats itself, and is an error where one is asked for. There, and only
    there, whole shifted copies are added, log2 L times: slower, and every sum has a fixed order.

    Args:
        x: floating point, shape (..., L).

    Example:
        >>> running_sums_(torch.tensor([1.0, 2.0, 3.0]))
        tensor([1., 3., 6.])
    """
    if x.device.type == "cpu" or not torch.are_deterministic_algorithms_enabled():
        return x.cumsum_(-1)
    step = 1
    while step < x.shape[-1]:
        x[..., step:] += x[..., :-step].clone()
        step *= 2
    return x
