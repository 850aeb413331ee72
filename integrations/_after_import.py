"""Call a function right after a module is imported, whenever that happens."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

__all__ = ["AfterImport"]


class AfterImport(MetaPathFinder):
    """Call back with a module once it is imported, whoever does; with one that is, at :meth:`start`.

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
        """Hand over what is imported, and watch for the rest."""
        for name, callback in self._callbacks.items():
            if name in sys.modules:
                callback(sys.modules[name])
        sys.meta_path.insert(0, self)

    def stop(self) -> None:
        """Watch no longer; without effect if it was not watching."""
        if self in sys.meta_path:
            sys.meta_path.remove(self)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Let the other finders find the module, and call back once its own loader has run it."""
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

        # On the instance, of which there is one per module: the type of the loader is what inspect and pickle look at.
        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
