"""Dropout of Gaussians together with their neighbors, and DropAnSH-GS, which drops their harmonics as well."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ca_reg import functional
from ca_reg._check import Rate, check_count, check_rate, is_zero
from ca_reg.regularizer import Draw, Params, Regularizer
from ca_reg.regularizers.surroundings import Refreshed, neighbors_of
from ca_reg.schedules import LinearRamp, Schedule, refuse_capture

__all__ = ["AnchorDropout", "ClusteredDropout", "SHDropout"]


class ClusteredDropout(Regularizer):
    """Drop random anchors together with their k nearest neighbors, an expected share ``p`` of all Gaussians.

    Each Gaussian is an anchor with a probability ``a`` that makes the expected dropped share ``p``, to 1e-6, whatever
    the overlaps: one that is in ``c`` clusters is kept with probability ``(1 - a)^c``. The share of a single draw
    scatters about ``sqrt(k + 1)`` times as much as with independent masks. A neighbor of many is dropped more often
    than an outlier.

    ``train()``: ``opacity * keep``; ``eval()``: unchanged. The draws are not independent, so there is no multiplier.

    Args:
        p: expected share of dropped Gaussians in [0, 1), or a schedule of it.
        k: neighbors dropped with an anchor; all others if there are fewer.
        every: steps between neighbor searches.

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
    _check_rate = staticmethod(check_rate)

    def __init__(self, p: float | Schedule, k: int = 10, *, every: int = 100) -> None:
        check_count(k, "k", minimum=1)
        super().__init__(p)
        self.k = k
        self.neighbors = Refreshed(every)
        self._counted: tuple[Tensor, Tensor] | None = None  # neighbors; how many Gaussians are in 0, 1, ... clusters

    def anchor_rate(self, rate: Rate, neighbors: Tensor) -> Rate:
        """Return the rate of the anchors, given ``p`` at the step and the neighbor indices of all Gaussians, (N, k)."""
        # A Gaussian is dropped with its own cluster and with that of everyone whose neighbor it is: it stays if none of
        # its c anchors is drawn, so that the mean of stay^c over all Gaussians must be 1 - p.
        counted, counts = self._counted or (None, None)
        if counts is None or counted is not neighbors:  # once in a search: a card is waited for
            clusters = 1 + neighbors.flatten().bincount(minlength=len(neighbors))
            counts = clusters.bincount().double().cpu()
            self._counted = neighbors, counts
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
        # Those that go with nobody point behind the last: choosing the anchors' rows would wait for a card.
        dropped = neighbors.masked_fill(keep[:, None], count).flatten()
        return Draw(keep=torch.cat([keep, keep.new_zeros(1)]).index_fill(0, dropped, False)[:count])

    def replay(self, x: Params, draw: Draw) -> Params:
        """Set the opacities of dropped Gaussians to 0."""
        return x if draw.keep is None else x._replace(opacities=functional.apply_dropout(x.opacities, draw.keep))


RATE = LinearRamp(0.0, 0.02, 0, 10_000)


class AnchorDropout(ClusteredDropout):
    """Drop anchors, drawn at ``rate``, and their k nearest neighbors (Fang et al., "DropAnSH-GS", CVPR 2026).

    ``train()``: ``opacity * keep``; ``eval()``: unchanged. After arXiv 2602.20933, as no code was published.
    :class:`ClusteredDropout` is parameterized by the dropped share instead, here at most ``1 - (1 - rate)^(k + 1)``: 20
    % at a rate of 0.02.

    Args:
        rate: of the anchors, or a schedule of it. The paper's rises from 0 to 0.02 until the end of training.
        k: neighbors dropped with an anchor, as in the paper.
        every: steps between neighbor searches; the paper does not say.

    Example:
        >>> import torch
        >>> from ca_reg import Params
        >>> anchors = AnchorDropout()
        >>> anchors.draw(Params(torch.ones(500), means=torch.rand(500, 3), step=0)).keep is None
        True
        >>> keep = anchors.draw(Params(torch.ones(500), means=torch.rand(500, 3), step=10_000)).keep
        >>> bool(keep.all())
        False
    """

    rate_name = "rate"

    def __init__(self, rate: float | Schedule = RATE, k: int = 10, *, every: int = 100) -> None:
        super().__init__(rate, k, every=every)

    def anchor_rate(self, rate: Rate, neighbors: Tensor) -> Rate:
        """Return the rate as it is."""
        return rate


class SHDropout(Regularizer):
    """Drop the spherical harmonics of random Gaussians above a rising degree (Fang et al., "DropAnSH-GS", CVPR 2026).

    A share ``p`` keeps only the degrees up to ``l``, which is 0 before the first of ``until``, 1 before the second and
    so on; from the last on nothing is dropped. ``eval()``: unchanged. After arXiv 2602.20933, as no code was published;
    the whole scheme is ``drop_anchors + drop_sh``. Only colors change, so there is no multiplier.

    Args:
        p: rate in [0, 1), or a schedule of it. 0.2 in the paper.
        until: the steps at which the degree rises. 2,000, 4,000 and 6,000 in the paper. Before the last, a CUDA graph,
            which would keep the degree, is refused with a RuntimeError.

    Example:
        >>> x = Params(torch.ones(1000), sh=torch.ones(1000, 16, 3), step=2500)
        >>> colors = SHDropout().regularize(x).sh
        >>> bool((colors[:, :4] == 1).all()), 0.1 < float((colors[:, 4:] == 0).float().mean()) < 0.3
        (True, True)
    """

    needs = ("sh",)
    drops = False
    rate_name = "p"
    _check_rate = staticmethod(check_rate)

    def __init__(self, p: float | Schedule = 0.2, until: Sequence[int] = (2_000, 4_000, 6_000)) -> None:
        for step in until:
            check_count(step, "until", minimum=0)
        if list(until) != sorted(until):
            raise ValueError(f"until must be steps in rising order, got {tuple(until)}.")
        super().__init__(p)
        self.until = tuple(until)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw which Gaussians keep all degrees, (N,) bool, and note how many coefficients the others keep."""
        assert x.sh is not None
        step = self.step if x.step is None else x.step
        degree = sum(step >= start for start in self.until)
        rate = self.rate_at(x.step)
        count = (degree + 1) ** 2
        if is_zero(rate) or degree == len(self.until) or count >= x.sh.shape[1]:
            return Draw()
        refuse_capture(f"the degree {degree} of the step {step}", f"it rises at {self.until}. Draw outside the graph")
        return Draw((functional.draw_keep_mask(len(x.sh), rate, generator=generator, device=x.sh.device), count))

    def replay(self, x: Params, draw: Draw) -> Params:
        """Set the higher coefficients of the other Gaussians to 0."""
        if draw.value is None:
            return x
        assert x.sh is not None
        whole, count = draw.value
        low, high = x.sh[:, :count], x.sh[:, count:]
        return x._replace(sh=torch.cat([low, high.masked_fill(~whole[:, None, None], 0.0)], dim=1))
