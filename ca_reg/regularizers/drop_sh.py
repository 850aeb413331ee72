"""The second half of DropAnSH-GS: random Gaussians lose their high-degree spherical harmonics."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ca_reg import functional
from ca_reg._check import check_count, check_rate, is_zero
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Regularizer
from ca_reg.schedules import Schedule

__all__ = ["SHDropout"]


class SHDropout(Regularizer):
    """Drop the spherical harmonics of random Gaussians above a rising degree (Fang et al., "DropAnSH-GS", CVPR 2026).

    A share ``p`` keeps only the degrees up to ``l``, where ``l`` is 0 before the first of ``until``, 1 before the
    second and so on; from the last on nothing is dropped. ``eval()``: unchanged. After arXiv 2602.20933, as no code was
    published; with :class:`~ca_reg.regularizers.drop_anchors.AnchorDropout` it is the whole scheme:
    ``drop_anchors + drop_sh``. Only colors change, so there is no multiplier, and density control counts all Gaussians.

    Args:
        p: rate in [0, 1), or a schedule of it. 0.2 in the paper.
        until: the steps at which the degree rises. 2,000, 4,000 and 6,000 in the paper.

    Raises:
        ValueError: if ``p`` is outside [0, 1), or ``until`` is not sorted.

    Example:
        >>> x = Params(torch.ones(1000), sh=torch.ones(1000, 16, 3), step=2500)
        >>> colors = SHDropout().regularize(x).sh
        >>> bool((colors[:, :4] == 1).all()), 0.1 < float((colors[:, 4:] == 0).float().mean()) < 0.3
        (True, True)
    """

    needs = ("sh",)
    drops = False
    rate_name = "p"

    def __init__(self, p: float | Schedule = 0.2, until: Sequence[int] = (2_000, 4_000, 6_000)) -> None:
        for step in until:
            check_count(step, "until", minimum=0)
        if list(until) != sorted(until):
            raise ValueError(f"until must be steps in rising order, got {tuple(until)}.")
        super().__init__(p)
        self.until = tuple(until)

    def _check_rate(self, rate: float, name: str) -> None:
        check_rate(rate, name)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw which Gaussians keep all degrees, (N,) bool, and note how many coefficients the others keep."""
        assert x.sh is not None
        step = self.step if x.step is None else x.step
        degree = sum(step >= start for start in self.until)
        rate = self.rate_at(x.step)
        count = (degree + 1) ** 2
        if is_zero(rate) or degree == len(self.until) or count >= x.sh.shape[1]:
            return Draw()
        return Draw((functional.draw_keep_mask(len(x.sh), rate, generator=generator, device=x.sh.device), count))

    def replay(self, x: Params, draw: Draw) -> Params:
        """Set the higher coefficients of the other Gaussians to 0."""
        if draw.value is None:
            return x
        assert x.sh is not None
        whole, count = draw.value
        low, high = x.sh[:, :count], x.sh[:, count:]
        return x._replace(sh=torch.cat([low, high.masked_fill(~whole[:, None, None], 0.0)], dim=1))
