"""Backward passes that keep their precision wherever they are called."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch

__all__ = ["without_autocast"]

T = TypeVar("T")


def without_autocast(backward: Callable[..., T]) -> Callable[..., T]:
    """Make the backward pass of an autograd function compute in the precision of what it saved.

    PyTorch asks to call ``backward()`` outside of ``torch.autocast``. Inside, the products of a backward pass would be
    computed in 16 bits without a word.

    Args:
        backward: static method of a ``torch.autograd.Function`` that saved tensors.
    """

    @functools.wraps(backward)
    def guarded(ctx: Any, *gradients: torch.Tensor) -> T:
        with torch.autocast(gradients[0].device.type, enabled=False):
            return backward(ctx, *gradients)

    return guarded
