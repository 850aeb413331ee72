"""A graphics card that is none: tensors on the device "card" compute on the processor and refuse what CUDA refuses.

It shows without a card that code is written for one. Mixing devices, or two cards, products of whole numbers, a
generator of another device, a factory function that forgot the device, `numpy()`, an operation that cannot repeat
itself where that is asked for: each fails here as it would on CUDA, and what makes the host wait for the card can be
counted. What it does not show is CUDA's rounding, memory and speed.

It is for machines without a card. PyTorch has one accelerator per process, and this one would take the place of CUDA:
gradients on a real card then fail (`opt_ready_stream && opt_parent_stream INTERNAL ASSERT FAILED`).

Two things it cannot do while PyTorch computes gradients: make tensors of Python numbers (`torch.tensor`, `new_tensor`),
and say what was refused in a gradient that PyTorch computes itself (`SystemError: ... returned NULL`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from typing import Any

import pytest
import torch
from stand_ins.cuda_rules import (
    SYNCHRONIZES,
    check_determinism,
    check_devices,
    check_generator,
    check_supported,
    shuffled_additions,
)
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import return_and_correct_aliasing

__all__ = ["CARD", "counted_synchronizations", "pretended_card", "register_card"]

CARD = "card"

_SIZED_LATER = ("arange", "arange.start", "arange.start_step", "eye", "eye.m", "linspace")
"""What PyTorch makes by resizing an empty tensor, which a tensor written in Python cannot follow."""

_generators: dict[int, torch.device] = {}  # by address: a generator comes back from C++ as another object
_order: torch.Generator | None = None
_counted: list[Counter[str]] = []
_libraries: list[torch.library.Library] = []


class CardTensor(Tensor):
    """A tensor that says it is on the card; the numbers are in a tensor on the processor."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor, index: int = 0) -> CardTensor:
        out = Tensor._make_wrapper_subclass(
            cls,
            numbers.size(),
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            device=torch.device(CARD, index),
        )
        out.numbers = numbers
        return out

    def __repr__(self) -> str:
        return f"CardTensor({self.numbers})"

    @classmethod
    def __torch_dispatch__(cls, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(op, *args, **(kwargs or {}))


class _Generator(torch.Generator):
    """A generator that says it is where it was asked to be; PyTorch cannot make one for a device written in Python."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        out = super().__new__(cls, "cpu")
        out._where = torch.device(device)
        _generators[out._cdata] = out._where
        return out

    def __del__(self) -> None:
        _generators.pop(self._cdata, None)

    @property
    def device(self) -> torch.device:
        return self._where


class _FromNumbers(TorchFunctionMode):
    """What PyTorch does not hand to a device written in Python: making tensors of Python numbers, and the reverse."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        ours = bool(args) and isinstance(args[0], CardTensor)
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and _is_card(kwargs.get("device")):
            return args[0] if ours else func(*args, **{**kwargs, "device": "cpu"}).to(kwargs["device"])
        if func is Tensor.new_tensor and ours:
            return torch.tensor(args[1], **{"dtype": args[0].dtype, **kwargs}).to(args[0].device)
        if func is Tensor.__getitem__ and ours and isinstance(args[1], tuple):
            args = args[0], tuple(torch.tensor(i) if isinstance(i, list) else i for i in args[1])
        if func is Tensor.tolist and ours:
            _count("aten::_local_scalar_dense")
            return args[0].detach().numbers.tolist()
        if func is Tensor.numpy and ours:
            raise TypeError("can't convert a tensor on the card to numpy. Use Tensor.cpu() first.")
        if isinstance(kwargs.get("generator"), _Generator) and not ours and not _is_card(kwargs.get("device")):
            check_generator(kwargs["generator"].device, torch.device("cpu"))
        return func(*args, **kwargs)


class _Module:
    """What PyTorch asks the module of a device."""

    is_initialized = is_available = staticmethod(lambda: True)
    device_count = staticmethod(lambda: 1)
    current_device = staticmethod(lambda: 0)
    manual_seed_all = staticmethod(lambda seed: None)
    _is_in_bad_fork = staticmethod(lambda: False)
    get_amp_supported_dtype = staticmethod(lambda: [torch.float16, torch.bfloat16])


@contextmanager
def pretended_card(*, order: int | None = None) -> Iterator[torch.device]:
    """Make the device "card" usable; skips where there is a real card, or PyTorch has no devices written in Python.

    Args:
        order: seed of the order in which `index_add` adds, which CUDA leaves open; as on a processor by default.

    Yields:
        The device.
    """
    global _order
    if torch.cuda.is_available():
        pytest.skip("the pretended card is for machines without a card")
    if not register_card():
        pytest.skip("this PyTorch has no devices that are written in Python")
    _order = None if order is None else torch.Generator().manual_seed(order)
    generator = torch.Generator
    torch.Generator = _Generator  # type: ignore[misc]
    try:
        # Gradients in this thread: an error in a thread of the device would end the process.
        with torch.autograd.set_multithreading_enabled(False), _FromNumbers():
            yield torch.device(CARD)
    finally:
        torch.Generator = generator  # type: ignore[misc]
        _order = None


@contextmanager
def counted_synchronizations() -> Iterator[Counter[str]]:
    """Count what makes the host wait for the card, by operation."""
    found: Counter[str] = Counter()
    _counted.append(found)
    try:
        yield found
    finally:
        _counted.remove(found)


@cache
def register_card() -> bool:
    """Make the device known to PyTorch; return whether that can be done, and there is no real card to disturb.

    It must happen before the first backward pass of a process: PyTorch counts the devices then.
    """
    if torch.cuda.is_available() or not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        return False
    backend_registration._setup_privateuseone_for_python_backend(CARD, backend_module=_Module())
    every, aten = torch.library.Library("_", "IMPL"), torch.library.Library("aten", "IMPL")
    every.fallback(_compute, "PrivateUse1")
    for name in _SIZED_LATER:
        base, _, overload = name.partition(".")
        aten.impl(name, partial(_compute, getattr(getattr(torch.ops.aten, base), overload or "default")), "PrivateUse1")
    every.fallback(torch.library.fallthrough_kernel, "AutocastPrivateUse1")
    for op in (torch.ops.aten.matmul, torch.ops.aten.mm, torch.ops.aten.bmm):
        aten.impl(op.default, partial(_autocast, op.default), "AutocastPrivateUse1")
    _libraries.extend([every, aten])  # what they register lasts as long as they do
    return True


def _autocast(op: Any, one: Tensor, other: Tensor) -> Tensor:
    """Multiply in the short type that was asked for, as `torch.autocast` does on CUDA."""
    with torch._C._ExcludeDispatchKeyGuard(torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastPrivateUse1)):
        return op(*(x.to(torch.get_autocast_dtype(CARD)) if x.is_floating_point() else x for x in (one, other)))


