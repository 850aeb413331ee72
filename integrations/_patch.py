"""Replace a method of a class, and restore it exactly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["ClassPatch"]

_INHERITED = object()


class ClassPatch:
    """Replaces a method of a class, its own or inherited, by ``make(method)`` until :meth:`remove`.

    Example:
        >>> class Greeter:
        ...     def greet(self):
        ...         return "hello"
        >>> before = vars(Greeter)["greet"]
        >>> patch = ClassPatch(Greeter, "greet", lambda greet: lambda self: greet(self).upper())
        >>> Greeter().greet()
        'HELLO'
        >>> patch.remove()
        >>> vars(Greeter)["greet"] is before
        True
    """

    def __init__(self, owner: type, name: str, make: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
        self.owner = owner
        self.name = name
        # From the class dictionary: getattr would unwrap a staticmethod.
        self._before = vars(owner).get(name, _INHERITED)
        self._replacement = make(getattr(owner, name))
        setattr(owner, name, self._replacement)

    def check_removable(self) -> None:
        """Raise RuntimeError if the method was replaced again since; that replacement would be lost."""
        now = vars(self.owner).get(self.name, _INHERITED)
        if now is not self._replacement:
            raise RuntimeError(
                f"{self.owner.__qualname__}.{self.name} was replaced again after ca_reg had wrapped it; it is now "
                f"{'inherited' if now is _INHERITED else now}. Undo the replacements in the reverse order."
            )

    def remove(self) -> None:
        """Restore the same object, or delete the attribute if it was inherited; raises as `check_removable`."""
        self.check_removable()
        if self._before is _INHERITED:
            delattr(self.owner, self.name)
        else:
            setattr(self.owner, self.name, self._before)
