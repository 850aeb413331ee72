"""Find out from the calling `render` function what a rasterizer call is for.

The tensors tell neither a viewer's render from a training render nor which model they belong to. The local variables of
the calling function do, in every code base of the family and in any import order; they are only read.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from traceback import walk_stack
from types import CodeType
from typing import Any, NamedTuple

from ca_reg import Chain, OpacityNoise

__all__ = ["Caller", "calling_render", "find_instance", "is_viewer", "refuse_a_second_regularizer"]

_OUTWARD = 8  # foreign frames to search for a render function


class Caller(NamedTuple):
    """The function that asks for a render.

    Args:
        variables: its local variables.
        place: code and instruction of each frame from it outward: the same for all renders of one call in a loop.
    """

    variables: Mapping[str, Any]
    place: tuple[tuple[CodeType, int], ...]


def calling_render() -> Caller:
    """Return the nearest caller named render..., else the nearest outside of this package and torch."""
    stack = [frame for frame, _ in walk_stack(sys._getframe(1))]
    foreign = [frame for frame in stack if _is_foreign(frame.f_globals.get("__name__", ""))][:_OUTWARD]
    renders = [frame for frame in foreign if frame.f_code.co_name.startswith("render")]
    for found in (*renders, *foreign):
        place = stack[stack.index(found) :]
        return Caller(dict(found.f_locals), tuple((frame.f_code, frame.f_lasti) for frame in place))
    return Caller({}, ())


def _is_foreign(module: str) -> bool:
    return module.rpartition(".")[0] != __package__ and module.partition(".")[0] != "torch"


def find_instance(variables: Mapping[str, Any], classes: tuple[type, ...]) -> Any:
    """Return the first variable that is an instance of one of the classes, else None."""
    return next((x for x in variables.values() if isinstance(x, classes)), None)


def is_viewer(variables: Mapping[str, Any], camera: str | None) -> bool:
    """Whether a viewer asked for the render; it does so with gradients enabled, before the training render.

    ``camera`` is the class name of the viewer's cameras, None if there is no viewer.
    """
    return camera is not None and any(type(x).__name__ == camera for x in variables.values())


def refuse_a_second_regularizer(variables: Mapping[str, Any], chain: Chain) -> None:
    """Raise a RuntimeError if the calling render, as in the paper's code, already does what the chain does."""
    perturbs = any(isinstance(member, OpacityNoise) for member in chain) and variables.get("train", True)
    for name, kind, applies in (
        ("dropout_factor", "GaussianDropout", chain.drops),
        ("sigma_noise", "OpacityNoise", perturbs),
    ):
        value = variables.get(name)
        if applies and isinstance(value, (int, float)) and value > 0:
            raise RuntimeError(
                f"{kind} would be applied twice: the calling render has {name}={value:g}; switch it off with "
                f"--{name} 0."
            )
