"""Streaming moments of renders: the variance map, and what its sampling error is computed from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["MeanAlpha", "RenderMoments", "VarianceMap", "jackknife_error", "merge"]


class RenderMoments:
    """Mean and scatter of the renders seen so far, by Welford's recursion in float64.

    The memory is one image and two maps, however many renders are added. float64 and this recursion are both needed:
    the variance of renders that hardly differ is lost in E[x^2] - E[x]^2.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = torch.empty(0)  # (3, H, W)
        self.scatter = torch.empty(0)  # (H, W): sum of squared deviations, mean over RGB
        self.visible = torch.empty(0)  # (H, W): visible in all renders

    def add(self, image: Tensor, visible: Tensor) -> None:
        """Take in one render: colours (3, H, W) and visible pixels (H, W)."""
        x = image.to(torch.float64)
        if self.count == 0:
            self.mean = torch.zeros_like(x)
            self.scatter = torch.zeros_like(x[0])
            self.visible = torch.ones_like(visible)
        elif x.shape != self.mean.shape:
            raise ValueError(
                f"the renders of one view must have one size, got {tuple(self.mean.shape)} and then {tuple(x.shape)}."
            )
        self.count += 1
        deviation = x - self.mean
        self.mean += deviation / self.count
        self.scatter += (deviation * (x - self.mean)).mean(0)
        self.visible &= visible


class MeanAlpha:
    """Mean of the accumulated alpha over the renders seen so far, in float64."""

    def __init__(self) -> None:
        self.count = 0
        self.total = torch.empty(0)  # (H, W)

    def add(self, alpha: Tensor) -> None:
        """Take in the alpha (H, W) of one render."""
        if self.count > 0 and alpha.shape != self.total.shape:
            raise ValueError(
                f"the renders of one view must have one size, got {tuple(self.total.shape)} and {tuple(alpha.shape)}."
            )
        self.total = alpha.to(torch.float64) if self.count == 0 else self.total + alpha
        self.count += 1

    def above(self, threshold: float) -> Tensor:
        """Return the pixels (H, W) at which the mean exceeds the threshold."""
        return self.total / self.count > threshold


@dataclass(frozen=True, eq=False)
class VarianceMap:
    """The moments of all groups together: count, mean (3, H, W), scatter (H, W) and visible pixels (H, W)."""

    count: int
    mean: Tensor
    scatter: Tensor
    visible: Tensor


def merge(groups: list[RenderMoments]) -> VarianceMap:
    """Pool disjoint groups of renders: scatter within the groups plus scatter of the group means."""
    sizes = {tuple(group.mean.shape) for group in groups}
    if len(sizes) > 1:
        raise ValueError(f"the renders of one view must have one size, got {' and '.join(map(str, sorted(sizes)))}.")
    count = 0
    mean = torch.zeros_like(groups[0].mean)
    for group in groups:
        count += group.count
        mean += (group.mean - mean) * (group.count / count)  # exact when the groups are equal, unlike a weighted sum
    scatter = torch.zeros_like(groups[0].scatter)
    visible = torch.ones_like(groups[0].visible)
    for group in groups:
        scatter += group.scatter + group.count * (group.mean - mean).square().mean(0)
        visible &= group.visible
    return VarianceMap(count, mean, scatter, visible)


def jackknife_error(groups: list[RenderMoments], total: VarianceMap) -> float:
    """Return the standard error over masks of the unbiased variance, averaged over the visible pixels.

    The delete-a-group jackknife: leave out one group after the other and see how the value moves. With groups of one
    render it is the ordinary jackknife. Groups may differ in size (pseudo-values of Busing, Meijer and van der Leeden
    1999). The visible region is held fixed. nan below three renders, where nothing can be left out.
    """
    if total.count < 3:
        return math.nan
    scatter = float(total.scatter[total.visible].mean())
    value = scatter / (total.count - 1)
    ratios, left_out = [], []
    for group in groups:
        rest = total.count - group.count
        own = group.scatter + group.count * total.count / rest * (group.mean - total.mean).square().mean(0)
        left_out.append((scatter - float(own[total.visible].mean())) / (rest - 1))
        ratios.append(total.count / group.count)
    pseudo = [r * value - (r - 1) * v for r, v in zip(ratios, left_out, strict=True)]
    # The jackknife value, sum over groups of pseudo-values weighted by the share of their renders.
    center = sum(x / r for x, r in zip(pseudo, ratios, strict=True))
    spread = sum((x - center) ** 2 / (r - 1) for x, r in zip(pseudo, ratios, strict=True))
    return math.sqrt(spread / len(groups))
