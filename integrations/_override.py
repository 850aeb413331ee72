"""Render with opacities other than the model's, bypassing all regularizers."""

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
    """The override of one thread: its rasterizers, its opacities, and the calls so far."""

    rasterizers: tuple[type, ...]
    opacity: Tensor
    calls: list[ForwardCall]


_current: ContextVar[_Override | None] = ContextVar("_current", default=None)
_lock = threading.Lock()
_patches: dict[type, tuple[ClassPatch, int]] = {}  # patch and number of active overrides of every class


def is_overridden() -> bool:
    """Whether this thread renders with overridden opacities, which regularizers must not change."""
    return _current.get() is not None


@contextmanager
def override(rasterizers: Sequence[type], opacity: Tensor) -> Iterator[list[ForwardCall]]:
    """Replace the opacities that this thread passes to the rasterizers.

    The classes are patched once for all threads, and restored when the last override ends; renders of other threads are
    unchanged. The opacities are activated, of all Gaussians, (N,) or (N, 1). Yields the list of calls so far.
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
    """Patch a class unless an active override has."""
    with _lock:
        patch, users = _patches.get(rasterizer) or (ClassPatch(rasterizer, "forward", _make(rasterizer)), 0)
        _patches[rasterizer] = patch, users + 1


def _release(rasterizer: type) -> None:
    """Restore a class unless another override needs the patch."""
    with _lock:
        patch, users = _patches[rasterizer]
        if users > 1:
            _patches[rasterizer] = patch, users - 1
        else:
            patch.remove()
            del _patches[rasterizer]


def _make(rasterizer: type) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the function that wraps the forward of a class."""
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
