"""Render with other opacities than the model's, past all regularizers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any

from torch import Tensor

from ._patch import ClassPatch
from ._rasterizer import ForwardCall, forward_signature

__all__ = ["is_overridden", "override"]

_overridden: ContextVar[bool] = ContextVar("_overridden", default=False)


def is_overridden() -> bool:
    """Whether an override is in force, which no regularizer must change."""
    return _overridden.get()


@contextmanager
def override(rasterizers: Sequence[type], opacity: Tensor) -> Iterator[list[tuple[ForwardCall, Any]]]:
    """Give the rasterizers these opacities in place of those that they are called with.

    Args:
        rasterizers: their classes.
        opacity: activated, of all Gaussians, shape (N,) or (N, 1).

    Yields:
        The calls so far, each with what it returned.
    """
    calls: list[tuple[ForwardCall, Any]] = []

    def make(rasterizer: type, forward: Callable[..., Any]) -> Callable[..., Any]:
        signature = forward_signature(rasterizer)

        @functools.wraps(forward)
        def with_other_opacities(*args: Any, **kwargs: Any) -> Any:
            call = ForwardCall(forward, signature.bind(*args, **kwargs))
            given = call.arguments["opacities"]
            if given.numel() != opacity.numel():
                raise ValueError(
                    f"render rasterizes {given.numel()} Gaussians, but {opacity.numel()} opacities were given; "
                    "give those of all Gaussians, and switch off any dropout of its own."
                )
            call.arguments["opacities"] = opacity.reshape(given.shape)
            returned = call()
            calls.append((call, returned))
            return returned

        return with_other_opacities

    token = _overridden.set(True)
    try:
        with ExitStack() as undo:
            for rasterizer in rasterizers:
                undo.callback(ClassPatch(rasterizer, "forward", functools.partial(make, rasterizer)).remove)
            yield calls
    finally:
        _overridden.reset(token)
