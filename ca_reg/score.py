"""The Co-Adaptation Score: how much a view changes when random Gaussians are left out."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from ca_reg._accumulate import Deviations, RenderMoments
from ca_reg._check import check_callable, check_count, check_opacity, check_opacity_range, check_rate
from ca_reg._random import seeded
from ca_reg._settings import GROUPS, LEAST, ROUND, make_settings
from ca_reg.functional import Multiplier
from ca_reg.params import Params
from ca_reg.reason import Reason
from ca_reg.regularizer import Regularizer
from ca_reg.regularizers import GaussianDropout
from ca_reg.result import COLUMNS, CAResult, CASummary, row_of, summary_of
from ca_reg.types import (
    ExactMoments,
    Layout,
    MomentsFn,
    RenderFn,
    check_layout,
    read_alpha_pass,
    read_moments,
    read_rendering,
)

__all__ = ["CAScore", "view_position"]

MAX_ALPHA = 1.01  # above what rounding to 16 bits makes of an alpha of 1


class ExactView(NamedTuple):
    """An exact score and the arguments of its moments call; the background is in the callable's own layout."""

    result: CAResult
    opacity: Tensor
    multiplier: Multiplier
    background: Tensor | None


class CAScore:
    """Measure co-adaptation with any renderer, by sampling or exactly (paper, "Quantifying Co-Adaptation").

    One view is rendered ``samples`` times, each time without a random subset of the Gaussians. The score is the
    variance of these renders, per pixel and channel, averaged over RGB and over the pixels whose accumulated alpha
    exceeds ``threshold`` in every render. The defaults are the protocol of the authors' released code: 5 renders, drop
    rate ``1 - (1 - p)/2``, alpha above 0.8, population variance, opacities not scaled and without noise, colors not
    clamped.

    Read the score with its error. At 5 samples the variance of a single pixel is known to about 70 %. The mean over an
    image is known better: ``std_error`` estimates its error by a delete-a-group jackknife over the renders, with the
    visible region held fixed. With few samples it is too large (by some 15 % at 5, 50 % at 3); it needs at least three.

    The memory does not grow with ``samples``: renders are pooled in at most 8 groups of one image and one map each, in
    the precision of the renders, at least float32.

    Two other methods approach the limit of infinitely many renders. The paper's region, the pixels that all renders
    cover, has no such limit, because it shrinks with every render; both methods take the pixels whose *expected* alpha
    exceeds the threshold, a region that does not depend on the draws.

    - *Exact*: give ``exact`` if the renderer offers moments (:func:`ca_reg.functional.pixel_moments`). Nothing is
      sampled, the error is 0, and neither the seed nor the index of the view matters. With ``neutral`` each pixel is
      composited over its own expected color (:func:`ca_reg.functional.neutral_background`), so that holes do not show
      the background, and only disagreement between the colors of the Gaussians counts.
    - *Adaptive*: give ``relative_error``. After the first 16 renders, 8 are added at a time until the standard error is
      at most this fraction of the score. One more render, with all opacities multiplied by ``1 - drop_rate``, decides
      the region: up to the renderer's clamp and cut-off of alpha it is the expected image. The standard error is itself
      an estimate, good to 18 % or better. In images of a dozen Gaussians, stopping where it looks small biases scores
      downward by up to 0.6 standard errors; docs/studies.md has the calibration.

    Convention: ``opacity`` is activated, in [0, 1], (N,) or (N, 1), and neither scaled nor dropped; images are
    (3, H, W), or (H, W, 3) with ``layout="HWC"``. Regularizers inside the callable must be off.

    Args:
        render_fn: the renderer of the model, ``render_fn(opacity, view)``; see :class:`ca_reg.types.RenderFn`. Exact
            scores ignore it.
        samples: number of renders K, at least 2; by default 5, or as many as ``relative_error`` asks for.
        p: dropout rate that the model was trained with, 0 if it was trained without (or with compensated) dropout.
        drop_rate: fraction of the Gaussians to drop in each render, in [0, 1); by default ``1 - (1 - p)/2``, which
            keeps half as many as training did.
        regularizer: draws opacities in place of that dropout, such as
            :class:`~ca_reg.regularizers.ClusteredDropout`, which drops neighbors together; ``p`` and ``drop_rate`` then
            do not apply. An exact or adaptive score needs its ``multiplied``. If it reads more than opacities, call the
            score with :class:`~ca_reg.Params`.
        threshold: accumulated alpha above which a pixel is visible.
        ddof: the divisor of the variance is ``samples - ddof``: 0, the default, as in the released code, 1 for an
            unbiased estimate. Always 1 for adaptive scores, which would otherwise depend on the number of renders.
        layout: order of the axes of the images, ``"CHW"`` or ``"HWC"``.
        alpha_fn: for renderers that return no alpha: ``alpha_fn(opacity, view)`` renders the same view with all colors
            1 over a background of 0, or returns the alpha itself. It is called once per render, which doubles the
            cost, and replaces any alpha from ``render_fn``. The two may share an output buffer.
        seed: seed of the masks. They are drawn on the CPU from (seed, view index) alone, so they are the same on every
            device, and adding a view does not change those of the others. More renders extend the same sequence.
        exact: moments of the model's renderer, ``exact(opacity, view, multiplier, background)``; see
            :class:`ca_reg.types.MomentsFn`. The score is then exact.
        neutral: make the exact score independent of the background; takes two calls of ``exact``.
        relative_error: target standard error of adaptive sampling, as a fraction of the score, above 0.
        max_samples: number of renders at which adaptive sampling stops in any case, at least 16, by default 256. The
            standard error of the result may then exceed the target.

    Raises:
        TypeError: if an argument is of the wrong type.
        ValueError: if one is out of range, or does not apply to the method.

    Example:
        A wall of ten gray layers; where one is missing, the next shows.

        >>> def render_fn(opacity: Tensor, view: None) -> tuple[Tensor, Tensor]:
        ...     transmittance = torch.cumprod(1 - opacity, 0)
        ...     weights = opacity * torch.cat([torch.ones(1), transmittance[:-1]])
        ...     color = (weights * torch.linspace(0, 1, 10)).sum()
        ...     return color.expand(3, 4, 4), weights.sum().expand(4, 4)
        >>> score = CAScore(render_fn, samples=64, threshold=0.5)
        >>> result = score(torch.full((10,), 0.9), view=None)
        >>> result.reason, 0.005 < result.value < 0.05, result.variance.shape
        (<Reason.OK: ...>, True, torch.Size([4, 4]))
        >>> adaptive = CAScore(render_fn, relative_error=0.2, threshold=0.5)(torch.full((10,), 0.9), view=None)
        >>> adaptive.std_error / adaptive.value <= 0.2
        True
        >>> adaptive.samples in range(16, 257, 8)
        True
    """

    def __init__(
        self,
        render_fn: RenderFn | None = None,
        *,
        samples: int | None = None,
        p: float = 0.0,
        drop_rate: float | None = None,
        regularizer: Regularizer | None = None,
        threshold: float = 0.8,
        ddof: int | None = None,
        layout: Layout = "CHW",
        alpha_fn: RenderFn | None = None,
        seed: int = 0,
        exact: MomentsFn | None = None,
        neutral: bool = False,
        relative_error: float | None = None,
        max_samples: int | None = None,
    ) -> None:
        for name, fn in (("render_fn", render_fn), ("alpha_fn", alpha_fn)):
            if fn is not None:
                check_callable(fn, name)
        if exact is not None:
            check_callable(exact, "exact", "opacity, view, multiplier, background")
        if render_fn is None and exact is None:
            raise ValueError("give render_fn, or exact if the renderer offers moments; without both nothing renders.")
        if exact is not None and alpha_fn is not None:
            raise ValueError("alpha_fn does not apply to an exact score, whose moments hold the expected alpha.")
        check_layout(layout)
        check_rate(p)
        if not (regularizer is None or isinstance(regularizer, Regularizer)):
            raise TypeError(
                f"regularizer must be a ca_reg.Regularizer, got {type(regularizer).__name__}: wrap it in ca_reg.Chain."
            )
        if regularizer is None:
            drop_rate = 1.0 - (1.0 - p) / 2.0 if drop_rate is None else drop_rate
        elif p != 0 or drop_rate is not None:
            raise ValueError("p and drop_rate do not apply to the draws of a regularizer, which has rates of its own.")
        self.settings = make_settings(
            exact=exact is not None,
            neutral=neutral,
            drop_rate=drop_rate,
            regularizer=None if regularizer is None else repr(regularizer),
            threshold=threshold,
            seed=seed,
            samples=samples,
            ddof=ddof,
            relative_error=relative_error,
            max_samples=max_samples,
        )
        self.render_fn = render_fn
        self.alpha_fn = alpha_fn
        self.exact = exact
        self.layout: Layout = layout
        self.regularizer = GaussianDropout(self.settings.drop_rate or 0.0) if regularizer is None else regularizer
        self.p = float(p)
        self.seed = int(seed)
        self.reset()

    def __call__(self, opacity: Tensor | Params, view: Any, *, index: int = 0) -> CAResult:
        """Measure one view without counting it in :meth:`compute`.

        Args:
            opacity: activated opacities in [0, 1], shape (N,) or (N, 1); or :class:`~ca_reg.Params` with all that the
                regularizer needs.
            view: passed on to the callables as it is.
            index: position of the view among all views, at least 0; determines the masks together with the seed.

        Returns:
            The score with its maps. Without visible pixels the value is nan and ``reason`` says so.

        Raises:
            TypeError: if ``opacity`` or a render is not of the right type.
            ValueError: if a shape is wrong, ``opacity`` looks like logits, or there is no alpha.
        """
        x = self._params(opacity)
        check_count(index, "index", minimum=0)
        with torch.no_grad():
            if self.exact is not None:
                return self._exact(self.exact, x, view).result
            assert self.render_fn is not None
            sample = self._adapt if self.settings.method == "adaptive" else self._sample
            return sample(self.render_fn, x, view, index)

    def _params(self, given: Tensor | Params) -> Params:
        """Check the opacities or parameters that a score was called with, and return them with opacities detached."""
        x = given if isinstance(given, Params) else Params(given)
        check_opacity(x.opacities)
        check_opacity_range(x.opacities)
        self.regularizer.check_needs(x)
        return x._replace(opacities=x.opacities.detach(), step=self.regularizer.step if x.step is None else x.step)

    def update(self, opacity: Tensor | Params, view: Any, *, index: int | None = None) -> CAResult:
        """Measure one view and count it in the mean that :meth:`compute` returns.

        Args:
            opacity: as for a call of the score.
            view: as for a call of the score.
            index: position of the view among all views, which gives every view its own masks. By default views are
                counted from the last reset, and over ranks as if dealt out in turn, as
                :class:`torch.utils.data.DistributedSampler` does without shuffling: the result then is that of a single
                process. Give the position in the whole set if the views are split in another way.

        Raises:
            TypeError, ValueError: as for a call of the score.
        """
        result = self(opacity, view, index=view_position(self._updates) if index is None else index)
        self._sums += row_of(result)
        self._updates += 1
        return result

    def compute(self) -> CASummary:
        """Return the mean over the views counted so far, on all ranks if torch.distributed is initialized.

        Views without visible pixels are left out of the mean; ``empty_views`` counts them. The standard error is over
        the choice of masks, with the views held fixed. On several ranks every rank must call this.
        """
        sums = self._sums.clone()
        if dist.is_available() and dist.is_initialized():
            on_gpu = dist.get_backend() == "nccl"
            sums = sums.to(torch.device("cuda", torch.cuda.current_device()) if on_gpu else "cpu")
            dist.all_reduce(sums)
        return summary_of(sums, self.settings)

    def reset(self) -> None:
        """Forget all views."""
        self._sums = torch.zeros(COLUMNS, dtype=torch.float64, device="cpu")
        self._updates = 0

    def _exact(self, moments_fn: MomentsFn, x: Params, view: Any) -> ExactView:
        """Compute the score from the renderer's moments."""
        settings = self.settings
        rendered, multiplier = self._multiplied(x)
        opacity = rendered.opacities.view_as(x.opacities)

        def moments(background: Tensor | None) -> tuple[ExactMoments, Tensor]:
            # A copy: the callable may edit its opacities in place.
            read = read_moments(moments_fn(opacity.clone(), view, multiplier, background), layout=self.layout)
            if read.alpha_mean is None:
                raise TypeError("a score needs alpha_mean, the expected accumulated alpha, for its visible region.")
            return read, read.alpha_mean

        broken, background = False, None
        if settings.method == "exact_neutral":
            # Over black the mean is sum w c and the expected alpha sum w: their ratio is the neutral background.
            over_black, total = moments(opacity.new_zeros(3))
            black, broken = _finite(over_black.mean, total, total, 0)
            neutral = (black / torch.where(total > 0, total, 1.0)).nan_to_num(0.0, 0.0, 0.0)
            background = neutral if self.layout == "CHW" else neutral.permute(1, 2, 0)
        image, alpha = moments(background)
        alpha = alpha.to(image.variance.device)
        visible = alpha > settings.threshold
        for colors in image[:2]:
            colors, odd = _finite(colors, alpha, alpha, settings.threshold)
            broken |= odd
        variance = colors.mean(0).to(torch.float64)
        value, reason = _mean(variance, visible, broken, 1.0)
        std_error = 0.0 if reason is Reason.OK else math.nan
        result = self._result(value, std_error, variance, visible, reason, None)
        return ExactView(result, opacity, multiplier, background)

    def _sample(self, render_fn: RenderFn, x: Params, view: Any, index: int) -> CAResult:
        """Render a fixed number of times; a pixel is visible if every render covers it (the paper's protocol)."""
        settings = self.settings
        assert settings.samples is not None
        assert settings.ddof is not None
        moments, lowest, broken = RenderMoments(min(settings.samples, GROUPS)), torch.tensor(math.inf), False
        differ: list[Tensor] = []
        for image, alpha in self._renders(render_fn, self._drawn(x, index, settings.samples, differ), view):
            lowest = torch.minimum(lowest.to(alpha), alpha)
            image, odd = _finite(image, alpha, lowest, settings.threshold)
            broken |= odd
            moments.add(image)
        visible = lowest > settings.threshold
        variance = moments.variance(settings.ddof)
        value, reason = _mean(variance, visible, broken, moments.count / (moments.count - settings.ddof))
        std_error = math.nan
        if reason is Reason.OK:
            # For a given visible region this factor relates the unbiased variance to this one, and so their errors.
            std_error = moments.jackknife_error(visible) * (moments.count - 1) / (moments.count - settings.ddof)
            reason = _effect(value, differ)
        return self._result(value, std_error, variance, visible, reason, moments.count)

    def _adapt(self, render_fn: RenderFn, x: Params, view: Any, index: int) -> CAResult:
        """Render until the error is small enough, over the pixels that the expected image covers.

        The region must not come from the sampled renders: pixels that they all happen to cover happen to vary little,
        and the error would have to include the variation of the region.
        """
        settings = self.settings
        assert settings.max_samples is not None
        mean, multiplier = self._multiplied(x)
        expected, alpha = self._render(render_fn, (mean.opacities * multiplier.mean).view_as(x.opacities), view)
        visible = alpha > settings.threshold
        expected, broken = _finite(expected, alpha, visible, 0)
        moments, deviations = RenderMoments(), Deviations(expected, visible)
        del expected, alpha  # may be buffers of the renderer, which the next render overwrites
        result, differ = None, list[Tensor]()
        renders = self._renders(render_fn, self._drawn(x, index, settings.max_samples, differ), view)
        for k, (image, alpha) in enumerate(renders, start=1):
            image, odd = _finite(image, alpha, visible, 0)
            broken |= odd
            moments.add(image)
            deviations.add(image)
            if k == settings.max_samples or (k >= LEAST and k % ROUND == 0):
                variance = moments.variance(ddof=1)
                value, reason = _mean(variance, visible, broken, k / (k - 1))
                if reason is Reason.OK and k == settings.max_samples:
                    reason = _effect(value, differ)
                result = self._result(value, self._error(value, deviations), variance, visible, reason, k)
                if self._is_settled(result):
                    break
        assert result is not None
        return result

    def _error(self, value: float, deviations: Deviations) -> float:
        """Return the standard error of an adaptive score; nan if no render differed, unless nothing is dropped."""
        if value == 0:
            return 0.0 if self.settings.drop_rate == 0 else math.nan
        return deviations.std_error() if math.isfinite(value) else math.nan

    def _is_settled(self, result: CAResult) -> bool:
        """Whether to stop rendering: the error is small enough, or there is no value to refine."""
        target = self.settings.relative_error
        return result.reason is not Reason.OK or (target is not None and result.std_error <= target * result.value)

    def _multiplied(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the regularizer's ``multiplied``, or raise if it has none."""
        multiplied = self.regularizer.multiplied(_flat(x))
        if multiplied is None:
            raise ValueError(
                f"the draws of {type(self.regularizer).__name__} are no independent factors of the opacities, which an "
                "exact or adaptive score needs: give samples instead."
            )
        return multiplied

    def _drawn(self, x: Params, index: int, count: int, differ: list[Tensor]) -> Iterator[Tensor]:
        """Yield the opacities of one view under ``count`` random draws, each a new tensor.

        ``differ`` takes, for every draw but the first, whether it differs from that, as a tensor that is not yet read.
        """
        generator, flat, first = seeded(self.seed, index), _flat(x), None
        for _ in range(count):
            drawn, *others = self.regularizer.replay(flat, self.regularizer.draw(flat, generator))
            if any(a is not b for a, b in zip(others, flat[1:], strict=True)):
                raise ValueError(
                    f"{type(self.regularizer).__name__} changes more than opacities, which is all that render_fn is "
                    "given: leave out of the score what does."
                )
            if first is None:
                first = drawn.clone()  # the callable may edit its opacities
            else:
                differ.append((drawn != first).any())
            yield (drawn.clone() if drawn is flat.opacities else drawn).view_as(x.opacities)

    def _renders(self, render_fn: RenderFn, drawn: Iterator[Tensor], view: Any) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield colors and alpha for each draw of the opacities, several per call if the renderer has ``many``."""
        many = getattr(render_fn, "many", None)
        if many is None or self.alpha_fn is not None:
            yield from (self._render(render_fn, opacity, view) for opacity in drawn)
        else:
            while some := list(itertools.islice(drawn, ROUND)):
                yield from (self._read(x) for x in zip(*many(torch.stack(some), view), strict=True))

    def _render(self, render_fn: RenderFn, opacity: Tensor, view: Any) -> tuple[Tensor, Tensor]:
        """Render colors (3, H, W) and alpha (H, W) with these opacities."""
        if self.alpha_fn is not None:
            # Copies: the second pass may overwrite the buffer of the first, and either may edit opacities in place.
            image = read_rendering(render_fn(opacity.clone(), view), layout=self.layout).image.clone()
            alpha = read_alpha_pass(self.alpha_fn(opacity, view), image, layout=self.layout)
            return image, alpha.to(image.device)
        return self._read(render_fn(opacity, view))

    def _read(self, returned: Any) -> tuple[Tensor, Tensor]:
        """Read colors (3, H, W) and alpha (H, W) off what a renderer has returned."""
        image, read_alpha = read_rendering(returned, layout=self.layout)
        if read_alpha is None:
            raise ValueError(
                "render_fn returned an image without an alpha, which the visible region needs. Do one of three: return "
                "(image, alpha); return a mapping or object with an alpha named alpha, rendered_alpha or accumulation; "
                "or give CAScore an alpha_fn(opacity, view) that renders all colors 1 on a background of 0."
            )
        return image.contiguous(), read_alpha.to(image.device)

    def _result(
        self, value: float, std_error: float, variance: Tensor, visible: Tensor, reason: Reason, samples: int | None
    ) -> CAResult:
        """Put a score together with its settings."""
        settings = asdict(replace(self.settings, samples=samples))
        return CAResult(value=value, std_error=std_error, variance=variance, visible=visible, reason=reason, **settings)


def _flat(x: Params) -> Params:
    """Return ``x`` with opacities of shape (N,)."""
    return x._replace(opacities=x.opacities.reshape(-1))


def view_position(count: int, group: dist.ProcessGroup | None = None) -> int:
    """Return the position, among the views of all ranks, of the view that follows ``count`` others on this rank."""
    if not (dist.is_available() and dist.is_initialized()):
        return count
    return dist.get_rank(group) + dist.get_world_size(group) * count


def _finite(colors: Tensor, alpha: Tensor, cover: Tensor, threshold: float) -> tuple[Tensor, bool]:
    """Return colors (3, H, W) with pixels that are not finite set to 0, and whether a non-finite value matters.

    In alpha (H, W) any does. In the colors it does unless alpha is 0 there and ``cover`` (H, W) at most the threshold,
    because some renderers divide 0 by 0 where nothing covers a pixel; it always does if no pixel is finite. Raises a
    ValueError for an alpha above 1.
    """
    # One transfer for both numbers: each would make the host wait for a GPU.
    total, highest = torch.stack((colors.sum() + alpha.sum(), alpha.amax() if alpha.numel() else alpha.sum())).tolist()
    if MAX_ALPHA < highest < math.inf:
        raise ValueError(
            f"an alpha must be in [0, 1], got values up to {highest:g}: is it a depth map, or does it count to 255? "
            "Return the accumulated alpha of every pixel, the sum of its blend weights."
        )
    if math.isfinite(total):
        return colors, False
    odd = ~colors.isfinite().all(0)
    broken = (~alpha.isfinite() | (odd & ((alpha != 0) | (cover > threshold)))).any() | odd.all()
    return colors.masked_fill(odd, 0.0), bool(broken)


def _effect(value: float, differ: list[Tensor]) -> Reason:
    """Return NO_EFFECT if the score is exactly 0 although the draws differed: the renderer may have ignored them."""
    return Reason.NO_EFFECT if value == 0 and bool(torch.stack(differ).any()) else Reason.OK


def _mean(variance: Tensor, visible: Tensor, broken: bool, excess: float) -> tuple[float, Reason]:
    """Average over the visible pixels, or say why not; ``broken`` is what `_finite` found.

    ``excess`` is the divisor of a population variance over that of this one.
    """
    pixels = int(visible.count_nonzero())
    if broken:
        return math.nan, Reason.NOT_FINITE
    if pixels == 0:
        return math.nan, Reason.EMPTY
    mean = float((variance * visible).sum()) / pixels
    if not math.isfinite(mean):
        return math.nan, Reason.NOT_FINITE
    # Colors in [0, 1] vary by at most 1/4 (Popoviciu's inequality), which is reached if they are 0 or 1 half the time.
    return (mean, Reason.OK) if mean <= 0.25 * excess * (1.0 + 1e-6) else (math.nan, Reason.OUT_OF_RANGE)
