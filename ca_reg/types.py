"""The interface that a renderer offers to this package, and the parsing of what it returns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np
import torch
from torch import Tensor

from ca_reg.functional import Multiplier

__all__ = [
    "ExactMoments", "Layout", "MomentsFn", "RenderFn", "Rendering", "read_alpha_pass", "read_moments", "read_rendering"
]  # fmt: skip

Layout = Literal["CHW", "HWC"]
"""Order of the axes of the images that a renderer returns."""

_IMAGE_NAMES = ("image", "render", "rgb", "rendered_image")
_ALPHA_NAMES = ("alpha", "rendered_alpha", "accumulation")
_FORMS = (
    "return (image, alpha), the image alone, or a mapping or object with an image named "
    f"{' | '.join(_IMAGE_NAMES)} and an alpha named {' | '.join(_ALPHA_NAMES)}"
)


class RenderFn(Protocol):
    """A user's renderer of a model: ``render_fn(opacity, view)``.

    It renders ``view``, of any type, with ``opacity`` in place of the model's activated opacities, and returns one of

    - a tuple ``(image, alpha)`` in either order, or ``(image,)``;
    - the image alone;
    - a mapping or an object with an image named ``image``, ``render``, ``rgb`` or ``rendered_image`` and, if there is
      one, an alpha named ``alpha``, ``rendered_alpha`` or ``accumulation``.

    The image is RGB, (3, H, W) or (H, W, 3) as the layout says, the alpha (H, W), (1, H, W) or (H, W, 1); both are
    floating-point torch tensors or numpy arrays; a batch axis of 1 is dropped. Longer tuples are refused:
    in ``(color, radii, depth, alpha)`` nothing but the position tells depth from alpha.

    A faster way to render several sets of opacities is a method ``render_batch(opacities, view)``, which a score then
    calls instead: up to 8 sets, stacked along a new first axis; it returns two sequences, images and alphas.

    Example:
        >>> def render_fn(opacity: Tensor, view: str) -> tuple[Tensor, Tensor]:
        ...     alpha = opacity.mean().expand(4, 5)
        ...     return alpha.expand(3, 4, 5), alpha
    """

    def __call__(self, opacity: Tensor, view: Any, /) -> Any:
        """Render ``view`` with these activated opacities, whose shape is the one the score was given."""


class MomentsFn(Protocol):
    """A renderer that offers exact moments: ``moments_fn(opacity, view, multiplier, background)``.

    It renders what :class:`RenderFn` does, but over all draws of an independent random factor on the alpha of every
    splat (:func:`ca_reg.functional.pixel_moments`), and returns a mapping or an object with

    - ``mean``: expected colors over the background, (3, H, W), or (H, W, 3) as the layout says;
    - ``variance``: variances of the colors, same shape;
    - ``alpha_mean``: expected accumulated alpha, (H, W), (1, H, W) or (H, W, 1); a score needs it, a penalty does not.

    ``background`` is None for the model's own, one color (3,), or an image. The renderer must not stop early at an
    opaque surface: splats behind it show where those of the surface are dropped.

    Example:
        >>> from ca_reg.functional import alpha_moments, pixel_moments
        >>> def moments_fn(
        ...     opacity: Tensor, view: Tensor, multiplier: Multiplier, background: Tensor | None
        ... ) -> dict[str, Tensor]:
        ...     mean, variance = pixel_moments(opacity, view, multiplier, background=background)
        ...     images = {"mean": mean, "variance": variance}
        ...     return {name: x[:, None, None].expand(3, 4, 5) for name, x in images.items()} | {
        ...         "alpha_mean": alpha_moments(opacity, multiplier).mean.expand(4, 5)
        ...     }
    """

    def __call__(self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None, /) -> Any:
        """Render the moments of ``view`` with these activated opacities, neither dropped nor scaled."""


class Rendering(NamedTuple):
    """One RGB image (3, H, W) and its accumulated alpha (H, W), None if the renderer returned none."""

    image: Tensor
    alpha: Tensor | None = None


class ExactMoments(NamedTuple):
    """Moments of one image over the random factors, (3, H, W); ``alpha_mean`` is None if none was returned."""

    mean: Tensor
    variance: Tensor
    alpha_mean: Tensor | None  # expected, (H, W)


def read_rendering(result: Any, *, layout: Layout = "CHW") -> Rendering:
    """Normalize what a :class:`RenderFn` returned; tensors in it are not copied.

    Raises:
        TypeError: if the result is of an unsupported type, has no image, or is not floating point.
        ValueError: if a shape does not fit, a tuple has more than two members, or ``layout`` is unknown.

    Example:
        >>> result = {"rgb": np.zeros((4, 5, 3), np.float32), "accumulation": np.ones((4, 5, 1), np.float32)}
        >>> image, alpha = read_rendering(result, layout="HWC")
        >>> image.shape, alpha.shape
        (torch.Size([3, 4, 5]), torch.Size([4, 5]))
    """
    check_layout(layout)
    if isinstance(result, Tensor | np.ndarray):
        return Rendering(_read_image(_as_tensor(result, "image"), layout))
    if isinstance(result, tuple | list) and not hasattr(result, "_fields"):
        return _read_tuple(result, layout)
    image, alpha = _by_name(result, _IMAGE_NAMES), _by_name(result, _ALPHA_NAMES)
    if image is None:
        raise TypeError(f"a render callable returned {_describe(result)} without an image; {_FORMS}.")
    read = _read_image(_as_tensor(image, "image"), layout)
    return Rendering(read, None if alpha is None else _read_alpha(alpha, read))


def read_alpha_pass(result: Any, image: Tensor, *, layout: Layout = "CHW") -> Tensor:
    """Read the accumulated alpha (H, W) off a white-on-black render, whose colors are all 1 over a background of 0.

    The result may also be the alpha itself, (H, W), (1, H, W) or (H, W, 1).

    Raises TypeError or ValueError if it is neither, or its size is not that of ``image``, (3, H, W).

    Example:
        >>> white = torch.full((3, 4, 5), 0.9)
        >>> read_alpha_pass(white, torch.zeros(3, 4, 5)).shape
        torch.Size([4, 5])
    """
    if isinstance(result, Tensor | np.ndarray):
        plane = _as_plane(_as_tensor(result, "alpha"), image)
        if plane is not None:
            return plane
    white = read_rendering(result, layout=layout).image
    if white.shape != image.shape:
        raise ValueError(
            f"the white-on-black render has shape {tuple(white.shape)}, the image {tuple(image.shape)} (as CHW); "
            "alpha_fn must render the same view at the same size."
        )
    return white.mean(0)


def read_moments(result: Any, *, layout: Layout = "CHW") -> ExactMoments:
    """Normalize what a :class:`MomentsFn` returned.

    Raises:
        TypeError: if a member is missing or not floating point.
        ValueError: if a shape does not fit, or ``layout`` is unknown.

    Example:
        >>> image = torch.rand(4, 5, 3)
        >>> result = {"mean": image, "variance": image / 9, "alpha_mean": torch.ones(4, 5)}
        >>> read_moments(result, layout="HWC").variance.shape
        torch.Size([3, 4, 5])
    """
    check_layout(layout)
    images = {name: _by_name(result, (name,)) for name in ("mean", "variance")}
    missing = [name for name, x in images.items() if x is None]
    if missing:
        raise TypeError(
            f"a moments callable returned {_describe(result)} without {', '.join(missing)}; return a mapping or object "
            f"with {', '.join(ExactMoments._fields)}."
        )
    mean, variance = (_read_image(_as_tensor(x, "an image of moments"), layout) for x in images.values())
    if variance.shape != mean.shape:
        raise ValueError(
            f"mean and variance of a moments callable must have one shape, got {tuple(mean.shape)} and "
            f"{tuple(variance.shape)} (as CHW)."
        )
    alpha = _by_name(result, ("alpha_mean",))
    return ExactMoments(mean, variance, None if alpha is None else _read_alpha(alpha, mean))


def check_layout(layout: str) -> None:
    """Raise unless ``layout`` is known."""
    if layout not in get_args(Layout):
        raise ValueError(f"layout must be one of {', '.join(get_args(Layout))}, got {layout!r}.")


def _read_tuple(result: tuple[Any, ...] | list[Any], layout: Layout) -> Rendering:
    """Tell image and alpha apart by their shapes, in a tuple of one or two."""
    if not 1 <= len(result) <= 2:
        raise ValueError(
            f"a render callable returned a tuple of {len(result)}: {_describe(result)}; which member is the alpha "
            "cannot be told from a depth map. Pick the two: return (image, alpha)."
        )
    members = [_as_tensor(x, f"member {i} of the tuple") for i, x in enumerate(result)]
    if len(members) == 1:
        return Rendering(_read_image(members[0], layout))
    for image, alpha in (members, members[::-1]):
        if _is_image(image, layout):
            read = _read_image(image, layout)
            plane = _as_plane(alpha, read)
            if plane is not None:
                return Rendering(read, plane)
    raise ValueError(
        f"a render callable returned {_describe(result)}, expected an RGB image in {layout} order and an alpha of its "
        "size, (H, W), (1, H, W) or (H, W, 1). If the second member is not the alpha (INRIA rasterizers return radii "
        "there), return the image alone and give CAScore an alpha_fn; if the axes are in another order, set layout."
    )


def _by_name(result: Any, names: tuple[str, ...]) -> Any:
    """Return the first value under one of ``names``, in a mapping or an object, that is not None."""
    for name in names:
        value = result.get(name) if isinstance(result, Mapping) else getattr(result, name, None)
        if value is not None:
            return value
    return None


def _as_tensor(x: Any, name: str) -> Tensor:
    """Return a floating-point tensor without a batch axis, or raise."""
    if isinstance(x, np.ndarray):
        x = torch.from_numpy(np.array(x))  # copied: torch takes neither read-only memory nor negative strides
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} of a render callable must be a torch tensor or a numpy array, got {type(x).__name__}.")
    if not x.is_floating_point():
        raise TypeError(
            f"{name} of a render callable must be floating point with colors in [0, 1], got {x.dtype}; "
            "return the raw render, not the 8-bit picture."
        )
    return x[0] if x.ndim == 4 and x.shape[0] == 1 else x


def _is_image(x: Tensor, layout: Layout) -> bool:
    """Whether the tensor is an RGB image in this layout."""
    return x.ndim == 3 and x.shape[layout.index("C")] == 3


def _read_image(x: Tensor, layout: Layout) -> Tensor:
    """Return an image as (3, H, W), or raise."""
    if not _is_image(x, layout):
        expected = "(3, H, W)" if layout == "CHW" else "(H, W, 3)"
        raise ValueError(
            f"the image of a render callable must be RGB of shape {expected} (layout {layout!r}), "
            f"got {tuple(x.shape)}; set layout if the axes are in the other order."
        )
    return x if layout == "CHW" else x.permute(2, 0, 1)


def _read_alpha(x: Any, image: Tensor) -> Tensor:
    """Return a named alpha as (H, W), or raise."""
    alpha = _as_tensor(x, "alpha")
    plane = _as_plane(alpha, image)
    if plane is None:
        raise ValueError(
            f"the alpha of a render callable must have the size of its image, (H, W) = {tuple(image.shape[1:])}, "
            f"(1, H, W) or (H, W, 1), got {tuple(alpha.shape)}."
        )
    return plane


def _as_plane(x: Tensor, image: Tensor) -> Tensor | None:
    """Return a one-channel map of the size of ``image`` as (H, W); None if ``x`` is not one."""
    height, width = image.shape[1:]
    if tuple(x.shape) in ((height, width), (1, height, width), (height, width, 1)):
        return x.reshape(height, width)
    return None


def _describe(result: Any) -> str:
    """Describe the type of a result and the shapes in it."""
    if isinstance(result, tuple | list):
        return "(" + ", ".join(_describe(x) for x in result) + ")"
    if isinstance(result, Mapping):
        return f"{type(result).__name__} with the keys {', '.join(map(str, result))}"
    shape = getattr(result, "shape", None)
    return type(result).__name__ if shape is None else f"{type(result).__name__} {tuple(shape)}"
