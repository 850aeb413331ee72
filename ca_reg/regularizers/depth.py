"""Dropout by the depth of a Gaussian: D2GS, which counts density as well, and DOC-GS."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ca_reg._check import Rate, check_count, check_finite, is_zero
from ca_reg.regularizer import Params
from ca_reg.regularizers.dropout import IndependentDropout
from ca_reg.regularizers.surroundings import Refreshed, SurroundingsDropout, mean_distances, relative_ranks
from ca_reg.schedules import LinearRamp, Schedule

__all__ = ["D2GSDropout", "DepthDropout"]

RATE = LinearRamp(0.05, 0.3, 0, 10_000)
TIERS = (1.0, 0.7, 0.3)  # factors of the rate: near, middle, far
QUANTILES = (0.33, 0.67)  # of the depths, between the tiers


class D2GSDropout(SurroundingsDropout):
    """Drop by depth and density (Song et al., "D2GS", ICLR 2026; code Insta360-Research-Team/DDGS).

    ``p = rate(step) tier (depth_weight nearness + density_weight density)``. Nearness is 1 minus the rank of the depth,
    density the rank of the negated mean distance to the k nearest neighbors, both in [0, 1]. The tier is 1 up to the
    33rd percentile of the depths, 0.7 up to the 67th, then 0.3. ``train()``: ``opacity * keep``; ``eval()``: unchanged,
    as in the source. With the default weights the mean of ``p`` is 0.36 of ``rate`` if depth and density are unrelated.

    With ``literal`` it does what the published code does (read at commit d665f22 of a fork that has its history):

    - the depth is the *column* of the view matrix times the center, which is right only for cameras without rotation;
    - both scores are ``(value - min) / (max - min)``, so that one outlier squeezes all others together;
    - densities are computed only at step 1 and every ``every`` steps: if Gaussians have been added since, all count as
      0.5; if some were removed, the first N values are taken, whichever Gaussians they belonged to.

    Convention: the view matrix is world to camera; depth is along its third axis.

    Args:
        rate: the largest rate, or a schedule of it. The source's rises from 0.05 to 0.3 over 10,000 steps.
        depth_weight: of nearness, at least 0. In the source 0.3, and 0.15 to 0.7 in its script for single scenes.
        density_weight: of density, at least 0. In the source 0.7, and 0.3 to 0.85 for single scenes.
        k: number of neighbors. In the source 6, including the point itself, a factor that cancels.
        every: steps between neighbor searches, as in the source.
        literal: do what the published code does.
        scale: scale the opacities in evaluation, which the source does not.

    Example:
        >>> from ca_reg import Params
        >>> means = torch.tensor([[0.0, 0, 1], [0.0, 0, 2], [0.0, 0, 4]])
        >>> x = Params(torch.ones(3), means=means, view_matrix=torch.eye(4), step=10_000)
        >>> D2GSDropout(k=1).rates(x)
        tensor([0.2475, 0.1417, 0.0000])
    """

    needs = ("means", "view_matrix")
    rate_name = "rate"

    def __init__(
        self,
        rate: float | Schedule = RATE,
        depth_weight: float = 0.3,
        density_weight: float = 0.7,
        k: int = 5,
        *,
        every: int = 500,
        literal: bool = False,
        scale: bool = False,
    ) -> None:
        check_finite(depth_weight, "depth_weight", minimum=0.0)
        check_finite(density_weight, "density_weight", minimum=0.0)
        check_count(k, "k", minimum=1)
        super().__init__(rate, every=every, scale=scale)
        self.depth_weight, self.density_weight = depth_weight, density_weight
        self.k, self.literal = k, literal
        self.bounded = depth_weight + density_weight <= 1
        if literal:
            self.trained = _ByStepsAlone(every)

    def measure(self, means: Tensor) -> Tensor:
        """Return the density, (N,): a rank, or minus the mean distance to the neighbors."""
        density = -mean_distances(means, self.k)
        return density if self.literal else relative_ranks(density)

    def rates_from(self, x: Params, look: Callable[[], Tensor]) -> Rate:
        """Return the rates; 0 while the schedule is 0."""
        rate = self.rate_at(x.step)
        if is_zero(rate) or not len(x.opacities):
            return 0.0
        if self.literal:
            assert x.view_matrix is not None
            # The transposed matrix: the source takes the column for the row.
            depths = x._replace(view_matrix=x.view_matrix.mT).depths
            nearness, density = 1 - _min_max(depths), _first(look(), len(depths))
        else:
            depths = x.depths
            nearness, density = 1 - relative_ranks(depths), look()
        ordered = depths.sort().values
        near, far = (ordered[int(len(depths) * quantile)] for quantile in QUANTILES)
        # From far to near, each overwriting the one before where it reaches.
        tier = torch.full_like(depths, TIERS[2]).masked_fill_(depths <= far, TIERS[1])
        tier.masked_fill_(depths <= near, TIERS[0])
        return rate * tier * (self.depth_weight * nearness + self.density_weight * density)


class _ByStepsAlone(Refreshed):
    """Measures when the published code does: at step 1 and at multiples of ``every``, whatever was densified since."""

    def holds(self, x: Params) -> bool:
        return x.step != 1 and (x.step or 0) % self.every != 0


def _min_max(values: Tensor) -> Tensor:
    low, high = values.aminmax()
    return (values - low) / (high - low + 1e-6)


def _first(density: Tensor, count: int) -> Tensor:
    """Return the first ``count`` stored densities, normalized, or 1/2 for all if there are too few."""
    return density.new_full((count,), 0.5) if len(density) < count else _min_max(density[:count])


class DepthDropout(IndependentDropout):
    """Drop by depth, continuously (after Li et al., "DOC-GS", arXiv 2604.06739; no code was published).

    ``p = rate(step) (near + (far - near) rank)``, with the rank in [0, 1] of the depth. ``train()``: ``opacity *
    keep``; ``eval()``: unchanged.

    Known from the source: the rate is a continuous function of the depth and rises during training; in place of D2GS's
    three tiers it raised the PSNR from 20.74 to 21.12 dB (LLFF, 3 views). Not known: the function, its direction and
    constants. Here it is linear in the rank between D2GS's outer tiers; the opposite direction is ``depth(near=0.3,
    far=1.0)``.

    Convention: the view matrix is world to camera; depth is along its third axis.

    Args:
        rate: the largest rate, or a schedule of it.
        near: factor of the rate for the nearest Gaussian, at least 0.
        far: factor of the rate for the farthest, at least 0.
        scale: scale the opacities in evaluation.

    Example:
        >>> import torch
        >>> means = torch.tensor([[0.0, 0, 1], [0.0, 0, 2], [0.0, 0, 40]])
        >>> x = Params(torch.ones(3), means=means, view_matrix=torch.eye(4), step=10_000)
        >>> DepthDropout().rates(x)
        tensor([0.3000, 0.1950, 0.0900])
    """

    needs = ("means", "view_matrix")
    rate_name = "rate"

    def __init__(
        self, rate: float | Schedule = RATE, near: float = 1.0, far: float = 0.3, *, scale: bool = False
    ) -> None:
        check_finite(near, "near", minimum=0.0)
        check_finite(far, "far", minimum=0.0)
        super().__init__(rate, scale=scale)
        self.near, self.far = near, far
        self.bounded = max(near, far) <= 1

    def rates(self, x: Params) -> Rate:
        """Return the rates; 0 while the schedule is 0."""
        rate = self.rate_at(x.step)
        if is_zero(rate):
            return 0.0
        return rate * (self.near + (self.far - self.near) * relative_ranks(x.depths))
