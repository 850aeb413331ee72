"""Streaming moments of renders: the variance map, and what its sampling error is computed from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Deviations", "RenderMoments", "VarianceMap", "jackknife_error", "merge"]


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


class Deviations:
    """Deviations of renders from the expected image over a fixed region: the error of their variance, in float64."""

    def __init__(self, expected: Tensor, visible: Tensor) -> None:
        """Take the expected image (3, H, W) and the visible pixels (H, W); nothing of the former is kept."""
        self._expected = expected[:, visible].to(torch.float64)
        self._visible = visible
        self._last: Tensor | None = None
        self._squares: list[Tensor] = []
        self._products: list[Tensor] = []

    def add(self, image: Tensor) -> None:
        """Take in one render (3, H, W)."""
        if image.shape[1:] != self._visible.shape:
            raise ValueError(
                f"the renders of one view must have one size, got {tuple(self._visible.shape)} and then "
                f"{tuple(image.shape[1:])}."
            )
        deviation = image[:, self._visible] - self._expected
        self._squares.append(deviation.square().mean())
        if self._last is not None:
            self._products.append((deviation * self._last).mean())
        self._last = deviation

    def std_error(self) -> float:
        """Return the standard error over masks of the unbiased variance, averaged over the visible pixels.

        With e_1 .. e_K the deviations as vectors over pixels and channels, and means taken over these, the variance of
        that estimate is ``Var(mean(e e)) / K + 2 E mean(e e')^2 / (K (K - 1))`` for two independent deviations e and e'
        (Hoeffding 1948, sec. 5). Neighbours in the row of renders stand for the pairs. The second term is all there is
        where half of some Gaussians are dropped that do not overlap: every mask is then equally far from the mean. An
        image that is not quite the expected one makes the error larger, as a rule.
        """
        count = len(self._squares)
        first = float(torch.stack(self._squares).var()) / count
        second = 2.0 * float(torch.stack(self._products).square().mean()) / (count * (count - 1))
        return math.sqrt(first + second)


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
