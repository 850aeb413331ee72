"""Argument checks shared by the package: a TypeError for a wrong type, a ValueError for a wrong shape or value.

They are plain code, so that ``python -O``, which removes assertions, and ``KORNIA_CHECKS=0``, which turns kornia's
checks off, leave every documented error in place.
"""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

MAX_SIGMA = 1e30

Rate = float | Tensor
"""A number, or one per Gaussian, shape (N,); inside ``torch.compile`` also a scalar tensor, so that a changing rate
does not trigger a recompilation."""


def check_tensor(x: Any, name: str, remedy: str = "") -> None:
    """Raise a TypeError unless ``x`` is a tensor; the ``remedy`` ends the message."""
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} must be a torch tensor, got {type(x).__name__}{remedy and '; '}{remedy}.")


def check_floating(x: Any, name: str, remedy: str = "", *, cast: str = "convert it with .float()") -> None:
    """Raise a TypeError unless ``x`` is a floating-point tensor; ``cast`` is the remedy where it is another tensor."""
    check_tensor(x, name, remedy)
    if not x.is_floating_point():
        raise TypeError(f"{name} must be a floating-point tensor, got {x.dtype}; {cast}.")


def check_opacity(opacity: Any) -> None:
    """Raise unless ``opacity`` is a floating-point tensor of shape (N,) or (N, 1)."""
    check_floating(opacity, "opacity", "convert it with torch.as_tensor")
    if opacity.ndim not in (1, 2) or opacity.shape[1:] not in ((), (1,)):
        raise ValueError(f"opacity must have shape (N,) or (N, 1), one per Gaussian, got {tuple(opacity.shape)}.")


def check_opacity_range(opacity: Tensor, upper: float = 1.0) -> None:
    """Raise unless all opacities are finite and in [0, upper]. Reads the values, which synchronizes a GPU."""
    if opacity.numel() == 0:
        return
    low, high = torch.stack(torch.aminmax(opacity.detach())).tolist()  # together: one wait for a GPU
    if not (low >= 0.0 and high <= upper and math.isfinite(high)):
        allowed = "at least 0" if math.isinf(upper) else f"in [0, {upper:g}]"
        remedy = "pass torch.sigmoid(logits), what the rasterizer receives, not the raw parameter."
        raise ValueError(
            f"opacity must be activated, {allowed}, got values from {low:g} to {high:g}; "
            + ("the training has diverged." if math.isnan(low) else remedy)
        )


def check_per_gaussian(x: Any, opacity: Tensor, name: str) -> None:
    """Raise unless ``x`` is a tensor of shape (N,) for the N opacities."""
    check_tensor(x, name, "give it as the draw function returned it")
    if x.shape != opacity.shape[:1]:
        raise ValueError(
            f"{name} must have shape ({opacity.shape[0]},), one value per opacity, got {tuple(x.shape)}; "
            "after Gaussians were added or removed a former draw no longer fits: draw again."
        )


def check_rate(p: Any, name: str = "p") -> None:
    """Raise unless ``p`` is a real number in [0, 1)."""
    check_finite(p, name)
    if not 0.0 <= p < 1.0:
        raise ValueError(f"{name} must be in [0, 1), got {p}; it is the fraction of Gaussians that is dropped.")


def check_rates(p: Any) -> None:
    """Raise unless ``p`` is a real number in [0, 1), or a tensor (N,) of such; the tensor's values are read."""
    if not isinstance(p, Tensor):
        check_rate(p)
    elif not _is_in_a_graph(p) and not (p.ndim == 1 and p.is_floating_point() and bool(((p >= 0) & (p < 1)).all())):
        raise ValueError(
            f"p must be a number in [0, 1) or a floating-point tensor (N,) of such, got a {p.dtype} tensor of shape "
            f"{tuple(p.shape)}" + (f" from {p.min():g} to {p.max():g}." if p.numel() else ".")
        )


def check_factor(factor: Any) -> None:
    """Raise unless ``factor``, by which opacities decay, is a real number in (0, 1]."""
    check_finite(factor, "factor")
    if not 0.0 < factor <= 1.0:
        raise ValueError(f"factor must be in (0, 1], got {factor}; opacities are multiplied by it after every step.")


def check_sigma(sigma: Any, name: str = "sigma") -> None:
    """Raise unless ``sigma`` is a real number in [0, 1e30]."""
    check_finite(sigma, name, minimum=0.0)
    # The draws are float32: a larger product would be infinite, and nan times an opacity of 0.
    if not _is_in_a_graph(sigma) and sigma > MAX_SIGMA:
        raise ValueError(f"{name} must be at most {MAX_SIGMA:g}, got {sigma}; the paper uses 0.8.")


def check_finite(x: Any, name: str, *, minimum: float = -math.inf, hint: str = "") -> None:
    """Raise unless ``x`` is a finite real number of at least ``minimum``; the ``hint`` ends the message."""
    if _is_in_a_graph(x):
        return
    if type(x) is not float and not isinstance(x, Real):
        raise TypeError(f"{name} must be a real number, got {type(x).__name__}.")
    try:
        finite = -math.inf < float(x) < math.inf  # not math.isfinite, which has no place in a compiled graph
    except OverflowError:  # an integer above all floats
        finite = False
    if not finite or x < minimum:
        at_least = "" if minimum == -math.inf else f" and at least {minimum:g}"
        raise ValueError(f"{name} must be finite{at_least}, got {x}{hint}.")


def check_callable(x: Any, name: str, arguments: str = "opacity, view") -> None:
    """Raise unless ``x`` can be called; ``arguments`` are those that it takes, for the message."""
    if not callable(x):
        raise TypeError(f"{name} must be callable as {name}({arguments}), got {type(x).__name__}.")


def check_count(x: Any, name: str, *, minimum: int, hint: str = "") -> None:
    """Raise unless ``x`` is an integer of at least ``minimum``; the ``hint`` ends the message."""
    # The exact type first: asking an abstract class takes ten times as long, and every step does it several times.
    if type(x) is not int and (not isinstance(x, Integral) or isinstance(x, bool)):
        raise TypeError(f"{name} must be an integer, got {type(x).__name__}.")
    if x < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {x}{hint}.")


def kept_share(p: Rate, opacity: Tensor) -> Rate:
    """Return ``1 - p``; for a tensor (N,) of rates in the shape of the opacities, (N,) or (N, 1), but its own dtype."""
    if not (isinstance(p, Tensor) and p.ndim):
        return 1.0 - p
    check_per_gaussian(p, opacity, "p")
    return 1.0 - p.view_as(opacity)


def is_zero(rate: Rate) -> bool:
    """Whether the rate is the number 0; False for a tensor, whose values are not read."""
    return not isinstance(rate, Tensor) and rate == 0


def _is_in_a_graph(x: Any) -> bool:
    """Whether ``x`` is a tensor in a compiled graph, whose value was checked when the step was set."""
    return isinstance(x, Tensor) and torch.compiler.is_compiling()
