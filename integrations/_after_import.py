"""Import hook: call a function right after a module is imported, whenever that happens."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

__all__ = ["AfterImport"]


class AfterImport(MetaPathFinder):
    """Call back with a module right after its import, by whomever; at :meth:`start` if it is imported already.

    Example:
        >>> import colorsys
        >>> seen = []
        >>> watch = AfterImport({"colorsys": lambda module: seen.append(module.__name__)})
        >>> watch.start()
        >>> watch.stop()
        >>> seen
        ['colorsys']
    """

    def __init__(self, callbacks: Mapping[str, Callable[[ModuleType], None]]) -> None:
        self._callbacks = callbacks

    def start(self) -> None:
        """Call back with the modules that are imported already, and watch for the others."""
        for name, callback in self._callbacks.items():
            if name in sys.modules:
                callback(sys.modules[name])
        sys.meta_path.insert(0, self)

    def stop(self) -> None:
        """Stop watching; no effect if not watching."""
        if self in sys.meta_path:
            sys.meta_path.remove(self)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Let the other finders find the module, and call back once its loader has executed it."""
        callback = self._callbacks.get(fullname)
        if callback is None:
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
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
