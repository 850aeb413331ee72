"""What the rasterizers of the INRIA family return, told by its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

__all__ = ["SAY_IT", "Unknown", "kinds_of"]

SAY_IT = (
    "say what it is with outputs=..., in the launcher --outputs: all values in their order, such as image,radii,depth, "
    "of depth, inverse_depth, alpha, weights and surfels"
)
_NAMES = {
    "image": {"image", "color", "colour", "rgb"},
    "radii": {"radii"},
    "depth": {"depth"},
    "inverse_depth": {"inverse_depth", "inv_depth", "invdepth", "inverse_depths", "inv_depths", "invdepths"},
    "alpha": {"alpha", "alphas", "acc", "accumulation", "opacity", "silhouette"},
    "weights": {"weights", "gs_w"},
    "surfels": {"surfels", "allmap"},  # seven planes of 2DGS
}
_KINDS = {name: kind for kind, names in _NAMES.items() for name in names}
_SCORES = {"accum_weights", "accum_count", "accum_blend", "accum_dist", "depths", "my_radii"}  # by Taming 3DGS's names
_PREFIXES = ("rendered_", "render_", "rend_", "out_")
_SUFFIXES = ("_image", "_img", "_map")


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


for _operator in ("getitem", "len", "iter", "bool", "gt", "lt", "add", "mul", "truediv", "radd", "rmul", "neg"):
    setattr(Unknown, f"__{_operator}__", Unknown._refuse)


def kinds_of(names: tuple[str, ...] | None, fields: set[str]) -> tuple[str | None, ...]:
    """Return what the values are; None for an unknown one. Image and radii come first if no name says otherwise.

    Args:
        names: by which the caller calls the values; None if it does not take them apart.
        fields: of the settings, as the caller gives them: with ``antialiasing`` (INRIA since October 2024) a third of
            three values is an inverse depth, whatever its name, and with ``confidence`` (FSGS) there are four; with
            ``pixel_weights`` (Taming 3DGS) there are scores of the Gaussians, under their own names.

    Raises:
        ValueError: if neither names nor settings tell.

    Example:
        >>> kinds_of(("rendered_image", "radii", "rendered_depth", "is_used"), set())
        ('image', 'radii', 'depth', None)
        >>> kinds_of(("count", "score", "rendered_image", "radii"), set())
        (None, None, 'image', 'radii')
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
    kinds = [name if name in scores else _KINDS.get(_plain(name)) for name in names]
    for place, kind in enumerate(first):
        if kind not in kinds:
            kinds[place : place + 1] = [kind]
    return tuple(kinds)


def _plain(name: str) -> str:
    """Return a name without what does not tell: ``self.rendered_depth_map`` is a depth."""
    plain = name.lower().rpartition(".")[2]
    for prefix in _PREFIXES:
        plain = plain.removeprefix(prefix)
    for suffix in _SUFFIXES:
        plain = plain.removesuffix(suffix)
    return plain
