"""Dropout of Gaussians together with their neighbors, at a given expected share."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg import functional
from ca_reg._check import Rate, check_count, check_rate, is_zero
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Regularizer
from ca_reg.regularizers._surroundings import Refreshed, neighbors_of
from ca_reg.schedules import Schedule

__all__ = ["ClusteredDropout"]


class ClusteredDropout(Regularizer):
    """Drop random anchors together with their k nearest neighbors, an expected share ``p`` of all Gaussians.

    Each Gaussian is an anchor with probability ``a``. One that is in ``c`` clusters (its own, and one for each Gaussian
    that has it among its neighbors) is kept with probability ``(1 - a)^c``. The mean of that over all Gaussians is
    solved for ``a``, so the expected dropped share is ``p``, to 1e-6, whatever the overlaps; the share of a single draw
    scatters about ``sqrt(k + 1)`` times as much as with independent masks. Gaussians differ: a neighbor of many is
    dropped more often than an outlier.

    ``train()``: ``opacity * keep``; ``eval()``: unchanged. The draws are not independent, so there is no multiplier.

    Args:
        p: expected share of dropped Gaussians in [0, 1), or a schedule of it.
        k: neighbors dropped with an anchor; all others if there are fewer.
        every: steps between neighbor searches.

    Raises:
        ValueError: if ``p`` is outside [0, 1), or ``k`` or ``every`` below 1.

    Example:
        Each pair is dropped together:

        >>> means = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0], [5.1, 0, 0]])
        >>> x = Params(torch.ones(4), means=means)
        >>> keep = ClusteredDropout(0.5, k=1).draw(x).keep
        >>> bool(keep[0] == keep[1]), bool(keep[2] == keep[3])
        (True, True)
    """

    needs = ("means",)
    rate_name = "p"

    def __init__(self, p: float | Schedule, k: int = 10, *, every: int = 100) -> None:
        check_count(k, "k", minimum=1)
        super().__init__(p)
        self.k = k
        self.neighbors = Refreshed(every)

    def _check_rate(self, rate: float, name: str) -> None:
        check_rate(rate, name)

    def anchor_rate(self, rate: Rate, neighbors: Tensor) -> Rate:
        """Return the rate of the anchors, given ``p`` at the step and the neighbor indices of all Gaussians, (N, k)."""
        clusters = 1 + neighbors.flatten().bincount(minlength=len(neighbors))
        counts = clusters.bincount().double().cpu()
        sizes = torch.arange(len(counts)).to(counts)
        stay = 1.0
        for _ in range(30):  # Newton's method from above, monotone because the mean is convex in `stay`
            excess = float(counts @ stay**sizes / counts.sum()) - (1 - float(rate))
            slope = float(counts @ (sizes * stay ** (sizes - 1)) / counts.sum())
            stay -= excess / slope
            if excess < 1e-14:
                break
        return 1 - stay

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw anchors, to be dropped with their neighbors."""
        rate, count = self.rate_at(x.step), len(x.opacities)
        if is_zero(rate) or not count:
            return Draw()
        neighbors = self.neighbors(x, lambda means: neighbors_of(means, self.k)[1])
        rate = self.anchor_rate(rate, neighbors)
        keep = functional.draw_keep_mask(count, rate, generator=generator, device=x.opacities.device)
        keep = keep.index_fill(0, neighbors[~keep].flatten(), False)
        return Draw(keep=keep)

    def replay(self, x: Params, draw: Draw) -> Params:
        """Set the opacities of dropped Gaussians to 0."""
        return x if draw.keep is None else x._replace(opacities=functional.apply_dropout(x.opacities, draw.keep))
