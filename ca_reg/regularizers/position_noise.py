"""The paper's position noise."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.params import Draw, Params
from ca_reg.regularizers._surroundings import Refreshed, mean_distances
from ca_reg.regularizers.parameter_noise import ParameterNoise
from ca_reg.schedules import Schedule

__all__ = ["PositionNoise"]


class PositionNoise(ParameterNoise):
    """Shift every center at random, in units of the distance to its nearest neighbor (paper, appendix, position noise).

    ``train()``: ``mean + sigma d n`` with ``n`` three standard normal numbers and ``d`` the distance; ``eval()``:
    unchanged. Coinciding Gaussians do not move. The noise does not multiply alphas, so there is no multiplier.

    Args:
        sigma: standard deviation per axis in units of ``d``, at least 0, or a schedule of it. The paper tries 0.1, 0.3
            and 0.5, and finds that all of them blur the images.
        every: steps between neighbor searches; by default 3DGS's densification interval.

    Raises:
        ValueError: if ``sigma`` is negative or not finite, or ``every`` below 1.

    Example:
        >>> means = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [5.0, 0, 0]])
        >>> shifted = PositionNoise(0.1).regularize(Params(torch.ones(3), means=means)).means
        >>> torch.equal(shifted[:2], means[:2]), torch.equal(shifted[2], means[2])
        (True, False)
    """

    needs = ("means",)
    field = "means"

    def __init__(self, sigma: float | Schedule, *, every: int = 100) -> None:
        super().__init__(sigma)
        self.distances = Refreshed(every)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw the shifts in world units, (N, 3)."""
        noise = super().draw(x, generator).value
        if noise is None:
            return Draw()
        return Draw(self.distances(x, lambda means: mean_distances(means, 1))[:, None] * noise)

    def perturb(self, values: Tensor, noise: Tensor) -> Tensor:
        """Shift the centers."""
        return values + noise.to(values.dtype)
