"""From renders to a score: streaming moments, the sampling error, and the mean over the visible pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ca_reg._precision import at_least_single, without_autocast
from ca_reg.result import Reason
from ca_reg.types import ExactMoments

__all__ = ["Deviations", "RenderMoments", "effect_of", "exact_mean", "finite_colors", "visible_mean"]

MAX_ALPHA = 1.01  # above what rounding to 16 bits makes of an alpha of 1


class RenderMoments:
    """Running sums of renders and of their squares, pooled in groups that take turns.

    The memory is two images, plus an image and a map per group, however many renders are added. The first render is
    subtracted from all: what they have in common, which would drown their variance in E[x^2] - E[x]^2, is gone before
    anything is squared. The variance is usually off by a few roundings; by up to about K^2 of them where the first
    render alone differs from the K - 1 others.

    Args:
        groups: number of groups; each pools every ``groups``-th render.
    """

    def __init__(self, groups: int = 1) -> None:
        self.count = 0
        self._groups = groups
        self._first = self._scratch = self._sums = self._squares = torch.empty(0)

    def add(self, image: Tensor) -> None:
        """Take in one render (3, H, W)."""
        if self.count == 0:
            self._first = at_least_single(image, copy=True)
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
        """Return the variance of every pixel with divisor ``count - ddof``, averaged over RGB, (H, W), float64."""
        scatter = _add_squares(self._squares.sum(0), self._sums.sum(0), -1 / self.count)
        return scatter.clamp_(min=0).to(torch.float64) / (3 * (self.count - ddof))

    def jackknife_error(self, visible: Tensor) -> float:
        """Return the standard error over masks of the unbiased variance, averaged over the visible pixels (H, W).

        The delete-a-group jackknife; with groups of one render the ordinary jackknife. Groups may differ in size
        (pseudo-values of Busing, Meijer and van der Leeden 1999). The visible region is held fixed. nan below three
        renders, where none can be left out.
        """
        if self.count < 3:
            return math.nan
        used = min(self.count, self._groups)
        # Sums over pixels, in float64 beyond single rows: of the squares, and of the products of the groups' sums.
        squares = (self._squares[:used] * visible).sum(-1).double().sum(-1)
        rows = (self._sums[:used] * visible).flatten(1, 2).transpose(0, 1)
        with without_autocast(rows.device):
            products = torch.bmm(rows, rows.mT).double().sum(0)
        # The rest is about a few numbers, each operation a launch on a card: read once, it is left to the processor.
        sums = torch.cat([squares, products.flatten(), visible.sum(dtype=torch.float64)[None]]).cpu()
        squares, products, pixels = sums[:used], sums[used:-1].view(used, used), float(sums[-1])
        sizes = (self.count - 1 - torch.arange(used, device=sums.device)) // self._groups + 1
        rest, ratios = (self.count - sizes).to(products), (self.count / sizes).to(products)
        others = products.sum() - 2 * products.sum(0) + products.diagonal()
        left_out = (squares.sum() - squares - others / rest) / (rest - 1)
        whole = (squares.sum() - products.sum() / self.count) / (self.count - 1)
        pseudo = ratios * whole - (ratios - 1) * left_out
        # The jackknife estimate: pseudo-values weighted by their groups' shares of the renders.
        center = (pseudo / ratios).sum()
        spread = ((pseudo - center).square() / (ratios - 1)).mean()
        return float(spread.sqrt()) / (3 * pixels)


class Deviations:
    """The sampling error of the variance, from deviations of renders from the expected image over a fixed region."""

    def __init__(self, expected: Tensor, visible: Tensor) -> None:
        """Take the expected image (3, H, W) and the visible pixels (H, W)."""
        self._expected = at_least_single(expected, copy=True)
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

        With e and e' two independent deviations, as vectors over pixels and channels, and means taken over their
        elements, the variance of that estimate from K renders is
        ``Var(mean(e e)) / K + 2 E mean(e e')^2 / (K (K - 1))`` (Hoeffding 1948, sec. 5). Consecutive renders serve as
        the pairs. At a drop rate of 1/2 the first term vanishes for Gaussians that do not overlap: every mask is then
        equally far from the mean. An inaccurate expected image usually makes the error larger.
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


def finite_colors(colors: Tensor, alpha: Tensor, cover: Tensor, threshold: float) -> tuple[Tensor, bool]:
    """Return colors (3, H, W) with pixels that are not finite set to 0, and whether a non-finite value matters.

    In alpha (H, W) any does. In the colors it does unless alpha is 0 there and ``cover`` (H, W) at most the threshold,
    because some renderers divide 0 by 0 where nothing covers a pixel; it always does if no pixel is finite. Raises a
    ValueError for an alpha above 1.
    """
    # One transfer for both numbers: each would make the host wait for a GPU.
    total, highest = torch.stack((colors.sum() + alpha.sum(), _highest(alpha))).tolist()
    _check_highest(highest)
    if math.isfinite(total):
        return colors, False
    odd = ~colors.isfinite().all(0)
    broken = (~alpha.isfinite() | (odd & ((alpha != 0) | (cover > threshold)))).any() | odd.all()
    return colors.masked_fill(odd, 0.0), bool(broken)


def effect_of(value: float, differ: list[Tensor]) -> Reason:
    """Return NO_EFFECT if the score is exactly 0 although the draws differed: the renderer may have ignored them."""
    return Reason.NO_EFFECT if value == 0 and bool(torch.stack(differ).any()) else Reason.OK


def exact_mean(
    moments: ExactMoments, alpha: Tensor, threshold: float, broken: bool
) -> tuple[Tensor, Tensor, float, Reason]:
    """Return, for exact moments, the variance (H, W), the visible pixels, the mean over these, and the reason.

    The mean is nan if the reason is not OK. ``alpha`` is the expected one; ``broken`` as for `visible_mean`. The host
    waits for a GPU once, unless something is not finite. Raises what `finite_colors` does.
    """
    mean, variance, _ = moments
    visible, spread = alpha > threshold, variance.mean(0).to(torch.float64)
    # The first three are only asked whether they are finite: in double precision each would copy a picture.
    seen = torch.stack([mean.sum(), variance.sum(), alpha.sum(), _highest(alpha)])
    *totals, highest, pixels, total = torch.cat([seen, torch.stack(_visible_sums(spread, visible))]).tolist()
    _check_highest(highest)
    if all(math.isfinite(x) for x in totals):
        return spread, visible, *_mean_or_reason(pixels, total, broken, 1.0)
    for colors in (mean, variance):
        colors, odd = finite_colors(colors, alpha, alpha, threshold)
        broken |= odd
    spread = colors.mean(0).to(torch.float64)
    return spread, visible, *visible_mean(spread, visible, broken, 1.0)


def visible_mean(variance: Tensor, visible: Tensor, broken: bool, excess: float) -> tuple[float, Reason]:
    """Average over the visible pixels, or say why not; ``broken`` is what `finite_colors` found.

    ``excess`` is count / (count - ddof): the ratio of this variance to that of the population.
    """
    pixels, total = torch.stack(_visible_sums(variance, visible)).tolist()
    return _mean_or_reason(pixels, total, broken, excess)


def _visible_sums(variance: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number of visible pixels, and the sum over them."""
    return visible.sum(dtype=torch.float64), (variance * visible).sum()


def _mean_or_reason(pixels: float, total: float, broken: bool, excess: float) -> tuple[float, Reason]:
    if broken:
        return math.nan, Reason.NOT_FINITE
    if pixels == 0:
        return math.nan, Reason.EMPTY
    mean = total / pixels
    if not math.isfinite(mean):
        return math.nan, Reason.NOT_FINITE
    # Colors in [0, 1] vary by at most 1/4 (Popoviciu's inequality), which is reached if they are 0 or 1 half the time.
    return (mean, Reason.OK) if mean <= 0.25 * excess * (1.0 + 1e-6) else (math.nan, Reason.OUT_OF_RANGE)


def _highest(alpha: Tensor) -> Tensor:
    """Return the largest alpha; 0 if there is none."""
    return alpha.amax() if alpha.numel() else alpha.sum()


def _check_highest(highest: float) -> None:
    if MAX_ALPHA < highest < math.inf:
        raise ValueError(
            f"an alpha must be in [0, 1], got values up to {highest:g}: is it a depth map, or does it count to 255? "
            "Return the accumulated alpha of every pixel, the sum of its blend weights."
        )
