"""What the rasterizers of the INRIA family return, told by the names that their callers give to it."""

from __future__ import annotations

import ast
import copy
import functools
import inspect
import linecache
import re
import sys
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any, NoReturn

import torch
from torch import Tensor

__all__ = ["SAY_IT", "Planes", "Unknown", "kinds_of", "names_of_results"]

SAY_IT = (
    "say what it is with outputs=..., in the launcher --outputs: all values in their order, such as image,radii,depth, "
    "of depth, inverse_depth, mean_depth, normal, distortion, alpha, weights, pixels, surfels, metric_counts, heaviest "
    "and largest_weight, and + between those "
    "that share one as its channels: image+normal+depth+alpha+distortion,radii"
)
_SURFELS = "depth+alpha+normal+mean_depth+distortion"  # seven planes of 2DGS
_NAMES: dict[str, set[str]] = {  # further names of each kind
    "image": {"color", "colour", "rgb"},
    "radii": set(),
    "depth": set(),
    "inverse_depth": {"inv_depth", "invdepth", "inverse_depths", "inv_depths", "invdepths"},
    "alpha": {"alphas", "acc", "accumulation", "opacity", "silhouette"},
    "normal": {"normals"},
    "mean_depth": set(),
    "distortion": set(),
    "weights": {"gs_w"},
    "pixels": set(),
    "metric_counts": {"accum_metric_counts"},
    "heaviest": {"max_weights_idx"},
    "largest_weight": {"max_weights"},
    _SURFELS: {"surfels", "allmap"},
}
_KINDS = {name: kind for kind, names in _NAMES.items() for name in (kind, *names)}
_SCORES = {"accum_weights", "accum_count", "accum_blend", "accum_dist", "depths", "my_radii"}  # by Taming 3DGS's names
# Prefixes and suffixes that say only that a value was rendered, or that it is a picture.
_TELLING_NOTHING = re.compile(r"^(.*\.)?((rendered|render|rend|out)_)?|_(image|img|map)$")


