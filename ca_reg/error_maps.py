"""Where a picture is wrong: the expected error of every pixel of a view that has no photograph, in units of color.

What a model knows of its own mistakes is cheap to read off: how much a pixel varies when Gaussians are missing, how
much the colors along its ray disagree, what covers it, how many training photographs saw that, and what these
photographs show there. :func:`expected_error` adds such maps up with fixed weights. A renderer that offers less gets a
coarser map from what it has.

The weights were fitted on seven scenes, to models with and without dropout; what they are worth on a scene that had no
part in the fit is in ``benchmarks/error_map.md``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ca_reg._accumulate import finite_colors
from ca_reg._check import check_callable, check_opacity, check_opacity_range, check_rate, check_tensor
from ca_reg.functional import Multiplier
from ca_reg.lists import ListMoments
from ca_reg.types import Layout, MomentsFn, RenderFn, read_moments, read_rendering

__all__ = ["ErrorMap", "error_map", "expected_error"]

PLAIN_RATE = 0.1
"""Drop rate of the deviation for models trained without dropout: there, the ranking of pixels is best at low rates."""

SMOOTHING = 1.0
"""Standard deviation, pixels, of the blur of the map: errors are wider than a pixel, and the features noisy."""

_BRIGHTEST = 16.0  # no color of a model is that far above 1, and hardly a picture of 8 bits stays below
_NORMAL_80 = 1.2816  # 80 % of a normal distribution lie within so many standard deviations


class Form(NamedTuple):
    """A sum of features that was fitted as a whole.

    ``weights`` are in units of color; a product of two features counts one where the other is 1. ``peaked`` is the
    ratio of a view's mean squared error to the mean square of its expected error. ``spread`` is the root mean square
    difference of measured and expected PSNR, dB, on scenes left out of the fit.
    """

    weights: Mapping[str, float]
    peaked: float
    spread: float

    @property
    def needs(self) -> set[str]:
        """The features in it."""
        return {name for term in self.weights for name in _factors(term)}


FORMS = (
    Form({"constant": 0.0092, "deviation": 0.859, "warp": 0.320, "hidden*colors": 0.234}, 2.18, 2.9),
    Form({"constant": 0.0070, "deviation": 1.122, "colors": 0.085, "empty": 0.025}, 2.38, 4.1),
    Form({"constant": 0.0092, "deviation": 1.666, "empty": 0.031}, 2.34, 3.8),
    Form({"constant": 0.0244, "contrast": 0.304, "empty": 0.049}, 2.61, 5.5),
)
"""From the form that needs most to the one that needs an image and its alpha alone."""

TRANSFER = 0.87
"""Ratio of a view's mean error to the error that is predicted for it by leaving out each photograph in turn.

