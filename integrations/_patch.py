"""Replace one attribute of a class, and put it back exactly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["ClassPatch"]

_INHERITED = object()


class ClassPatch:
    """A method of a class, its own or an inherited one, replaced by what ``make`` makes of it until :meth:`remove`.

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
        # From the dictionary of the class: getattr would turn a staticmethod into what it wraps.
        self._before = vars(owner).get(name, _INHERITED)
        self._replacement = make(getattr(owner, name))
        setattr(owner, name, self._replacement)

    def check_removable(self) -> None:
        """Raise RuntimeError if someone replaced the method again, whose replacement would be lost."""
        now = vars(self.owner).get(self.name, _INHERITED)
        if now is not self._replacement:
            raise RuntimeError(
                f"{self.owner.__qualname__}.{self.name} was replaced again after ca_reg had wrapped it; it is now "
                f"{'inherited' if now is _INHERITED else now}. Undo the replacements in the reverse order."
            )

    def remove(self) -> None:
        """Put the method back: the same object, or none if it was inherited; raises as `check_removable`."""
        self.check_removable()
        if self._before is _INHERITED:
            delattr(self.owner, self.name)
        else:
            setattr(self.owner, self.name, self._before)
