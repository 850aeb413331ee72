"""Procedural solid textures: a color for every point in space."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

__all__ = ["Noise", "Texture", "checker", "color_ramp"]

Texture = Callable[[Tensor], Tensor]
"""Maps points (R, 3) to linear RGB reflectances (R, 3), nominally in [0, 1]."""


class Noise:
    """Smooth noise in space: random values on a periodic integer lattice, interpolated, summed over octaves.

    Example:
        >>> noise = Noise(torch.Generator().manual_seed(0))
        >>> noise(torch.rand(10, 3), octaves=4).shape
        torch.Size([10])
    """

    PERIOD = 32

    def __init__(self, generator: torch.Generator) -> None:
        self.lattice = torch.rand((self.PERIOD,) * 3, generator=generator)
        self._wrapped = pad(self.lattice[None, None], (0, 1) * 3, mode="circular")

    def __call__(self, points: Tensor, octaves: int = 1) -> Tensor:
        """Return the noise at points (R, 3): values in [0, 1], shape (R,), with features of size 1 and smaller."""
        total, weight = points.new_zeros(points.shape[0]), 0.0
        for octave in range(octaves):
            # The shift keeps the lattice planes of the octaves apart.
            total += self._single(points * 2**octave + 7.3 * octave) * 0.5**octave
            weight += 0.5**octave
        return total / weight

    def _single(self, points: Tensor) -> Tensor:
        """One octave: trilinear interpolation with the smoothstep fade."""
        base = points.floor()
        fade = points - base
        at = (base % self.PERIOD + fade * fade * (3 - 2 * fade)) * (2 / self.PERIOD) - 1
        grid = at.flip(1)[None, None, None]  # the last axis of the lattice comes first
        return grid_sample(self._wrapped, grid, align_corners=True).flatten()


def color_ramp(values: Tensor, colors: Sequence[tuple[float, float, float]]) -> Tensor:
    """Map values in [0, 1], shape (R,), to colors (R, 3) on a piecewise linear path through ``colors``.

    Example:
        >>> color_ramp(torch.tensor([0.0, 0.5]), [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]).tolist()
        [[0.0, 0.0, 0.0], [0.5, 0.5, 0.5]]
    """
    table = torch.tensor(colors)
    at = values.clamp(0, 1) * (len(colors) - 1)
    index = at.floor().long().clamp(max=len(colors) - 2)
    return torch.lerp(table[index], table[index + 1], (at - index)[:, None])


def checker(u: Tensor, v: Tensor, joint: float) -> tuple[Tensor, Tensor]:
    """Return the color of a unit checkerboard at (u, v), 0 or 1, and whether the point is on a joint between tiles."""
    edge = torch.minimum((u - u.round()).abs(), (v - v.round()).abs())
    return (u.floor() + v.floor()).long() % 2, edge < joint / 2
