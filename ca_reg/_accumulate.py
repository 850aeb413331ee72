"""Streaming moments of renders: the variance map, and what its sampling error is computed from."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["Deviations", "RenderMoments"]


class RenderMoments:
    """Sums of the renders seen so far, and of their squares, in groups that take turns.

    The memory is two images, and an image and a map for each group, however many renders are added: in float32, or
    in float64 if the renders are. All are taken from the first render: what renders have in common, which would drown
    their variance in E[x^2] - E[x]^2, is gone before anything is squared. In a pixel where K renders agree and the
    first differs, the square of the mean still is K - 1 times the variance, so a variance errs by at most about K^2
    roundings there, and by a few of them as a rule.

    Args:
        groups: in which renders are pooled; each gets every ``groups``-th one.
    """

    def __init__(self, groups: int = 1) -> None:
        self.count = 0
        self._groups = groups
        self._first = self._scratch = self._sums = self._squares = torch.empty(0)

    def add(self, image: Tensor) -> None:
        """Take in one render (3, H, W)."""
        if self.count == 0:
            self._first = image.to(torch.promote_types(image.dtype, torch.float32), copy=True)
            self._scratch = torch.empty_like(self._first)
            self._sums = self._first.new_zeros(self._groups, *image.shape)
            self._squares = self._first.new_zeros(self._groups, *image.shape[1:])
        _check_size(image, self._first)
        group = self.count % self._groups
        is_first = group == self.count
        deviation = torch.sub(image, self._first, out=self._sums[group] if is_first else self._scratch)
        if not is_first:
            self._sums[group] += deviation
        _add_squares(self._squares[group], deviation)
        self.count += 1

    def variance(self, ddof: int) -> Tensor:
        """Return the variance of every pixel, mean over RGB, (H, W), float64; it divides by ``count - ddof``."""
        scatter = _add_squares(self._squares.sum(0), self._sums.sum(0), -1 / self.count)
        return scatter.clamp_(min=0).to(torch.float64) / (3 * (self.count - ddof))

    def jackknife_error(self, visible: Tensor) -> float:
        """Return the standard error over masks of the unbiased variance, averaged over the visible pixels (H, W).

        The delete-a-group jackknife: leave out one group after the other and see how the value moves. With groups of
        one render it is the ordinary jackknife. Groups may differ in size (pseudo-values of Busing, Meijer and van der
        Leeden 1999). The visible region is held fixed. nan below three renders, where nothing can be left out.
        """
        if self.count < 3:
            return math.nan
        used = min(self.count, self._groups)
        # Sums over the pixels, in float64 from rows of the image on: of squares, and of the products of groups' sums.
        squares = (self._squares[:used] * visible).sum(-1).double().sum(-1)
        rows = (self._sums[:used] * visible).flatten(1, 2).transpose(0, 1)
        products = torch.bmm(rows, rows.mT).double().sum(0)
        rest = self.count - torch.tensor([len(range(group, self.count, self._groups)) for group in range(used)])
        rest, ratios = rest.to(products), (self.count / (self.count - rest)).to(products)
        others = products.sum() - 2 * products.sum(0) + products.diagonal()
        left_out = (squares.sum() - squares - others / rest) / (rest - 1)
        whole = (squares.sum() - products.sum() / self.count) / (self.count - 1)
        pseudo = ratios * whole - (ratios - 1) * left_out
        # The jackknife value, sum over groups of pseudo-values weighted by the share of their renders.
        center = (pseudo / ratios).sum()
        spread = ((pseudo - center).square() / (ratios - 1)).mean()
        return float(spread.sqrt()) / (3 * int(visible.sum()))


class Deviations:
    """Deviations of renders from the expected image over a fixed region: the error of their variance."""

    def __init__(self, expected: Tensor, visible: Tensor) -> None:
        """Take the expected image (3, H, W) and the visible pixels (H, W)."""
        self._expected = expected.to(torch.promote_types(expected.dtype, torch.float32), copy=True)
        self._visible = visible
        self._last: Tensor | None = None
        self._squares: list[Tensor] = []
        self._products: list[Tensor] = []

    def add(self, image: Tensor) -> None:
        """Take in one render (3, H, W)."""
        _check_size(image, self._expected)
        deviation = (image - self._expected).mul_(self._visible)
        self._squares.append(deviation.square().sum())
        if self._last is not None:
            self._products.append((deviation * self._last).sum())
        self._last = deviation

    def std_error(self) -> float:
        """Return the standard error over masks of the unbiased variance, averaged over the visible pixels.

        With e_1 .. e_K the deviations as vectors over pixels and channels, and means taken over these, the variance of
        that estimate is ``Var(mean(e e)) / K + 2 E mean(e e')^2 / (K (K - 1))`` for two independent deviations e and e'
        (Hoeffding 1948, sec. 5). Neighbors in the row of renders stand for the pairs. The second term is all there is
        where half of some Gaussians are dropped that do not overlap: every mask is then equally far from the mean. An
        image that is not quite the expected one makes the error larger, as a rule.
        """
        count = len(self._squares)
        squares, products = (torch.stack(x).to(torch.float64) for x in (self._squares, self._products))
        both = squares.var() / count + 2.0 * products.square().mean() / (count * (count - 1))
        return math.sqrt(float(both)) / (3 * int(self._visible.sum()))


def _check_size(image: Tensor, first: Tensor) -> None:
    if image.shape != first.shape:
        sizes = f"{tuple(first.shape)} and then {tuple(image.shape)}"
        raise ValueError(f"the renders of one view must have one size, got {sizes}.")


def _add_squares(to: Tensor, image: Tensor, factor: float = 1.0) -> Tensor:
    """Add factor times the squares of an image (3, H, W), channel by channel, to a map (H, W)."""
    for channel in image:
        to.addcmul_(channel, channel, value=factor)
    return to
