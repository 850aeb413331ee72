"""Make objects from text such as ``dropout(0.2) + noise(0.8, scale=True)`` or ``my_module:MyDropout(0.3)``."""

from __future__ import annotations

import ast
import importlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeVar

__all__ = ["Registry", "imported", "modules"]

T = TypeVar("T")
_Factory = TypeVar("_Factory", bound=Callable[..., Any])


def imported(module: str, name: str) -> Any:
    """Import a module, also from the working directory, and return its attribute ``name``.

    Raises ImportError or AttributeError if there is none.
    """
    if "" not in sys.path:
        sys.path.append("")  # unlike python -m, installed commands do not search the working directory
    return getattr(importlib.import_module(module), name)


class Registry(Generic[T]):
    """Factories by name, for expressions on a command line or in a file.

    An expression is one call, or several joined by ``+``. A name without parentheses is a call without arguments;
    ``module:Class`` is imported, also from the working directory. Arguments are Python literals, or calls of the
    registry's ``values``, such as schedules. Nothing else is evaluated: every callable is registered or a subclass of
    ``base``.

    Args:
        kind: what the members are called in messages.
        base: common base class of the members.
        values: functions that arguments may call, by name.
        known: the initial factories, by name.

    Example:
        >>> from ca_reg.regularizers import REGULARIZERS
        >>> REGULARIZERS.make("dropout(ramp(0, 0.2, 0, 100)) + noise(0.8)")
        [GaussianDropout(p=LinearRamp(...), compensate=False), OpacityNoise(sigma=0.8, clip=False, scale=False)]
    """

    def __init__(
        self, kind: str, base: type[T], values: Mapping[str, Callable[..., Any]] = {}, **known: Callable[..., T]
    ) -> None:
        self.kind, self.base, self._values, self._factories = kind, base, dict(values), known

    def register(self, name: str) -> Callable[[_Factory], _Factory]:
        """Return a decorator that registers a class or a factory function under a name.

        Raises:
            ValueError: if the name is taken by something else.
        """

        def enter(factory: _Factory) -> _Factory:
            if self._factories.setdefault(name, factory) is not factory:
                raise ValueError(f"there is a {self.kind} {name!r} already: {self._factories[name]!r}.")
            return factory

        return enter

    def __iter__(self) -> Iterator[str]:
        return iter(self._factories)

    def __getitem__(self, name: str) -> Callable[..., T]:
        """Return the factory of a name, or the class that ``module.Class`` names.

        Raises:
            ValueError: if there is no such name, module or class, or the class is not a subclass of ``base``.
        """
        if "." not in name:
            if name not in self._factories:
                known = ", ".join(sorted(self._factories))
                raise ValueError(f"there is no {self.kind} {name!r}; choose one of {known}, or write module:Class.")
            return self._factories[name]
        module_name, _, class_name = name.rpartition(".")
        try:
            found = imported(module_name, class_name)
        except (ImportError, AttributeError, RecursionError) as error:
            raise ValueError(f"the {self.kind} {module_name}:{class_name} cannot be had: {error}.") from error
        if not (isinstance(found, type) and issubclass(found, self.base)):
            raise ValueError(f"{module_name}:{class_name} is no subclass of {self.base.__name__}: {found!r:.80}.")
        return found

    def make(self, text: str, *, imports: bool = True) -> list[T]:
        """Make the objects of an expression; an empty one makes none.

        ``imports`` says whether ``module:Class`` may be imported: not for text from an untrusted source.

        Raises:
            ValueError: if the text does not parse, a name is unknown, or an argument is rejected.
        """
        text = text.strip()
        try:
            terms = _terms(text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ValueError(f"{text!r:.200} cannot be read as {self.kind}s: {error}; {self._form()}") from error
        return [self._make(term, text, imports) for term in terms]

    def make_one(self, text: str) -> T:
        """Make the object of an expression that has exactly one.

        Raises a ValueError as `make` does, and if there is not exactly one.
        """
        made = self.make(text)
        if len(made) != 1:
            raise ValueError(f"expected one {self.kind}, got {len(made)} of {text!r:.200}; {self._form()}")
        return made[0]

    def _make(self, node: ast.expr, text: str, imports: bool) -> T:
        """Make one object."""
        call = node if isinstance(node, ast.Call) else ast.Call(node, [], [])  # a bare name stands for a call
        if not (name := _name(node, text)):
            raise ValueError(f"{_written(node, text)!r:.80} in {text!r:.200} is no {self.kind}; {self._form()}")
        if "." in name and not imports:
            raise ValueError(f"{name} in {text!r:.200} is not imported because a file says so: give it yourself.")
        factory = self[name]
        try:
            arguments, named = self._arguments(call, text)
            return factory(*arguments, **named)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{_written(node, text)!r:.200}: {error}") from error

    def _arguments(self, call: ast.Call, text: str) -> tuple[list[Any], dict[Any, Any]]:
        """Evaluate arguments: literals, and calls of the registry's values."""
        named: dict[Any, Any] = {}
        for keyword in call.keywords:
            if keyword.arg in named:
                raise ValueError(f"{keyword.arg} is given twice.")
            named[keyword.arg] = self._value(keyword.value, text)
        return [self._value(argument, text) for argument in call.args], named

    def _value(self, node: ast.expr, text: str) -> Any:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in self._values:
            arguments, named = self._arguments(node, text)
            return self._values[node.func.id](*arguments, **named)
        try:
            return ast.literal_eval(node)
        except ValueError as error:
            known = ", ".join([*self._values, "Python's literals"])
            raise ValueError(f"{_written(node, text)!r:.80} is none of {known}.") from error

    def _form(self) -> str:
        example = f"{next(iter(self._factories), 'name')}(...)"
        return f"write {example}, or several with + between them."


def modules(text: str) -> set[str]:
    """Return the modules that an expression names as ``module:Class``, which `Registry.make` would import.

    Raises ValueError if the text cannot be read.

    Example:
        >>> modules("dropout(0.1) + mine.drops:Mine('no:Module')")
        {'mine.drops'}
    """
    text = text.strip()
    try:
        names = [_name(term, text) for term in _terms(text)]
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise ValueError(f"{text!r:.200} cannot be read: {error}.") from error
    return {name.rpartition(".")[0] for name in names if "." in name}


def _terms(text: str) -> list[ast.expr]:
    """Return the calls and names that an expression joins by ``+``; raises what `ast.parse` raises."""
    if not text:
        return []
    # Turn module:Class into module.Class, which Python can parse, outside string literals; {1:True} stays.
    source = re.sub(r"""('[^']*'|"[^"]*")|([A-Za-z_][\w.]*):(?=[A-Za-z_])""", lambda x: x[1] or f"{x[2]}.", text)
    node: ast.expr = ast.parse(source, mode="eval").body
    terms: list[ast.expr] = []
    while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        terms.insert(0, node.right)
        node = node.left
    return [node, *terms]


def _name(node: ast.expr, text: str) -> str:
    """Return what a call or a name names, with ``.`` for ``:``; nothing if it is neither."""
    name = _written(node.func if isinstance(node, ast.Call) else node, text)
    return name.replace(":", ".") if re.fullmatch(r"[A-Za-z_][\w.:]*", name) else ""


def _written(node: ast.expr, text: str) -> str:
    """Return an expression as it is written in the text; unlike `ast.unparse`, however deep it is."""
    return ast.get_source_segment(text, node) or ""