def _compute(op: Any, *args: Any, **kwargs: Any) -> Any:
    """Do one operation on the processor, after the checks that CUDA makes."""
    name, device = op._schema.name, kwargs.get("device")
    leaves = [*_flat(args), *_flat([*kwargs.values()])]
    ours = [x for x in leaves if isinstance(x, CardTensor)]
    _check(name, args, kwargs, leaves, ours)
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    inner = _mapped(_numbers, args)
    if _order is not None:
        inner = shuffled_additions(name, inner, _order)
    out = op(*inner, **{key: _mapped(_numbers, x) for key, x in kwargs.items()})
    if any(x.shape != x.numbers.shape or x.stride() != x.numbers.stride() for x in ours):
        raise NotImplementedError(f"the pretended card cannot follow {name}, which changes the shape of a tensor")
    on_card = isinstance(args[0], CardTensor) if name == "aten::copy_" else bool(ours)
    if on_card if device is None else _is_card(device):
        # As CUDA does without a number: what is made is on the first card.
        index = (torch.device(device).index or 0) if device is not None else _card_of(args, ours)
        out = _mapped(lambda x: CardTensor(x, index) if isinstance(x, Tensor) else x, out)
    return return_and_correct_aliasing(op, args, kwargs, out) if ours else out


# A training makes a hundred thousand operations, and PyTorch's `tree_map` takes longer than they do.


def _mapped(function: Callable[[Any], Any], x: Any) -> Any:
    """Apply a function to what an argument or a result holds."""
    if isinstance(x, list | tuple):
        inner = [_mapped(function, each) for each in x]
        return inner if isinstance(x, list) else tuple(inner)
    return function(x)


def _flat(x: Sequence[Any]) -> Iterator[Any]:
    """Yield what arguments hold."""
    for each in x:
        if isinstance(each, list | tuple):
            yield from _flat(each)
        else:
            yield each


def _check(name: str, args: Sequence[Any], kwargs: Any, leaves: Sequence[Any], ours: Sequence[Tensor]) -> None:
    """Refuse what CUDA would refuse."""
    device = kwargs.get("device") or CARD
    for x in leaves:
        if isinstance(x, torch._C.Generator):
            check_generator(_generators.get(x._cdata, torch.device("cpu")), torch.device(device))
    if _crosses(name, args, kwargs) or (ours and (name in SYNCHRONIZES or _indexes_by_mask(name, args))):
        _count(name)
    if ours:
        check_supported(name, ours)
        foreign = [x for x in leaves if isinstance(x, Tensor) and not isinstance(x, CardTensor)]
        check_devices(name, args, ours, foreign)
        check_determinism(name, args, ours)


def _count(name: str) -> None:
    for found in _counted:
        found[name] += 1


def _crosses(name: str, args: Sequence[Any], kwargs: Any) -> bool:
    """Whether this is a copy between the processor and the card that the host waits for.

    With ``non_blocking`` it does not, unless the copy goes to a tensor on the processor that was there before: one that
    PyTorch makes is pinned.
    """
    if name == "aten::copy_":
        arrives, free = isinstance(args[0], CardTensor), kwargs.get("non_blocking") or any(args[2:])
        return arrives != isinstance(args[1], CardTensor) and not (arrives and free)
    if name != "aten::_to_copy" or kwargs.get("device") is None or kwargs.get("non_blocking"):
        return False
    return isinstance(args[0], CardTensor) != _is_card(kwargs["device"])


def _indexes_by_mask(name: str, args: Sequence[Any]) -> bool:
    """Whether an operation must know how many entries of a mask are set."""
    if name not in ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"):
        return False
    if name != "aten::index" and args[2].numel() == 1 and not any(args[3:4]):
        return False  # the card fills where the mask is set
    return any(isinstance(x, Tensor) and x.dtype in (torch.bool, torch.uint8) for x in args[1])


def _card_of(args: Sequence[Any], ours: Sequence[Tensor]) -> int:
    """Return the number of the card that a result is on: the target's of a copy, else the arguments'."""
    target = args[0] if args and isinstance(args[0], CardTensor) else ours[0]
    return target.device.index or 0


def _is_card(device: Any) -> bool:
    return device is not None and torch.device(device).type == CARD


def _numbers(x: Any) -> Any:
    return x.numbers if isinstance(x, CardTensor) else x
