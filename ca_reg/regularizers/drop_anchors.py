"""The first half of DropAnSH-GS: anchors are dropped together with their neighbors."""

from __future__ import annotations

from torch import Tensor

from ca_reg._check import Rate
from ca_reg.regularizers.clustered import ClusteredDropout
from ca_reg.schedules import LinearRamp, Schedule

__all__ = ["AnchorDropout"]

RATE = LinearRamp(0.0, 0.02, 0, 10_000)


class AnchorDropout(ClusteredDropout):
    """Drop anchors, drawn at ``rate``, and their k nearest neighbors (Fang et al., "DropAnSH-GS", CVPR 2026).

    ``train()``: ``opacity * keep``, without compensation; ``eval()``: unchanged. After arXiv 2602.20933, as no code was
    published. :class:`~ca_reg.regularizers.clustered.ClusteredDropout` is parameterized by the dropped share instead,
    which is here ``1 - (1 - rate)^(k + 1)`` at most in expectation: 20 % at a rate of 0.02.

    Args:
        rate: of the anchors, or a schedule of it. The paper's rises from 0 to 0.02 until the end of training; the
            default takes 10,000 steps for that.
        k: neighbors dropped with an anchor, as in the paper.
        every: steps between neighbor searches; the paper does not say.

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
