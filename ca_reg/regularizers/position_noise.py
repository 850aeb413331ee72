"""The paper's position noise."""

from __future__ import annotations

import torch

from ca_reg import functional
from ca_reg._check import check_finite, is_zero
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Regularizer
from ca_reg.regularizers._surroundings import Refreshed, mean_distances
from ca_reg.schedules import Schedule, as_schedule

__all__ = ["PositionNoise"]


class PositionNoise(Regularizer):
    """Shift every center at random, in units of the distance to its nearest neighbor (paper, appendix, position noise).

    ``train()``: ``mean + sigma d n`` with ``n`` of three standard normal numbers and ``d`` the distance; ``eval()``:
    nothing. Gaussians at one place do not move. The draws do not multiply an alpha, so there is no multiplier.

    Args:
        sigma: standard deviation per axis in units of ``d``, at least 0, or a schedule of it. The paper tries 0.1, 0.3
            and 0.5, and finds that all of them blur.
        every: steps between two looks at the neighbors; those between 3DGS's own density controls.

    Raises:
        ValueError: if ``sigma`` is negative or not finite, or ``every`` below 1.

    Example:
        >>> means = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [5.0, 0, 0]])
        >>> shifted = PositionNoise(0.1).regularize(Params(torch.ones(3), means=means)).means
        >>> torch.equal(shifted[:2], means[:2]), torch.equal(shifted[2], means[2])
        (True, False)
    """

    needs = ("means",)
    drops = False

    def __init__(self, sigma: float | Schedule, *, every: int = 100) -> None:
        if not callable(sigma):
            check_finite(sigma, "sigma", minimum=0.0)
        super().__init__(as_schedule(sigma))
        self.distances = Refreshed(every)

    def _check_rate(self, rate: float, step: int) -> None:
        check_finite(rate, f"sigma at step {step}", minimum=0.0)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw the shifts, world units, (N, 3)."""
        assert x.means is not None
        sigma = self._rate_at(x.step)
        if is_zero(sigma):
            return Draw()
        noise = functional.draw_opacity_noise(x.means.numel(), sigma, generator=generator, device=x.means.device)
        distances = self.distances(x, lambda means: mean_distances(means, 1))
        return Draw(distances[:, None] * noise.view(-1, 3).to(x.means.dtype))

    def replay(self, x: Params, draw: Draw) -> Params:
        """Shift the centers."""
        assert x.means is not None
        return x if draw.value is None else x._replace(means=x.means + draw.value)

    def extra_repr(self) -> str:
        """Return the arguments, for ``print``."""
        return f"sigma={self._rate_repr()}"
