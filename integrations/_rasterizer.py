"""The rasterizers of the INRIA family: how to find them, their calls, and their outputs."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor

from ._call import Call

__all__ = [
    "MODULES", "RASTERIZERS", "ForwardCall", "check_installed", "class_in", "forward_signature", "hide_dropped",
    "rasterizer_classes", "white_alpha",
]  # fmt: skip

MODULES = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_abs")
RASTERIZERS = tuple(f"{module}:GaussianRasterizer" for module in MODULES)


class ForwardCall(Call):
    """One call of ``GaussianRasterizer.forward``.

    Convention: its settings hold the view matrix transposed, for row vectors; ``viewmatrix.T`` is world to camera.
    """

    names: ClassVar = {"means": "means3D", "quaternions": "rotations", "sh": "shs"}
    instead = (
        "cov3D_precomp takes the place of scales and rotations (switch off compute_cov3D_python), colors_precomp that "
        "of shs (convert_SHs_python, override_color)"
    )

    @property
    def rasterizer(self) -> Any:
        """The rasterizer itself."""
        return next(iter(self.arguments.values()))

    def get(self, field: str) -> Tensor | None:
        """Return a field; "dc", where a rasterizer takes the first band separately, is prepended to ``sh``."""
        if field == "view_matrix":
            matrix = getattr(getattr(self.rasterizer, "raster_settings", None), "viewmatrix", None)
            return None if matrix is None else matrix.T
        value = super().get(field)
        first = self.arguments.get("dc") if field == "sh" else None
        return value if value is None or first is None else torch.cat([first, value], 1)

    def put(self, field: str, value: Tensor) -> None:
        """Replace a field."""
        if field == "sh" and self.arguments.get("dc") is not None:
            self.arguments["dc"], value = value[:, :1], value[:, 1:]
        super().put(field, value)


def check_installed(rasterizers: Iterable[str]) -> None:
    """Raise ImportError unless the module of one, ``module:Class``, can be found; does not import it."""
    if not _installed(rasterizers):
        raise ImportError(
            f"none of the rasterizers {', '.join(rasterizers)} is installed. Install the one in the submodules of your "
            "code base (it needs CUDA), pass your own class as rasterizer=..., in the launcher --rasterizer "
            "module:Class, or run the code base without CUDA: python -m ca_reg.integrations.run --cpu train.py ..."
        )


def _installed(rasterizers: Iterable[str]) -> list[str]:
    """Return the modules of rasterizers that can be found."""
    modules = dict.fromkeys(rasterizer.partition(":")[0] for rasterizer in rasterizers)
    return [name for name in modules if name in sys.modules or find_spec(name.partition(".")[0]) is not None]


def class_in(module: ModuleType, name: str) -> type | None:
    """Return a class of a module by name, None if there is none."""
    found = getattr(module, name, None)
    return found if isinstance(found, type) else None


def rasterizer_classes() -> list[type]:
    """Import the installed rasterizers and return their classes; raise ImportError if there are none."""
    check_installed(RASTERIZERS)
    name = RASTERIZERS[0].partition(":")[2]
    found = [class_in(import_module(module), name) for module in _installed(RASTERIZERS)]
    return list(dict.fromkeys(cls for cls in found if cls is not None))


def forward_signature(rasterizer: type) -> inspect.Signature:
    """Return the signature of a rasterizer's forward; raise TypeError if it lacks the family's arguments."""
    forward = getattr(rasterizer, "forward", None)
    signature = inspect.signature(forward) if callable(forward) else inspect.Signature()
    missing = [name for name in ("means3D", "opacities") if name not in signature.parameters]
    if missing:
        raise TypeError(
            f"{rasterizer.__qualname__}.forward{signature} has no argument {' or '.join(missing)}, so it is no "
            "GaussianRasterizer of the INRIA family; pass the class of your code base as rasterizer=..."
        )
    return signature


def hide_dropped(returned: Any, keep: Tensor) -> tuple[Any, ...]:
    """Zero the radii of dropped Gaussians, and all other integers that a rasterizer returned per Gaussian.

    Densification derives visibility from these. Besides the radii some rasterizers return flags (3dgs-mcmc) or counts
    (taming-3dgs); floating-point sums of a Gaussian of opacity 0 are 0 already. Zeroes integers and bools of shape
    (N,), (N, 1) or (N, 2) where ``keep``, (N,) bool, is False, and returns the tuple.

    Raises:
        TypeError: if ``returned`` is not a tuple.
        ValueError: if no member is such a per-Gaussian tensor.
    """
    if not isinstance(returned, tuple):
        raise TypeError(f"the rasterizer returned {type(returned).__name__}, expected a tuple with colors and radii.")
    count = len(keep)
    shapes = ((count,), (count, 1), (count, 2))
    counts = [isinstance(x, Tensor) and not x.dtype.is_floating_point and x.shape in shapes for x in returned]
    if not any(counts):
        found = ", ".join(f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else str(type(x)) for x in returned)
        raise ValueError(
            f"the rasterizer returned ({found}) for {count} Gaussians, expected an integer tensor of shape ({count},), "
            "the radii: without them dropped Gaussians cannot be hidden from densification."
        )
    members = [
        x * keep.view(-1, *[1] * (x.ndim - 1)).to(x.device) if is_count else x
        for x, is_count in zip(returned, counts, strict=True)
    ]
    # Keep named tuples.
    made: tuple[Any, ...] = returned._make(members) if hasattr(returned, "_make") else tuple(members)
    return made


def white_alpha(call: ForwardCall) -> Tensor:
    """Measure the accumulated alpha (H, W) of a call by repeating it with all colors 1 over a background of 0."""
    if not call.takes("colors_precomp"):
        raise ValueError(
            f"{type(call.rasterizer).__name__} takes no colors_precomp, by which its alpha could be measured in white: "
            "return it from render, named alpha."
        )
    settings = call.rasterizer.raster_settings
    opacities: Tensor = call.arguments["opacities"]
    before = dict(call.arguments)
    call.rasterizer.raster_settings = settings._replace(bg=torch.zeros_like(settings.bg))
    # "dc" holds the first band where a rasterizer takes it separately.
    call.arguments.update({name: None for name in ("shs", "dc") if name in before})
    call.arguments["colors_precomp"] = opacities.new_ones(opacities.shape[0], 3)
    try:
        with torch.no_grad():
            returned = call()
    finally:
        call.rasterizer.raster_settings = settings
        call.arguments.clear()
        call.arguments.update(before)
    size = (3, settings.image_height, settings.image_width)
    white = [x for x in returned if isinstance(x, Tensor) and tuple(x.shape) == size]
    if len(white) != 1:
        raise ValueError(f"the rasterizer returned {len(white)} images of shape {size} where one was expected.")
    return white[0].mean(0)
