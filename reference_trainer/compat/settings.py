"""The settings of a rasterizer call, and the camera that they describe."""

from __future__ import annotations

import functools
import warnings
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from reference_trainer.camera import Camera

__all__ = ["GaussianRasterizationSettings", "camera_of", "warn_of_ignored"]

TOLERANCE = 1e-3  # of the entries of a projection matrix that went through single precision twice


class _Fields(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    confidence: Tensor | None = None
    antialiasing: bool | None = None
    pixel_weights: Tensor | None = None
    kernel_size: float | None = None


class GaussianRasterizationSettings(_Fields):
    """What the rasterizers of the INRIA family are told about a view: the fields of several variants.

    Convention: matrices act on row vectors (``x_world @ viewmatrix``), so they are the transposes of the textbook's.
    ``viewmatrix`` is world to camera, ``projmatrix`` world to clip space, both (4, 4); sizes are in pixels, ``tanfovx``
    and ``tanfovy`` tangents of half the fields of view. ``confidence`` (N, 1) is a factor on the gradients of every
    Gaussian (FSGS, CoR-GS), ``antialiasing`` that of INRIA since October 2024, ``pixel_weights`` (H, W) asks for the
    scores of Taming 3DGS, and ``kernel_size`` is the blur of Mip-Splatting, square pixels. ``campos``, which the view
    matrix tells as well, ``prefiltered`` and ``debug`` are ignored; so are further fields, with a warning unless they
    are None, False or zeros.
    """

    __slots__ = ()

    def __new__(cls, *values: Any, **fields: Any) -> Self:
        """Take the fields that the stand-in knows."""
        further = {name: fields.pop(name) for name in fields.keys() - set(cls._fields)}
        warn_of_ignored("setting", further)
        return super().__new__(cls, *values, **fields)


def warn_of_ignored(kind: str, values: dict[str, Any]) -> None:
    """Warn, once per name, of values that the stand-in ignores; not of None, False or zeros without a gradient."""
    for name, value in sorted(values.items()):
        if (value.requires_grad or value.any()) if isinstance(value, Tensor) else value not in (None, False):
            _warn(kind, name)


@functools.cache
def _warn(kind: str, name: str) -> None:
    warnings.warn(
        f"the stand-in rasterizer does not know the {kind} {name}, and ignores it: what it does on a GPU is missing.",
        stacklevel=3,
    )


def camera_of(settings: GaussianRasterizationSettings) -> Camera:
    """Return the camera of a rasterizer call.

    The principal point is the projection matrix's: the picture's center in the INRIA code, elsewhere in some forks.

    Raises:
        ValueError: if the projection matrix is not that of a pinhole camera with the settings' fields of view.

    Example:
        >>> projection = torch.tensor([[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 1, 1], [0, 0, -0.01, 0]])
        >>> camera = camera_of(GaussianRasterizationSettings(
        ...     24, 32, 0.5, 0.5, torch.zeros(3), 1.0, torch.eye(4), projection, 0, torch.zeros(3)))
        >>> camera.fx, camera.fy, camera.cx, camera.cy
        (32.0, 24.0, 16.0, 12.0)
    """
    width, height = int(settings.image_width), int(settings.image_height)
    view = settings.viewmatrix.detach().double()
    projection = torch.linalg.solve(view, settings.projmatrix.detach().double())[:, [0, 1, 3]]
    shift_x, shift_y = projection[2, :2].tolist()
    expected = view.new_tensor([[1 / settings.tanfovx, 0, 0], [0, 1 / settings.tanfovy, 0], [shift_x, shift_y, 1]])
    if not torch.allclose(projection, torch.nn.functional.pad(expected, (0, 0, 0, 1)), rtol=TOLERANCE, atol=TOLERANCE):
        raise ValueError(
            "viewmatrix^-1 projmatrix must be a pinhole camera with the fields of view tanfovx="
            f"{settings.tanfovx} and tanfovy={settings.tanfovy}; its columns x, y and w are {projection.tolist()}. "
            "Both matrices must be transposed (for row vectors), as the INRIA code passes them."
        )
    return Camera(
        world_to_camera=settings.viewmatrix.detach().T,
        fx=width / (2 * settings.tanfovx),
        fy=height / (2 * settings.tanfovy),
        cx=0.5 * width * (1 + shift_x),
        cy=0.5 * height * (1 + shift_y),
        width=width,
        height=height,
    )
