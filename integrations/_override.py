"""Render with other opacities than the model's, past all regularizers."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

from torch import Tensor

from ._patch import ClassPatch
from ._rasterizer import ForwardCall, forward_signature

__all__ = ["is_overridden", "override"]


class _Override(NamedTuple):
    """What is in force in one thread: for which rasterizers, with which opacities, and the calls so far."""

    rasterizers: tuple[type, ...]
    opacity: Tensor
    calls: list[ForwardCall]


_current: ContextVar[_Override | None] = ContextVar("_current", default=None)
_lock = threading.Lock()
_patches: dict[type, tuple[ClassPatch, int]] = {}  # of every class, and how many overrides need it


def is_overridden() -> bool:
    """Whether this thread renders with other opacities, which no regularizer must change."""
    return _current.get() is not None


@contextmanager
def override(rasterizers: Sequence[type], opacity: Tensor) -> Iterator[list[ForwardCall]]:
    """Give the rasterizers these opacities in place of those that this thread calls them with.

    The classes are patched once for all threads, and put back when the last of them is done; renders of other threads
    go through unchanged. The opacities are activated, of all Gaussians, (N,) or (N, 1). Yields the calls so far.
    """
    mine = _Override(tuple(rasterizers), opacity, [])
    with ExitStack() as undo:
        for rasterizer in mine.rasterizers:
            _acquire(rasterizer)
            undo.callback(_release, rasterizer)
        token = _current.set(mine)
        undo.callback(_current.reset, token)
        yield mine.calls


def _acquire(rasterizer: type) -> None:
    """Patch a class unless another thread has."""
    with _lock:
        patch, users = _patches.get(rasterizer) or (ClassPatch(rasterizer, "forward", _make(rasterizer)), 0)
        _patches[rasterizer] = patch, users + 1


def _release(rasterizer: type) -> None:
    """Put a class back unless another thread needs it."""
    with _lock:
        patch, users = _patches[rasterizer]
        if users > 1:
            _patches[rasterizer] = patch, users - 1
        else:
            patch.remove()
            del _patches[rasterizer]


def _make(rasterizer: type) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return what wraps the forward of a class."""
    signature = forward_signature(rasterizer)

    def make(forward: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(forward)
        def with_other_opacities(*args: Any, **kwargs: Any) -> Any:
            mine = _current.get()
            if mine is None or rasterizer not in mine.rasterizers:
                return forward(*args, **kwargs)
            call = ForwardCall(forward, signature.bind(*args, **kwargs))
            given = call.arguments["opacities"]
            if given.numel() != mine.opacity.numel():
                raise ValueError(
                    f"render rasterizes {given.numel()} Gaussians, but {mine.opacity.numel()} opacities were given; "
                    "give those of all Gaussians, and switch off any dropout of its own."
                )
            call.arguments["opacities"] = mine.opacity.reshape(given.shape)
            mine.calls.append(call)
            return call()

        return with_other_opacities

    return make
