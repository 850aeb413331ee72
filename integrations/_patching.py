"""Replace functions of a code base that is not edited: after an import, on a class, or in one thread."""

from __future__ import annotations

import functools
import inspect
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NamedTuple, Self
from unittest.mock import patch

import torch
from torch import Tensor

from ._calls import RASTERIZERS, RasterizerCall, Signature, find_installed, forward_signature, rasterizer_classes


class AfterImport(MetaPathFinder):
    """Within a block, call back with a module right after anyone imports it; at once if it is imported already."""

    def __init__(self, callbacks: Mapping[str, Callable[[ModuleType], None]]) -> None:
        self._callbacks = callbacks

    def __enter__(self) -> Self:
        for name, callback in self._callbacks.items():
            if name in sys.modules:
                callback(sys.modules[name])
        sys.meta_path.insert(0, self)
        return self

    def __exit__(self, *error: object) -> None:
        sys.meta_path.remove(self)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Let the other finders find the module, and call back once its loader has executed it."""
        callback = self._callbacks.get(fullname)
        if callback is None:
            return None
        # Only those after it: another watch for the same module, asked in turn, would ask this one again.
        others = sys.meta_path[sys.meta_path.index(self) + 1 :]
        specs = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        run = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            run(module)
            callback(module)

        # On the instance, one per module, so that the loader keeps its type, which inspect and pickle look at.
        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


class ClassPatch:
    """Replaces a method of a class, its own or inherited, by ``make(method)`` until :meth:`remove`."""

    def __init__(self, owner: type, name: str, make: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
        self.owner, self.name = owner, name
        self._replacement = make(getattr(owner, name))
        self._patch = patch.object(owner, name, self._replacement)
        self._patch.start()

    def check_removable(self) -> None:
        """Raise RuntimeError if the method was replaced again since; that replacement would be lost."""
        now = vars(self.owner).get(self.name, "inherited")
        if now is not self._replacement:
            raise RuntimeError(
                f"{self.owner.__qualname__}.{self.name} was replaced again after ca_reg had wrapped it; it is now "
                f"{now}. Undo the replacements in the reverse order."
            )

    def remove(self) -> None:
        """Restore the same object, or delete the attribute if it was inherited; raises as `check_removable`."""
        self.check_removable()
        self._patch.stop()


class PatchedClasses:
    """Classes whose methods are wrapped from `start` to `stop`, those given as ``module:Class`` once imported.

    Args:
        rasterizer: the class or its name, which must be of the INRIA family; None for the usual ones of `RASTERIZERS`,
            and the ``candidates``. One of these must be installed.
        candidates: names of further rasterizers, left alone if they are not of the family.
        models: names of classes with a method ``update_learning_rate``.
        rasterize: handles every call of a rasterizer.
        update: is called with a model and an iteration before its learning rate is updated.
        check: is called with the signature of a rasterizer, and may raise.
    """

    def __init__(
        self,
        rasterizer: type | str | None,
        candidates: Iterable[str],
        models: Iterable[str],
        *,
        rasterize: Callable[[RasterizerCall], Any],
        update: Callable[[Any, int], None],
        check: Callable[[Any], None],
    ) -> None:
        self.models: tuple[type, ...] = ()  # classes wrapped since the start
        self.names: list[str] = []  # of the rasterizers wrapped since the start, for messages
        self._patches: list[ClassPatch] = []
        self._rasterize, self._update, self._check = rasterize, update, check
        self._updated: Any = None  # the model whose update_learning_rate is running
        self._rasterizer = rasterizer
        candidates = tuple(candidates)
        self._usual = (*RASTERIZERS, *candidates)
        found: dict[str, Callable[[type], None]] = {}
        if rasterizer is None:
            found |= dict.fromkeys(candidates, self._wrap_candidate)
            found |= dict.fromkeys(RASTERIZERS, self._wrap_rasterizer)
        elif isinstance(rasterizer, str):
            found[rasterizer] = self._wrap_rasterizer
        found |= dict.fromkeys(models, self._wrap_model)
        self._wanted: dict[str, list[tuple[str, Callable[[type], None]]]] = {}
        for place, wrap in found.items():
            module, _, name = place.partition(":")
            self._wanted.setdefault(module, []).append((name, wrap))
        self._watching = ExitStack()

    def start(self) -> None:
        """Wrap what is imported, and watch for the rest; raises if a class cannot be wrapped or none is installed."""
        self.models, self.names = (), []
        if self._rasterizer is None:
            find_installed(self._usual)
        elif isinstance(self._rasterizer, type):
            self._wrap_rasterizer(self._rasterizer)
        self._watching.enter_context(AfterImport(dict.fromkeys(self._wanted, self._imported)))

    def check_removable(self) -> None:
        """Raise RuntimeError if a method was wrapped again since."""
        for each in self._patches:
            each.check_removable()

    def stop(self) -> None:
        """Restore the classes, and stop watching."""
        self._watching.close()
        while self._patches:
            self._patches.pop().remove()

    def _imported(self, module: ModuleType) -> None:
        for name, wrap in self._wanted[module.__name__]:
            found = getattr(module, name, None)
            if isinstance(found, type) and all(each.owner is not found for each in self._patches):
                wrap(found)

    def _wrap_candidate(self, rasterizer: type) -> None:
        try:
            forward_signature(rasterizer)
        except TypeError:  # not of the family
            return
        self._wrap_rasterizer(rasterizer)

    def _wrap_rasterizer(self, rasterizer: type) -> None:
        signature = forward_signature(rasterizer)
        self._check(signature)
        function: Any = rasterizer.forward  # type: ignore[attr-defined]
        while function is not None:
            if "ca_reg_hook" in vars(function):
                raise RuntimeError(
                    f"{rasterizer.__qualname__} has a RasterizerHook already; Gaussians would be dropped twice. "
                    "Uninstall that one first, or put both regularizers into one Chain."
                )
            function = getattr(function, "__wrapped__", None)

        binder = Signature(signature)

        def make(forward: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(forward)
            def regularized_forward(*args: Any, **kwargs: Any) -> Any:
                return self._rasterize(RasterizerCall(forward, binder, args, kwargs))

            # Graph break in a compiled render: what follows reads the local variables of the caller.
            eager: Callable[..., Any] = torch.compiler.disable(regularized_forward)  # type: ignore[no-untyped-call]
            vars(eager)["ca_reg_hook"] = self
            return eager

        self._patches.append(ClassPatch(rasterizer, "forward", make))
        self.names.append(f"{rasterizer.__module__}.{rasterizer.__qualname__}")

    def _wrap_model(self, model: type) -> None:
        """Intercept a model's updates of the learning rate, if they have an argument: it tells the iteration."""
        method = getattr(model, "update_learning_rate", None)
        if method is None or len(inspect.signature(method).parameters) < 2:
            return

        def make(update: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(update)
            def update_learning_rate(model: Any, *args: Any, **kwargs: Any) -> Any:
                given = [*args, *kwargs.values()]  # the iteration first, by whatever name
                # Not counted: a call by the override of a subclass, and the update of something else than Gaussians,
                # such as a network that deforms them. Gaussians have opacities, by whatever name.
                has_opacities = any("opacit" in name for name in dir(model))
                if self._updated is model or not given or not has_opacities:
                    return update(model, *args, **kwargs)
                self._update(model, int(given[0]))
                self._updated = model
                try:
                    return update(model, *args, **kwargs)
                finally:
                    self._updated = None

            return update_learning_rate

        self.models += (model,)
        self._patches.append(ClassPatch(model, "update_learning_rate", make))


class _Override(NamedTuple):
    rasterizers: tuple[type, ...]
    opacity: Tensor
    calls: list[RasterizerCall]  # so far


_current: ContextVar[_Override | None] = ContextVar("_current", default=None)  # of the thread
_lock = threading.Lock()
_patches: dict[type, tuple[ClassPatch, int]] = {}  # patch and number of active overrides of every class


def is_overridden() -> bool:
    """Whether this thread renders with overridden opacities, which regularizers must not change."""
    return _current.get() is not None


@contextmanager
def rendered_once(
    render: Callable[[], Any], opacity: Tensor, rasterizer: type | None
) -> Iterator[tuple[Any, RasterizerCall]]:
    """Render with other opacities; yield what ``render`` returned and its only call of the rasterizer.

    The opacities are activated, of all Gaussians, (N,) or (N, 1). ``rasterizer`` is the class, None for the installed
    ones. The classes are patched once for all threads; renders of other threads are unchanged. Within the block the
    call may be made again. Errors are those of :func:`ca_reg.integrations.inria.render_fn`.
    """
    rasterizers = rasterizer_classes() if rasterizer is None else [rasterizer]
    mine = _Override(tuple(rasterizers), opacity, [])
    with ExitStack() as undo:
        for each in rasterizers:
            undo.enter_context(_patched(each))
        undo.callback(_current.reset, _current.set(mine))
        returned = render()
        if len(mine.calls) != 1:
            names = ", ".join(each.__qualname__ for each in rasterizers)
            raise RuntimeError(
                f"render called {names} {len(mine.calls)} times, expected once; pass the class it uses as "
                "rasterizer=..., and a render function that makes one picture."
            )
        yield returned, mine.calls[0]


@contextmanager
def _patched(rasterizer: type) -> Iterator[None]:
    """Keep a class patched, once for all overrides that need it."""
    with _lock:
        make = functools.partial(_with_other_opacities, rasterizer)
        found, users = _patches.get(rasterizer) or (ClassPatch(rasterizer, "forward", make), 0)
        _patches[rasterizer] = found, users + 1
    try:
        yield
    finally:
        with _lock:
            found, users = _patches.pop(rasterizer)
            if users > 1:
                _patches[rasterizer] = found, users - 1
            else:
                found.remove()


def _with_other_opacities(rasterizer: type, forward: Callable[..., Any]) -> Callable[..., Any]:
    signature = Signature(forward_signature(rasterizer))

    @functools.wraps(forward)
    def with_other_opacities(*args: Any, **kwargs: Any) -> Any:
        mine = _current.get()
        if mine is None or rasterizer not in mine.rasterizers:
            return forward(*args, **kwargs)
        call = RasterizerCall(forward, signature, args, kwargs)
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
