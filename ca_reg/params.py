"""What a regularizer works on, and what it drew."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

__all__ = ["Draw", "Params"]


class Params(NamedTuple):
    """What a rasterizer receives of N Gaussians, activated; a regularizer returns it with some fields replaced.

    Only the opacities must be there. What else a regularizer looks at or changes, it names in
    :attr:`Regularizer.needs <ca_reg.Regularizer.needs>`; code that cannot supply it refuses by that name.

    Convention: world coordinates; quaternions wxyz, not necessarily of length 1; the view matrix is world to camera,
    OpenCV axes (x right, y down, z forward), applied from the left to column vectors.

    Attributes:
        opacities: in [0, 1], shape (N,).
        means: centers, world units, shape (N, 3).
        scales: standard deviations along the axes, world units, shape (N, 3).
        quaternions: orientations, shape (N, 4).
        sh: spherical-harmonic colors, the constant band first, shape (N, K, 3).
        view_matrix: of the camera that is rendered, shape (4, 4); of the first one if there are several.
        learned: what the regularizers learn per Gaussian, by name, each (N,).
        step: the training step, which schedules follow.

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
    step: int = 0


class Draw(NamedTuple):
    """One draw of a regularizer, enough to apply it again.

    Attributes:
        value: whatever its ``replay`` reads: a mask, noise, nothing.
        keep: which Gaussians were not dropped, shape (N,) bool; None if none was. Density control must not count the
            others as seen.
    """

    value: Any = None
    keep: Tensor | None = None
