"""The input of a regularizer, and the record of one of its draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

__all__ = ["Draw", "Params"]


class Params(NamedTuple):
    """The activated parameters of N Gaussians as a rasterizer receives them; a regularizer returns a modified copy.

    Only the opacities are required. A regularizer lists the other fields that it reads or changes in
    :attr:`Regularizer.needs <ca_reg.Regularizer.needs>`; callers that cannot supply one raise an error naming it.

    Convention: world coordinates; quaternions wxyz, not necessarily normalized; the view matrix is world to camera,
    OpenCV axes (x right, y down, z forward), applied from the left to column vectors.

    Attributes:
        opacities: in [0, 1], shape (N,).
        means: centers, world units, shape (N, 3).
        scales: standard deviations along the axes, world units, shape (N, 3).
        quaternions: orientations, shape (N, 4).
        sh: spherical-harmonic coefficients, constant band first, shape (N, K, 3).
        view_matrix: of the rendered camera, the first if there are several, shape (4, 4).
        learned: per-Gaussian values that regularizers learn, by name, each (N,).
        step: the training step, from 0 on, which schedules follow; None for that of the module or score that is called.

    Example:
        >>> import torch
        >>> x = Params(torch.full((4,), 0.5), means=torch.zeros(4, 3))
        >>> x._replace(opacities=x.opacities * 0.8).opacities
        tensor([0.4000, 0.4000, 0.4000, 0.4000])
    """

    opacities: Tensor
    means: Tensor | None = None
    scales: Tensor | None = None
    quaternions: Tensor | None = None
    sh: Tensor | None = None
    view_matrix: Tensor | None = None
    learned: Mapping[str, Tensor] | None = None
    step: int | None = None


class Draw(NamedTuple):
    """One draw of a regularizer, with all it takes to replay it.

    Attributes:
        value: whatever the regularizer's ``replay`` reads, such as a mask or noise; None for nothing.
        keep: True where a Gaussian was kept, shape (N,) bool; None if none was dropped. Density control must not count
            dropped Gaussians as seen.
    """

    value: Any = None
    keep: Tensor | None = None
