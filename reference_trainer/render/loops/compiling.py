"""How the loops are compiled: once per machine, kept on the disk where that can be written."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

__all__ = ["inlined", "kernel"]

F = TypeVar("F", bound=Callable[..., Any])

# Sums may be reordered and products fused. Nothing may assume that there are no nan and infinity: what the checks of
# the inputs see must be what is there.
_FAST = {"nsz", "contract", "reassoc", "arcp", "afn"}


def kernel(function: F) -> F:
    """Compile a loop over NumPy arrays; it runs without the interpreter's lock, so that threads run side by side.

    The machine code is kept beside the source, or in the user's cache if that cannot be written, or nowhere if none
    can: then every process compiles anew.
    """
    options = {"nogil": True, "fastmath": _FAST, "error_model": "numpy"}
    try:
        compiled: F = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # "no locator available": neither the package nor the home can be written
        compiled = numba.njit(**options)(function)
    return compiled


def inlined(function: F) -> F:
    """Compile a part of kernels into each of them."""
    compiled: F = numba.njit(inline="always", fastmath=_FAST, error_model="numpy")(function)
    return compiled
