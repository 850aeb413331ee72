"""Run code that says "cuda" on the CPU."""

from __future__ import annotations

import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ContextDecorator, ExitStack, contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any, Self
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from ca_reg.integrations._patching import AfterImport

__all__ = ["MEMORY", "cuda_on_cpu"]

_REGISTRATIONS = "torchvision._meta_registrations"
MEMORY = 2**34  # bytes, all of them free


@contextmanager
def cuda_on_cpu() -> Iterator[None]:
    """Make torch functions use the CPU wherever they are told to use a CUDA device.

    With a CUDA device nothing is changed. Without one, ``device="cuda"`` in any torch function, ``.to("cuda")`` and
    ``.cuda()`` of tensors and modules, ``.pin_memory()``, ``torch.load`` by default or with ``map_location="cuda"``,
    and ``torch.Generator("cuda")`` mean the CPU. In ``torch.cuda``, events, streams, devices, ``synchronize`` and
    ``nvtx`` run without effect, and a device with `MEMORY` bytes is reported; ``is_available()`` stays False. A
    torchvision built for CUDA can be imported, without its own kernels. Everything is restored at the end.

    A tensor moved to "cuda" stays the same tensor, as if it were there already: in-place writes affect both.

    This applies to the current thread and to threads started within the block, such as a viewer's.

    Example:
        >>> with cuda_on_cpu():
        ...     torch.zeros(2, device="cuda").cuda()
        tensor([0., 0.])
    """
    if torch.cuda.is_available():
        yield
        return
    with ExitStack() as undo:
        undo.enter_context(patch.multiple(torch.cuda, **_STAND_INS))
        undo.enter_context(patch.object(torch, "load", _load_on_cpu(torch.load)))
        undo.enter_context(patch.object(torch, "Generator", _Generator))
        undo.enter_context(patch.object(threading.Thread, "start", _start_on_cpu(threading.Thread.start)))
        undo.enter_context(_CudaMeansCpu())
        undo.enter_context(AfterImport({"torchvision.extension": _without_kernels}))
        yield


def _without_kernels(extension: ModuleType) -> None:
    """Let a torchvision that was built for CUDA be imported beside a torch without: what it lacks is not registered."""
    if not extension._has_ops():
        sys.modules.setdefault(_REGISTRATIONS, ModuleType(_REGISTRATIONS))


class _CudaMeansCpu(ContextDecorator, TorchFunctionMode):
    """Replaces CUDA devices among the arguments of torch functions by the CPU."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: tuple[type, ...],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        if func in (Tensor.cuda, Tensor.pin_memory):
            return args[0]
        return func(*map(_on_cpu, args), **{name: _on_cpu(value) for name, value in (kwargs or {}).items()})


def _load_on_cpu(load: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap `torch.load`, which a mode of torch functions does not see, for a machine without CUDA."""

    @functools.wraps(load)
    def load_on_cpu(f: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        return load(f, "cpu" if map_location is None else _on_cpu(map_location), *args, **kwargs)

    return load_on_cpu


def _start_on_cpu(start: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    """Wrap `threading.Thread.start` for threads without CUDA: a mode of torch functions is local to its thread."""

    @functools.wraps(start)
    def start_on_cpu(thread: threading.Thread) -> None:
        thread.run = _CudaMeansCpu()(thread.run)  # type: ignore[method-assign]
        start(thread)

    return start_on_cpu


def _on_cpu(value: Any) -> Any:
    """Return the CPU for a CUDA device or its name, and anything else as it is."""
    if isinstance(value, str):
        return "cpu" if value.partition(":")[0] == "cuda" else value
    if isinstance(value, torch.device) and value.type == "cuda":
        return torch.device("cpu")
    return value


_GENERATOR = torch.Generator


class _AnyGenerator(type):
    def __instancecheck__(cls, value: object) -> bool:
        return isinstance(value, _GENERATOR)


class _Generator(metaclass=_AnyGenerator):
    """Makes plain generators, all of them on the CPU."""

    def __new__(cls, device: Any = "cpu") -> Any:
        return _GENERATOR(_on_cpu(device))


class _Event:
    """A point in time, as ``torch.cuda.Event`` marks it; on a CPU all work before it is done."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._time = 0.0

    def record(self, stream: Any = None) -> None:
        self._time = time.perf_counter()

    def elapsed_time(self, end: _Event) -> float:
        """Milliseconds until another event."""
        return 1e3 * (end._time - self._time)

    def query(self) -> bool:
        return True

    def wait(self, stream: Any = None) -> None:
        """Wait for nothing."""

    synchronize = wait


class _Context:
    """A context without effect."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass


class _Device(_Context):
    """The current device; there is only one."""


class _DeviceOf(_Context):
    """The device of a tensor."""


class _Stream(_Context):
    """A stream of work; a CPU has only one."""

    def record_event(self, event: _Event | None = None) -> _Event:
        event = event or _Event()
        event.record(self)
        return event

    def _wait(self, *args: Any) -> None:
        """Wait for nothing."""

    synchronize = wait_stream = wait_event = _wait


def _nothing() -> Callable[..., None]:
    """Return a new function that does nothing; dynamo refuses the same object under two names of torch."""
    return lambda *args, **kwargs: None


_STAND_INS: dict[str, Any] = {
    "Event": _Event,
    "Stream": _Stream,
    "current_device": lambda: 0,
    "current_stream": lambda device=None: _Stream(),
    "device": _Device,
    "device_of": _DeviceOf,
    "get_device_capability": lambda device=None: (0, 0),
    "get_device_name": lambda device=None: "CPU",
    "get_device_properties": lambda device=None: SimpleNamespace(
        name="CPU",
        major=0,
        minor=0,
        total_memory=MEMORY,
        multi_processor_count=1,
        gcnArchName="CPU",  # which torch.compile asks for
    ),
    "mem_get_info": lambda device=None: (MEMORY, MEMORY),
    "nvtx": SimpleNamespace(range_push=_nothing(), range_pop=_nothing(), mark=_nothing(), range=_Stream),
    "reset_peak_memory_stats": _nothing(),
    "set_device": _nothing(),
    "stream": lambda stream: _Stream(),
    "synchronize": _nothing(),
}
