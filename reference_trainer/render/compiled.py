"""Whether and how exact moments run through `torch.compile`; without a compiler they stay eager, with a reason.

Plain rendering stays eager: compiled in the same way it was not faster.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

__all__ = ["is_compiled", "kernel", "use_compiled"]

_state = {"compiled": False}


def use_compiled(wanted: bool = True) -> bool:
    """Let all later moments and their gradients on a CPU run compiled in this process, or not.

    They agree with the eager ones within the rounding of float32: a splat that lies within rounding of the 1/255 cut at
    a pixel may fall on the other side of it. The first call of each kind compiles for half a minute; torch keeps the
    result on the disk for the next process.

    Args:
        wanted: True for compiled, False for eager.

    Returns:
        Whether moments are compiled now: False, with a warning that says why, where there is no working compiler.

    Example:
        >>> use_compiled(False)
        False
    """
    if wanted and (reason := _obstacle()):
        warnings.warn(f"moments are not compiled: {reason}", stacklevel=2)
        wanted = False
    _state["compiled"] = wanted
    return wanted


def is_compiled(device: torch.device) -> bool:
    """Return whether moments on a device are to run compiled."""
    return _state["compiled"] and device.type == "cpu"


def kernel(function: Callable[..., None], pixels: Tensor, *arguments: Tensor | list[Tensor]) -> None:
    """Run a function of `reference_trainer.render.moment_rows` compiled, in place.

    Args:
        function: what to run.
        pixels: its first argument.
        arguments: the others, each with the number of tiles, at least 2, as its first axis.
    """
    run = _compile(function)
    kind = (function, *(_kind(x) for x in arguments))
    if kind not in _known:
        # Compiled for any number of tiles, with many in mind: for few it would not be run in parallel.
        with _cache_of_this_processor():
            run(pixels, *(_example(x) for x in arguments))
        _known.add(kind)
    run(pixels, *arguments)


def _kind(argument: Tensor | list[Tensor]) -> tuple[Any, ...]:
    """Return what a kernel is compiled for: everything but the number of tiles."""
    if isinstance(argument, list):
        return (len(argument), *_kind(argument[0]))
    return argument.dtype, argument.shape[1:]


def _example(argument: Tensor | list[Tensor]) -> Tensor | list[Tensor]:
    """Return an argument of the same kind with many tiles, marked as any number."""
    if isinstance(argument, list):
        return [_example(x) for x in argument]  # type: ignore[misc]
    example = argument.new_zeros(_MANY, *argument.shape[1:])
    torch._dynamo.mark_dynamic(example, 0)
    return example


def _cache_of_this_processor() -> AbstractContextManager[None]:
    """Let torch find on the disk only what was compiled for the instructions that it uses now.

    Its cache forgets them: code in steps of AVX-512, found by a process with ATEN_CPU_CAPABILITY=avx2 or on another
    machine that shares the folder, would leave out every second vector, without an error (torch 2.13).
    """
    try:
        from torch.compiler import config
    except ImportError:  # before torch 2.6
        return nullcontext()
    tag = f"{config.cache_key_tag} {torch.backends.cpu.get_cpu_capability()}"
    patch: AbstractContextManager[None] = config.patch(cache_key_tag=tag)  # type: ignore[attr-defined]
    return patch


_MANY = 1021
_known: set[tuple[Any, ...]] = set()


@functools.cache
def _compile(function: Callable[..., None]) -> Callable[..., None]:
    """Wrap a function for compilation at its first call."""
    return torch.compile(function, fullgraph=True)


@functools.cache
def _obstacle() -> str:
    """Try to compile something small; return why that fails, or nothing."""
    try:
        torch.compile(_double, fullgraph=True)(torch.ones(3))
    except Exception as error:  # whatever a missing or broken compiler raises
        reason = " ".join(str(error).split("\n\n")[0].split())
        return f"torch.compile does not work here ({type(error).__name__}: {reason})."
    return ""


def _double(x: Tensor) -> Tensor:
    """Return twice a tensor."""
    return x + x
