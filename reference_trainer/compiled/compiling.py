"""Compiling the loops: once per machine, cached in the user's cache folder where that can be written."""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    NullCache,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.extending import intrinsic
from numba.misc.appdirs import AppDirs
from numba.np.arrayobj import make_array

__all__ = ["KERNELS", "describe_compilation", "inlined", "kernel", "prefetch", "reported_to"]

F = TypeVar("F", bound=Callable[..., Any])

# Sums may be reordered and products fused, but nan and infinity must survive: the checks of the inputs rely on them.
_FAST = {"nsz", "contract", "reassoc", "arcp", "afn"}

KERNELS: list[Any] = []
"""All kernels of the modules that have been imported."""


def _digest() -> str:
    """Return a hash of all sources that are compiled into kernels of other files.

    numba checks a kernel's own file alone, and would go on using machine code with an older version of another file
    inlined.
    """
    package = Path(__file__).parents[1]
    sources = package / "render/constants.py", Path(__file__), *sorted((package / "render/numba").glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


_DIGEST = _digest()


def describe_compilation(folder: str | None) -> str:
    """Describe for people what happens when a loop must be compiled, to be cached in a folder, or nowhere."""
    when = "once on this machine" if folder else "in every process, as no folder can be written (set NUMBA_CACHE_DIR)"
    return f"Compiling the renderer's loops, {when}: about 30 s of one core."


_warn = functools.cache(logging.getLogger(__name__).warning)  # each message once per process


def _log(name: str, folder: str | None) -> None:
    """Log that loops are compiled."""
    _warn(describe_compilation(folder))


_report: Callable[[str, str | None], None] = _log


@contextmanager
def reported_to(report: Callable[[str, str | None], None]) -> Iterator[None]:
    """Report every kernel that is compiled, for lack of a cached one, to a function instead of the log.

    It receives the kernel's name, and the folder of the cache, None if there is none.
    """
    global _report
    before, _report = _report, report
    try:
        yield
    finally:
        _report = before


def _name(function: Callable[..., Any]) -> str:
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__.lstrip('_')}"


class _UserCache(UserWideCacheLocator):
    """The folder ``ca_reg`` of the user's cache, with one folder in it for each folder of sources.

    numba's own default is ``__pycache__`` beside the source. pip does not remove what it did not install: after an
    uninstall, such files keep a folder without modules alive, a namespace package that hides an editable installation.
    """

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        super().__init__(function, file)
        of_user = AppDirs("ca_reg", appauthor=False).user_cache_dir
        self._cache_path = str(Path(of_user, self.get_suitable_cache_subpath(file)))


class _UserCacheFiles(CompileResultCacheImpl):
    _locator_classes = (UserProvidedCacheLocator, _UserCache)  # the first is NUMBA_CACHE_DIR


class _KernelCache(FunctionCache):
    """Machine code on disk; a fault of the disk costs the time to compile, not the run."""

    _impl_class = _UserCacheFiles

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return (*super()._index_key(sig, codegen), _DIGEST)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # a damaged file, which may unpickle to anything
            found = None
            self._try(self.flush)
        if found is None:
            _report(_name(self._py_func), self.cache_path)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        self._try(super().save_overload, sig, data)

    def _try(self, function: Callable[..., None], *arguments: Any) -> None:
        try:
            function(*arguments)
        except OSError as error:  # such as a full disk
            logging.getLogger(__name__).info("%s is not kept: %s", _name(self._py_func), error)


class _NoKernelCache(NullCache):
    """No machine code on disk."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def load_overload(self, sig: Any, target_context: Any) -> None:
        _report(_name(self._function), None)


def kernel(function: F) -> F:
    """Compile a loop over NumPy arrays; it runs without the GIL, so that threads run in parallel.

    The machine code is cached in the user's cache folder (``$XDG_CACHE_HOME/ca_reg`` or ``~/.cache/ca_reg`` on Linux),
    or in ``NUMBA_CACHE_DIR``, never among the installed files. Where it cannot be written, every process compiles anew.
    """
    compiled: Any = numba.njit(nogil=True, fastmath=_FAST, error_model="numpy")(function)
    try:
        compiled._cache = _KernelCache(function)
    except RuntimeError:  # "no locator available": the home cannot be written
        compiled._cache = _NoKernelCache(function)
    KERNELS.append(compiled)
    result: F = compiled
    return result


def inlined(function: F) -> F:
    """Compile a function that is inlined into the kernels that call it."""
    compiled: F = numba.njit(inline="always", fastmath=_FAST, error_model="numpy")(function)
    return compiled


@intrinsic
def prefetch(_context: Any, _array: Any) -> Any:
    """Prefetch the beginning of an array that is needed soon."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = builder.bitcast(make_array(signature.args[0])(context, builder, arguments[0]).data, cgutils.voidptr_t)
        whole = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [start.type, whole, whole, whole])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [start.type], kind)
        builder.call(fetch, [start, *(whole(x) for x in (0, 3, 1))])  # for reading, into all cache levels, data
        return context.get_dummy_value()

    return types.void(_array), generate
