"""What the rasterizers of the INRIA family return, told by the names that callers give to it."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NoReturn

import torch
from torch import Tensor

__all__ = ["SAY_IT", "Picture", "Unknown", "kinds_of"]

SAY_IT = (
    "say what it is with outputs=..., in the launcher --outputs: all values in their order, such as image,radii,depth, "
    "of depth, inverse_depth, mean_depth, normal, distortion, alpha, weights, pixels and surfels, and + between those "
    "that share one as its channels: image+normal+depth+alpha+distortion,radii"
)
_SURFELS = "depth+alpha+normal+mean_depth+distortion"  # seven planes of 2DGS
_NAMES = {
    "image": {"image", "color", "colour", "rgb"},
    "radii": {"radii"},
    "depth": {"depth"},
    "inverse_depth": {"inverse_depth", "inv_depth", "invdepth", "inverse_depths", "inv_depths", "invdepths"},
    "alpha": {"alpha", "alphas", "acc", "accumulation", "opacity", "silhouette"},
    "normal": {"normal", "normals"},
    "mean_depth": {"mean_depth"},
    "distortion": {"distortion"},
    "weights": {"weights", "gs_w"},
    "pixels": {"pixels"},
    _SURFELS: {"surfels", "allmap"},
}
_KINDS = {name: kind for kind, names in _NAMES.items() for name in names}
_SCORES = {"accum_weights", "accum_count", "accum_blend", "accum_dist", "depths", "my_radii"}  # by Taming 3DGS's names
_TELLING_NOTHING = re.compile(r"^(.*\.)?((rendered|render|rend|out)_)?|_(image|img|map)$")


class Unknown:
    """Takes the place of a value that the stand-in cannot compute; whatever is done with it raises ValueError."""

    def __init__(self, name: str) -> None:
        self.name = name

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise ValueError(
            f"the rasterizer's output {self.name} is used, which the stand-in does not know by this name: {SAY_IT}; "
            "what is none of these needs CUDA."
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


class Picture(Tensor):
    """Planes (C, H, W) that raise ValueError when asked for a channel that they lack.

    A slice beyond the end of a plain tensor would silently be empty. Results computed from planes are plain tensors.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    def __getitem__(self, index: Any) -> Tensor:
        """Return what a tensor would."""
        first = index[0] if isinstance(index, tuple) and index else index
        last = max(first.start or 0, (first.stop or 1) - 1) if isinstance(first, slice) else first
        if isinstance(last, int) and last >= len(self):
            raise ValueError(
                f"channel {last} of a picture is asked for, of which the stand-in rasterizer draws {len(self)} "
                f"channels: {SAY_IT}; what is none of these needs CUDA."
            )
        return super().__getitem__(index)


for _operator in ("getitem", "len", "iter", "bool", "gt", "lt", "add", "mul", "truediv", "radd", "rmul", "neg"):
    setattr(Unknown, f"__{_operator}__", Unknown._refuse)


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
