"""Wrap the rasterizers and the models of a code base as soon as they are imported."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any

import torch

from ._after_import import AfterImport
from ._patch import ClassPatch
from ._rasterizer import ForwardCall, class_in, forward_signature

__all__ = ["Wrapped"]


class Wrapped:
    """Classes whose methods are wrapped from `start` to `stop`, those given as ``module:Class`` once imported.

    Args:
        rasterizers: classes or names, which must be of the INRIA family.
        candidates: names of further rasterizers, left alone if they are not of the family.
        models: names of classes with a method ``update_learning_rate``.
        rasterize: handles every call of a rasterizer.
        update: is called with a model and an iteration before its learning rate is updated.
        check: is called with the signature of a rasterizer, and may raise.

    Attributes:
        models: the model classes wrapped so far.
        names: names of the rasterizers wrapped so far, for messages.
    """

    def __init__(
        self,
        rasterizers: Iterable[type | str],
        candidates: Iterable[str],
        models: Iterable[str],
        *,
        rasterize: Callable[[ForwardCall], Any],
        update: Callable[[Any, int], None],
        check: Callable[[Any], None],
    ) -> None:
        self.models: tuple[type, ...] = ()
        self.names: list[str] = []
        self._patches: list[ClassPatch] = []
        self._rasterize, self._update, self._check = rasterize, update, check
        self._updated: Any = None  # the model whose update_learning_rate is running
        self._given = [x for x in rasterizers if isinstance(x, type)]
        found: dict[str, Callable[[type], None]] = dict.fromkeys(candidates, self._wrap_candidate)
        found |= dict.fromkeys((x for x in rasterizers if isinstance(x, str)), self._wrap_rasterizer)
        found |= dict.fromkeys(models, self._wrap_model)
        self._wanted: dict[str, list[tuple[str, Callable[[type], None]]]] = {}
        for place, wrap in found.items():
            module, _, name = place.partition(":")
            self._wanted.setdefault(module, []).append((name, wrap))
        self._imports = AfterImport(dict.fromkeys(self._wanted, self._imported))

    def start(self) -> None:
        """Wrap what is imported, and watch for the rest; raises if a class cannot be wrapped."""
        for rasterizer in self._given:
            self._wrap_rasterizer(rasterizer)
        self._imports.start()

    def check_removable(self) -> None:
        """Raise RuntimeError if a method was wrapped again since."""
        for patch in self._patches:
            patch.check_removable()

    def stop(self) -> None:
        """Restore the classes, and stop watching."""
        self._imports.stop()
        while self._patches:
            self._patches.pop().remove()

    def _imported(self, module: ModuleType) -> None:
        for name, wrap in self._wanted[module.__name__]:
            found = class_in(module, name)
            if found is not None and all(patch.owner is not found for patch in self._patches):
                wrap(found)

    def _wrap_candidate(self, rasterizer: type) -> None:
        try:
            forward_signature(rasterizer)
        except TypeError:  # not of the family
            return
        self._wrap_rasterizer(rasterizer)

    def _wrap_rasterizer(self, rasterizer: type) -> None:
        """Wrap the forward of a rasterizer."""
        signature = forward_signature(rasterizer)
        self._check(signature)
        function: Any = rasterizer.forward  # type: ignore[attr-defined]
        while function is not None:
            if "ca_reg_hook" in vars(function):
                raise RuntimeError(
                    f"{rasterizer.__qualname__} has a RasterizerHook already; Gaussians would be dropped twice. "
                    "Uninstall that one first, or put both regularizers into one nn.Sequential."
                )
            function = getattr(function, "__wrapped__", None)

        def make(forward: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(forward)
            def regularized_forward(*args: Any, **kwargs: Any) -> Any:
                return self._rasterize(ForwardCall(forward, signature.bind(*args, **kwargs)))

            # Graph break in a compiled render: what follows reads the local variables of the caller.
            eager: Callable[..., Any] = torch.compiler.disable(regularized_forward)  # type: ignore[no-untyped-call]
            vars(eager)["ca_reg_hook"] = self
            return eager

        self._patches.append(ClassPatch(rasterizer, "forward", make))
        self.names.append(f"{rasterizer.__module__}.{rasterizer.__qualname__}")

    def _wrap_model(self, model: type) -> None:
        """Intercept the learning rate updates of a model."""
        if not hasattr(model, "update_learning_rate"):
            return

        def make(update: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(update)
            def update_learning_rate(model: Any, iteration: int, *args: Any, **kwargs: Any) -> Any:
                if self._updated is model:  # called by an override in a subclass
                    return update(model, iteration, *args, **kwargs)
                self._update(model, int(iteration))
                self._updated = model
                try:
                    return update(model, iteration, *args, **kwargs)
                finally:
                    self._updated = None

            return update_learning_rate

        self.models += (model,)
        self._patches.append(ClassPatch(model, "update_learning_rate", make))