class Unknown:
    """Takes the place of a value that the stand-in cannot compute; whatever is done with it raises ValueError.

    It may be handed on, and compared with None, as many scripts do with what a rasterizer may lack.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise ValueError(
            f"the rasterizer's output {self.name} is used, which the stand-in does not know by this name: {SAY_IT}; "
            "anything else needs CUDA."
        )

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        self._refuse()

    @classmethod
    def __torch_function__(
        cls, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> NoReturn:
        """Refuse to be an argument of a torch function."""
        values = [*args, *(kwargs or {}).values()]
        lists = [x for value in values if isinstance(value, list | tuple) for x in value]
        next(x for x in values + lists if isinstance(x, cls))._refuse()

    def __eq__(self, other: object) -> bool:
        """Refuse a comparison, but with None."""
        if other is not None:
            self._refuse()
        return False

    __hash__ = object.__hash__


# Python looks for these at the class, and would say that the class has none of them.
for _operator in (
    "add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv", "floordiv", "rfloordiv", "mod", "rmod", "pow",
    "rpow", "matmul", "rmatmul", "and", "rand", "or", "ror", "xor", "rxor", "neg", "abs", "invert", "lt", "le", "gt",
    "ge", "bool", "int", "float", "index", "len", "iter", "getitem", "setitem", "array",
):  # fmt: skip
    setattr(Unknown, f"__{_operator}__", Unknown._refuse)


class Planes(Tensor):
    """Planes (C, H, W) that raise ValueError when asked for a channel that they lack.

    A slice beyond the end of a plain tensor would silently be empty. Results computed from planes are plain tensors; so
    are deep copies, and what is loaded from a file.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    def __getitem__(self, index: Any) -> Tensor:
        """Return what a tensor would."""
        first = index[0] if isinstance(index, tuple) and index else index
        last = max(first.start or 0, (first.stop or 1) - 1) if isinstance(first, slice) else first
        if isinstance(last, int) and last >= len(self):
            raise ValueError(
                f"channel {last} of a picture was asked for, but the stand-in rasterizer renders {len(self)} channels: "
                f"{SAY_IT}; anything else needs CUDA."
            )
        return super().__getitem__(index)

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        """Return what a tensor would, which does not know how to make a subclass anew."""
        return copy.deepcopy(self.as_subclass(Tensor), memo)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Be kept as a tensor, which loads without this package, and with ``weights_only``."""
        return self.as_subclass(Tensor).__reduce_ex__(protocol)  # type: ignore[no-untyped-call]


def kinds_of(names: tuple[str, ...] | None, fields: set[str]) -> tuple[str | None, ...]:
    """Return the kind of each value, None if unknown. Image and radii come first if no name says otherwise.

    A value that has several kinds as its channels has their names joined by +.

    Args:
        names: what the caller calls the values; None if it does not unpack them.
        fields: names of the settings that the caller gives: with ``antialiasing`` (INRIA since October 2024) the third
            of three values is an inverse depth, whatever its name; with ``confidence`` (FSGS) there are four; with
            ``pixel_weights`` (Taming 3DGS) there are scores of the Gaussians, under their own names.

    Raises:
        ValueError: if neither names nor settings tell.

    Example:
        >>> kinds_of(("rendered_image", "radii", "rendered_depth", "is_used"), set())
        ('image', 'radii', 'depth', None)
        >>> kinds_of(("count", "score", "rendered_image", "radii"), set())
        (None, None, 'image', 'radii')
        >>> kinds_of(("rendered_image+normal", "radii"), set())
        ('image+normal', 'radii')
        >>> kinds_of(("rendered_image", "radii", "depth_image"), {"antialiasing"})
        ('image', 'radii', 'inverse_depth')
    """
    first: tuple[str | None, ...] = ("image", "radii")
    if names is None:
        if "confidence" in fields:
            return (*first, "depth", "alpha")
        if "antialiasing" not in fields:
            raise ValueError(
                f"cannot tell what the rasterizer should return, which its caller does not unpack: {SAY_IT}."
            )
        return (*first, "inverse_depth")
    if len(names) == 3 and "antialiasing" in fields:
        return (*first, "inverse_depth")
    scores = _SCORES if "pixel_weights" in fields else set()
    kinds = [name if name in scores else _kind(name) for name in names]
    for place, kind in enumerate(first):
        if all(kind not in (known or "").split("+") for known in kinds):
            kinds[place : place + 1] = [kind]
    return tuple(kinds)


def _kind(name: str) -> str | None:
    """Return what a value is by its name, or by those of its channels; ``self.rendered_depth_map`` is a depth."""
    parts = [_KINDS.get(_TELLING_NOTHING.sub("", part.lower())) for part in name.split("+")]
    return None if None in parts else "+".join(map(str, parts))


_BETWEEN = ("torch.", "ca_reg.", f"{__package__}.")  # packages whose frames lie between a caller and a stand-in

_Place = tuple[int | None, ...]  # first and last line and column of an expression


def names_of_results() -> tuple[str, ...] | None:
    """Return the names to which the caller of a stand-in assigns the members of its result; None if it cannot be told.

    They are those of ``image, radii = rasterizer(...)``, or of ``image, radii = result`` if that is how the same
    function unpacks its ``result = rasterizer(...)``. For ``rasterizer(...)[1]`` they are ("0", "1").

    Example:
        >>> def distances():
        ...     return names_of_results()
        >>> names_of_results() is None  # the result is compared, and not taken apart
        True
    """
    frame: FrameType | None = sys._getframe(1)
    # A hook of this package, or torch's call of a module, may stand between the caller and the rasterizer.
    while frame is not None and f"{frame.f_globals.get('__name__')}.".startswith(_BETWEEN):
        frame = frame.f_back
    if frame is None:
        return None
    place = inspect.getframeinfo(frame, context=0).positions
    source = "".join(linecache.getlines(frame.f_code.co_filename, frame.f_globals))
    return None if place is None else _uses(source).get(tuple(place)) or None


@functools.lru_cache(maxsize=64)
def _uses(source: str) -> Mapping[_Place, tuple[str, ...]]:
    """Return the names by the place of each call whose result is unpacked."""
    found: dict[_Place, tuple[str, ...]] = {}
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return found
    for scope in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Module)]:
        nodes = list(ast.walk(scope))
        # Of names alone: `result = rasterizer(...)`, and further down `image, radii = result`.
        taken_apart = {
            node.value.id: names
            for node in nodes
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Name) and (names := _members(node.targets))
        }
        for node in nodes:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
                target = node.targets[0]
                names = _members(node.targets) or taken_apart.get(target.id if isinstance(target, ast.Name) else "")
                found[_place(node.value)] = names or ()  # the innermost scope, which comes last, knows best
            elif isinstance(node, ast.Subscript) and isinstance(node.value, ast.Call):
                index = node.slice.value if isinstance(node.slice, ast.Constant) else None
                if isinstance(index, int) and index >= 0:
                    found[_place(node.value)] = tuple(map(str, range(index + 1)))
    return found


def _members(targets: list[ast.expr]) -> tuple[str, ...] | None:
    """Return the names of an assignment to several, None of any other."""
    target = targets[0]
    if not isinstance(target, ast.Tuple | ast.List) or any(isinstance(name, ast.Starred) for name in target.elts):
        return None
    return tuple(ast.unparse(name) for name in target.elts)


def _place(node: ast.expr) -> _Place:
    return node.lineno, node.end_lineno, node.col_offset, node.end_col_offset