That prediction compares, at the photographs, measured with expected differences: their ratio times this is the ``unit``
of :func:`expected_error`."""


class ErrorMap(NamedTuple):
    """What :func:`error_map` expects.

    Attributes:
        error: expected absolute error of the color, mean over RGB, colors in [0, 1], shape (H, W).
        psnr: expected of the view, dB, over the pixels that count; nan if none does. It is low
            where a training failed, but ranks neither good ones nor settings: a plain model expects too much of itself.
        interval: in which the PSNR should lie in 80 % of the cases, dB.
    """

    error: Tensor
    psnr: float
    interval: tuple[float, float]


def expected_error(features: Mapping[str, Tensor], mask: Tensor | None = None, *, unit: float = 1.0) -> ErrorMap:
    """Return the expected error of a view from its features: a weighted sum of them, smoothed.

    The sum is the most demanding of `FORMS` whose features are all given. The features, of shape (H, W):

    - ``empty``: 1 - alpha;
    - ``contrast``: length of the gradient of the image's mean over RGB, per pixel;
    - ``deviation``: root of the exact variance of the color, mean over RGB, under dropout at the training rate;
    - ``colors``: root of :func:`ca_reg.functional.color_variance`: surfaces along the ray that disagree;
    - ``hidden``: 1 where no training photograph, warped into the view by the model's depth, shows the pixel, else 0;
    - ``warp``: least absolute difference, mean over RGB, to the photographs that show it, 0 where none does.

    Args:
        features: by name.
        mask: which pixels count for the PSNR, (H, W) bool; None for all.
        unit: factor on the map: how much harder than the scenes of the fit this one is.

    Raises:
        TypeError: if a feature is no tensor.
        ValueError: if no form has its features, the shapes differ, or the mask is not bool.

    Example:
        >>> flat, step = torch.zeros(8, 8), torch.zeros(8, 8)
        >>> step[:, 4:] = 1.0
        >>> found = expected_error({"empty": flat, "contrast": step})
        >>> bool(found.error[4, 7] > found.error[4, 0] > 0), found.error.shape
        (True, torch.Size([8, 8]))
    """
    for name, feature in features.items():
        check_tensor(feature, name, "give maps of shape (H, W)")
    form = next((form for form in FORMS if form.needs <= {*features}), None)
    if form is None:
        needed = " and ".join(sorted(FORMS[-1].needs))
        raise ValueError(f"an error map needs at least {needed}, got {', '.join(features) or 'nothing'}.")
    shapes = {features[name].shape for name in form.needs}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"features must share one shape (H, W), got {', '.join(str(tuple(x)) for x in shapes)}.")
    if mask is not None and (mask.dtype != torch.bool or mask.shape not in shapes):
        raise ValueError(f"mask must be bool and of the features' shape, got {mask.dtype}, {tuple(mask.shape)}.")
    total = torch.zeros_like(features["deviation" if "deviation" in form.needs else "empty"])
    for term, weight in form.weights.items():
        total = total + weight * math.prod((features[name] for name in _factors(term)), start=torch.ones_like(total))
    error = unit * smoothed(total)
    squared = error.square() if mask is None else error[mask].square()
    psnr = float(-10 * (form.peaked * squared.double().mean()).log10())
    return ErrorMap(error, psnr, (psnr - _NORMAL_80 * form.spread, psnr + _NORMAL_80 * form.spread))


@torch.no_grad()
def error_map(
    render_fn: RenderFn,
    opacity: Tensor,
    view: Any,
    *,
    moments_fn: MomentsFn | None = None,
    p: float = 0.0,
    layout: Layout = "CHW",
    known: Mapping[str, Tensor] = MappingProxyType({}),
) -> ErrorMap:
    """Expect the error of a view without a photograph, from what a renderer offers.

    An image and its alpha are enough for a map, moments make it better (one more render in cost), and lists of the
    Gaussians of each pixel, :class:`~ca_reg.lists.ListMoments`, better still. The reference trainer's own,
    ``reference_trainer.evaluation.error_maps``, also asks the training photographs.

    Args:
        render_fn: the renderer of the model; it must return an alpha.
        opacity: activated, neither scaled nor dropped, (N,) or (N, 1).
        view: what ``render_fn`` takes.
        moments_fn: the renderer's exact moments.
        p: dropout rate that the model was trained with; the image is rendered with opacities of ``1 - p``.
        layout: order of the axes of the renderer's images; those of moments may also be CHW.
        known: further features, see :func:`expected_error`, such as ``warp`` and ``hidden``.

    Raises:
        TypeError: if an argument is of the wrong type.
        ValueError: if one is out of range, ``opacity`` looks like logits, ``render_fn`` returns no alpha, or one above
            1, or what was rendered is not finite where alpha is not 0.

    Example:
        A wall with a hole: what is not covered is expected to be wrong.

        >>> def render_fn(opacity: Tensor, view: None) -> tuple[Tensor, Tensor]:
        ...     alpha = opacity.expand(6, 6).clone()
        ...     alpha[:, 3:] = 0
        ...     return 0.5 * alpha.expand(3, 6, 6), alpha
        >>> error = error_map(render_fn, torch.tensor([0.9]), None).error
        >>> bool(error[3, 5] > error[3, 0])
        True
    """
    check_callable(render_fn, "render_fn")
    check_opacity(opacity)
    check_opacity_range(opacity)
    check_rate(p)
    expected = opacity.detach() * (1 - p)
    image, alpha = read_rendering(render_fn(expected.clone(), view), layout=layout)  # a copy: it may edit them
    if alpha is None:
        raise ValueError("render_fn must return an alpha beside the image, got the image alone: return (image, alpha).")
    image = _checked(image, alpha, "an image")
    if image.numel() and float(image.amax()) > _BRIGHTEST:
        raise ValueError(
            f"an image must have colors in [0, 1], got values up to {float(image.amax()):g}: divide by 255."
        )
    features = {"empty": (1 - alpha).clamp_min(0), "contrast": contrast(image)}
    if isinstance(moments_fn, ListMoments):
        features["colors"] = moments_fn.color_variance(expected, view).sqrt()
    if moments_fn is not None:
        moments = moments_fn(opacity.detach().clone(), view, Multiplier.dropout(p or PLAIN_RATE), None)
        variance = _read_variance(moments, image, layout)
        features["deviation"] = _checked(variance, alpha, "a variance").mean(0).clamp_min(0).sqrt()
    return expected_error({**features, **known})


def _checked(colors: Tensor, alpha: Tensor, what: str) -> Tensor:
    """Return colors (3, H, W) with 0 where they are not finite because alpha is 0; raise a ValueError for others."""
    finite, broken = finite_colors(colors, alpha, alpha, 0.0)
    if broken:
        raise ValueError(f"{what} or its alpha is nan or infinite where alpha is not 0: look at the model's render.")
    return finite


def _read_variance(moments: Any, image: Tensor, layout: Layout) -> Tensor:
    """Return the variance (3, H, W) in the layout of the renderer or in that of this package's moments, CHW."""
    if layout == "HWC":
        with suppress(ValueError):
            if (read := read_moments(moments, layout="HWC").variance).shape == image.shape:
                return read
    return read_moments(moments).variance


def contrast(image: Tensor) -> Tensor:
    """Return the length of the gradient of an image's (3, H, W) mean over RGB, per pixel, (H, W)."""
    from kornia.filters import spatial_gradient

    found: Tensor = spatial_gradient(image.clamp(0, 1).mean(0)[None, None])[0, 0].square().sum(0).sqrt()
    return found


def smoothed(x: Tensor) -> Tensor:
    """Blur a map (H, W) by `SMOOTHING`."""
    from kornia.filters import gaussian_blur2d

    size = 2 * math.ceil(3 * SMOOTHING) + 1
    border = "replicate" if min(x.shape) <= size // 2 else "reflect"  # a reflection needs that many pixels
    found: Tensor = gaussian_blur2d(x[None, None], (size, size), (SMOOTHING, SMOOTHING), border_type=border)[0, 0]
    return found


def _factors(term: str) -> set[str]:
    """Return the features of a term."""
    return {*term.split("*")} - {"constant"}
