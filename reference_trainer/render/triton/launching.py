"""How a kernel is declared and started, with less work for the host than by Triton itself.

Triton looks at each argument of each launch, for addresses that 16 divides and numbers that are 1 have machine code of
their own. A picture waits for the host, not for the card, and these kernels gain nothing by such code. So theirs is for
any address and any number, and what has been compiled once for the types of its arguments is started without a look.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable
from typing import Any

import torch
import triton
from torch import Tensor

__all__ = ["LAUNCHED", "kernel", "launch"]

LAUNCHED: Counter[str] = Counter()
"""How often each kernel has been launched in this process."""

_COMPILED: dict[tuple[Any, ...], tuple[Any, list[Any]]] = {}
"""Machine code and its constants, by all that it depends on."""


def kernel(function: Callable[..., None]) -> Any:
    """Declare a kernel; its constants, ``tl.constexpr``, come last."""
    parameters = inspect.signature(function).parameters.items()
    return triton.jit(function, do_not_specialize=[name for name, x in parameters if "constexpr" not in str(x)])


def launch(function: Any, grid: tuple[int, ...], *arguments: Any, warps: int = 1, **constants: Any) -> None:
    """Start a kernel's programs on the device of the first argument, a tensor; an empty grid is no launch.

    Among the constants may be options of the compiler.
    """
    if min(grid) <= 0:
        return
    LAUNCHED[function.fn.__name__] += 1
    types = (x.dtype for x in arguments if isinstance(x, Tensor))
    key = function.fn, arguments[0].device, warps, *constants.items(), *types
    with torch.cuda.device_of(arguments[0]):  # type: ignore[no-untyped-call]
        if key in _COMPILED:
            compiled, values = _COMPILED[key]
            compiled[(*grid, 1, 1)[:3]](*arguments, *values)
            return
        compiled = function[grid](*arguments, num_warps=warps, enable_fp_fusion=True, **constants)
        if compiled is not None:  # the interpreter compiles nothing
            _COMPILED[key] = compiled, [constants[name] for name in function.arg_names[len(arguments) :]]
