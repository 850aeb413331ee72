"""DropAnSH-GS, first half: anchors are dropped with their neighbors."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import Rate
from ca_reg.regularizers.clustered import ClusteredDropout
from ca_reg.schedules import LinearRamp, Schedule

__all__ = ["AnchorDropout"]

RATE = LinearRamp(0.0, 0.02, 0, 10_000)


class AnchorDropout(ClusteredDropout):
    """Drop anchors, drawn at ``rate``, and their k nearest neighbors (Fang et al., "DropAnSH-GS", CVPR 2026).

    ``train()``: ``opacity * keep``, without compensation; ``eval()``: nothing. After arXiv 2602.20933, as no code was
    published. :class:`~ca_reg.regularizers.clustered.ClusteredDropout` is the same by the share that is dropped, here
    at most ``1 - (1 - rate)^(k + 1)`` in the mean: 20 % at the rate of 0.02.

    Args:
        rate: of the anchors, or a schedule of it. Theirs rises from 0 to 0.02 until the end of the training; the
            default takes 10,000 steps for that.
        k: neighbors that go with an anchor, as theirs.
        every: steps between two looks at the neighbors; the paper does not say.

    Raises:
        ValueError: if a constant rate is outside [0, 1), or ``k`` or ``every`` below 1.

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
