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

from ca_reg._accumulate import Deviations, RenderMoments, effect_of, exact_mean, finite_colors, visible_mean
from ca_reg._check import check_callable, check_count, check_finite, check_opacity, check_opacity_range, check_rate
from ca_reg._random import PortableGenerator
from ca_reg.functional import Multiplier
from ca_reg.regularizer import Params, Regularizer
from ca_reg.regularizers import GaussianDropout
from ca_reg.regularizers.surroundings import with_own_memory
from ca_reg.result import COLUMNS, CAResult, CASettings, CASummary, Method, Reason, row_of, summary_of, view_position
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

__all__ = ["CAScore", "ExactScore"]

# Renders are pooled in at most this many groups, which bounds the memory; fewer groups would make the standard error
# less certain (its relative error is about 1/sqrt(2 (groups - 1)), here 27 %).
GROUPS = 8

# Renders that adaptive sampling adds between checks of the error, and that ``render_batch`` makes at once.
BATCH = 8

# Renders before the first check: the error is then known to 18 %. Stopping where the estimated error happens to be
# small biases it downward, the more so the less certain it is: with 8 renders it is known to 27 %.
MIN_RENDERS = 16


class CAScore:
    """Measure co-adaptation with any renderer (paper, "Quantifying Co-Adaptation").

    One view is rendered several times, each time without a random subset of the Gaussians. The score is the variance of
    these renders, per pixel and channel, averaged over RGB and over the visible pixels:

    - ``CAScore(render_fn)`` is the protocol of the authors' released code: 5 renders at drop rate ``1 - (1 - p)/2``,
      the pixels with an alpha above 0.8 in every render, population variance, opacities neither scaled nor noisy,
      colors not clamped.
    - :meth:`CAScore.exact` is the limit of infinitely many renders, for renderers that offer moments.
    - :meth:`CAScore.adaptive` renders until the standard error is small enough.

    Read a sampled score with its error, ``std_error``, a delete-a-group jackknife over the renders with the visible
    region held fixed. With few samples it is too large (by some 15 % at 5, 50 % at 3); it needs at least three. The
    memory does not grow with ``samples``. The region of the sampled score shrinks with every render; the other methods
    take the pixels whose *expected* alpha exceeds the threshold, whatever is drawn.

    Convention: ``opacity`` is activated, in [0, 1], (N,) or (N, 1), and neither scaled nor dropped; images are
    (3, H, W), or (H, W, 3) with ``layout="HWC"``. Regularizers inside the callable must be off.

    Args:
        render_fn: the renderer of the model, ``render_fn(opacity, view)``; see :class:`ca_reg.types.RenderFn`.
        samples: number of renders K, at least 2.
        p: dropout rate that the model was trained with, 0 if it was trained without (or with compensated) dropout.
        drop_rate: fraction of the Gaussians to drop in each render, in [0, 1); ``1 - (1 - p)/2`` by default, which
            keeps half as many as training did.
        regularizer: draws opacities in place of that dropout; ``p`` and ``drop_rate`` then do not apply. An exact or
            adaptive score needs its ``alpha_factor``. If it reads more than opacities, call the score with
            :class:`~ca_reg.Params`.
        threshold: accumulated alpha above which a pixel is visible.
        ddof: the divisor of the variance is ``samples - ddof``: 0 as in the released code, 1 for an unbiased estimate.
        layout: order of the axes of the images, ``"CHW"`` or ``"HWC"``.
        alpha_fn: for renderers without an alpha: ``alpha_fn(opacity, view)`` renders the view with all colors 1 over a
            background of 0, or returns the alpha itself. It is called once per render, doubles the cost, and
            replaces any alpha of ``render_fn``.
        seed: seed of the masks. They follow from (seed, view index) alone: the same on every device, where they are
            computed, and whatever other views there are. More renders extend the same sequence.

    Raises:
        TypeError: if an argument is of the wrong type.
        ValueError: if one is out of range.

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
    """

    _sums: Tensor
    _updates: int

    def __init__(
        self,
        render_fn: RenderFn,
        *,
        samples: int = 5,
        p: float = 0.0,
        drop_rate: float | None = None,
        regularizer: Regularizer | None = None,
        threshold: float = 0.8,
        ddof: int = 0,
        layout: Layout = "CHW",
        alpha_fn: RenderFn | None = None,
        seed: int = 0,
    ) -> None:
        check_count(samples, "samples", minimum=2)
        check_count(ddof, "ddof", minimum=0)
        if ddof >= samples:
            raise ValueError(f"ddof must be below samples, got ddof {ddof} and {samples} samples.")
        self._set_renderer(render_fn, alpha_fn, seed)
        self._set(
            "sampling", threshold, layout, p, drop_rate, regularizer,
            samples=int(samples), ddof=int(ddof), seed=int(seed),
        )  # fmt: skip

    @classmethod
    def exact(
        cls,
        moments_fn: MomentsFn,
        *,
        neutral: bool = False,
        p: float = 0.0,
        drop_rate: float | None = None,
        regularizer: Regularizer | None = None,
        threshold: float = 0.8,
        layout: Layout = "CHW",
    ) -> ExactScore:
        """Return the score of infinitely many renders, for a renderer that offers moments.

        Nothing is sampled and the error is 0. A pixel is visible where its expected alpha exceeds ``threshold``.

        ``moments_fn(opacity, view, multiplier, background)`` is a :class:`ca_reg.types.MomentsFn`;
        :class:`ca_reg.lists.ListMoments` makes one from lists of the Gaussians at each pixel. With ``neutral`` each
        pixel is composited over its own expected color (:func:`ca_reg.functional.neutral_background`), so that only
        disagreement between the colors of the Gaussians counts; this takes two calls. The other arguments are those of
        :class:`CAScore`.

        Example:
            >>> from ca_reg.functional import alpha_moments
            >>> def moments_fn(opacity: Tensor, view: None, multiplier: Multiplier, background: object) -> object:
            ...     mean, variance = (x.expand(3, 4, 4) for x in alpha_moments(opacity, multiplier))  # white over black
            ...     return {"mean": mean, "variance": variance, "alpha_mean": mean[0]}
            >>> round(CAScore.exact(moments_fn, threshold=0.3)(torch.tensor([0.8]), view=None).value, 6)  # 0 or 0.8
            0.16
        """
        common = {"threshold": threshold, "layout": layout, "p": p, "drop_rate": drop_rate, "regularizer": regularizer}
        return ExactScore(moments_fn, neutral, **common)

    @classmethod
    def adaptive(
        cls,
        render_fn: RenderFn,
        *,
        relative_error: float,
        max_samples: int = 256,
        p: float = 0.0,
        drop_rate: float | None = None,
        regularizer: Regularizer | None = None,
        threshold: float = 0.8,
        layout: Layout = "CHW",
        alpha_fn: RenderFn | None = None,
        seed: int = 0,
    ) -> CAScore:
        """Return a score that renders each view until its standard error is small enough.

        After the first 16 renders, 8 are added at a time. One more render, of the mean opacities, decides the region.
        The variance is unbiased (``ddof`` 1). The standard error is itself an estimate, good to 18 % or better:
        stopping where it looks small biases scores downward by up to 0.6 standard errors; docs/studies.md has the
        calibration.

        ``relative_error``, above 0, is the target of the standard error as a fraction of the score. ``max_samples``, at
        least 16, ends the sampling in any case. The other arguments are those of :class:`CAScore`.

        Example:
            >>> score = CAScore.adaptive(
            ...     lambda opacity, view: (opacity[:48].view(3, 4, 4), torch.ones(4, 4)), relative_error=0.2
            ... )
            >>> result = score(torch.ones(50), view=None)
            >>> result.std_error / result.value <= 0.2, result.samples in range(16, 257, 8)
            (True, True)
        """
        common = {"threshold": threshold, "layout": layout, "p": p, "drop_rate": drop_rate, "regularizer": regularizer}
        return _AdaptiveScore(render_fn, relative_error, max_samples, alpha_fn, seed, **common)

    def _set(
        self, method: Method, threshold: float, layout: Layout, p: float, drop_rate: float | None,
        regularizer: Regularizer | None, **others: Any,
    ) -> None:  # fmt: skip
        """Check and store what all methods have in common, and the settings, which the results carry."""
        check_layout(layout)
        check_rate(p)
        check_finite(threshold, "threshold")
        if not (regularizer is None or isinstance(regularizer, Regularizer)):
            raise TypeError(
                f"regularizer must be a ca_reg.Regularizer, got {type(regularizer).__name__}: wrap it in ca_reg.Chain."
            )
        if regularizer is None:
            rate = 1.0 - (1.0 - p) / 2.0 if drop_rate is None else drop_rate
            check_rate(rate, "drop_rate")
            self.regularizer: Regularizer = GaussianDropout(rate)
            others["drop_rate"] = float(rate)
        elif p != 0 or drop_rate is not None:
            raise ValueError("p and drop_rate do not apply to the draws of a regularizer, which has rates of its own.")
        else:
            self.regularizer, others["regularizer"] = regularizer, repr(regularizer)
        self._measured = with_own_memory(self.regularizer)
        self.p, self.layout = float(p), layout
        self.settings = CASettings(method=method, threshold=float(threshold), **others)
        self.reset()

    def _set_renderer(self, render_fn: RenderFn, alpha_fn: RenderFn | None, seed: int) -> None:
        """Check and store what draws and renders."""
        check_callable(render_fn, "render_fn")
        if alpha_fn is not None:
            check_callable(alpha_fn, "alpha_fn")
        check_count(seed, "seed", minimum=0)
        self.render_fn, self.alpha_fn, self.seed = render_fn, alpha_fn, int(seed)

    def __call__(self, opacity: Tensor | Params, view: Any, *, index: int = 0) -> CAResult:
        """Measure one view without counting it in :meth:`compute`; return the score with its maps and its reason.

        ``opacity`` is activated, in [0, 1], shape (N,) or (N, 1); or :class:`~ca_reg.Params`. ``view`` is passed on as
        it is. ``index``, at least 0, is the position of the view among all; with the seed it determines the masks.

        Raises:
            TypeError: if ``opacity`` or a render is not of the right type.
            ValueError: if a shape is wrong, ``opacity`` looks like logits, or there is no alpha.
        """
        x = self._params(opacity)
        check_count(index, "index", minimum=0)
        with torch.no_grad():
            return self._measure(x, view, index)

    def _params(self, given: Tensor | Params) -> Params:
        """Check the opacities or parameters that a score was called with, and return them with opacities detached."""
        x = given if isinstance(given, Params) else Params(given)
        check_opacity(x.opacities)
        check_opacity_range(x.opacities)
        self.regularizer.check_needs(x)
        return x._replace(opacities=x.opacities.detach(), step=self.regularizer.step if x.step is None else x.step)

    def update(self, opacity: Tensor | Params, view: Any, *, index: int | None = None) -> CAResult:
        """Measure one view and count it in the mean that :meth:`compute` returns; arguments and errors as for a call.

        Views are counted from the last reset, and over ranks as :class:`torch.utils.data.DistributedSampler` deals them
        out without shuffling, which gives the result of a single process. If they are split in another way, ``index``
        is the position in the whole set.
        """
        result = self(opacity, view, index=view_position(self._updates) if index is None else index)
        self._sums = self._sums + row_of(result)  # not in place: it may be a tensor of inference mode
        self._updates += 1
        return result

    def compute(self) -> CASummary:
        """Return the mean over the views counted so far, on all ranks if torch.distributed is initialized.

        Views without visible pixels are left out. On several ranks every rank must call this.
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

    def _measure(self, x: Params, view: Any, index: int) -> CAResult:
        """Render a fixed number of times; a pixel is visible if every render covers it (the paper's protocol)."""
        settings = self.settings
        assert settings.samples is not None
        assert settings.ddof is not None
        moments, broken = RenderMoments(min(settings.samples, GROUPS)), False
        lowest = x.opacities.new_full((), math.inf)
        differ: list[Tensor] = []
        for image, alpha in self._renders(self._drawn(x, index, settings.samples, differ), view):
            lowest = torch.minimum(lowest.to(alpha), alpha)
            image, odd = finite_colors(image, alpha, lowest, settings.threshold)
            broken |= odd
            moments.add(image)
        visible = lowest > settings.threshold
        variance = moments.variance(settings.ddof)
        value, reason = visible_mean(variance, visible, broken, moments.count / (moments.count - settings.ddof))
        std_error = math.nan
        if reason is Reason.OK:
            # For a given visible region this factor relates the unbiased variance to this one, and so their errors.
            std_error = moments.jackknife_error(visible) * (moments.count - 1) / (moments.count - settings.ddof)
            reason = effect_of(value, differ)
        return self._result(value, std_error, variance, visible, reason, moments.count)

    def _alpha_factor(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the regularizer's ``alpha_factor``, or raise if it has none."""
        factor = self._measured.alpha_factor(x._replace(opacities=x.opacities.reshape(-1)))
        if factor is None:
            raise ValueError(
                f"the draws of {type(self.regularizer).__name__} are no independent factors of the opacities, which an "
                "exact or adaptive score needs: sample with CAScore(render_fn)."
            )
        return factor

    def _drawn(self, x: Params, index: int, count: int, differ: list[Tensor]) -> Iterator[Tensor]:
        """Yield the opacities of one view under ``count`` random draws, each a new tensor.

        For every draw but the first, ``differ`` receives whether it differs from the first: a tensor, not read here.
        """
        # One generator per view: more renders extend the sequence, other views do not shift it.
        generator = PortableGenerator(self.seed, index)
        flat, first = x._replace(opacities=x.opacities.reshape(-1)), None
        for _ in range(count):
            drawn, *others = self._measured.replay(flat, self._measured.draw(flat, generator))
            if any(a is not b for a, b in zip(others, flat[1:], strict=True)):
                raise ValueError(
                    f"{type(self.regularizer).__name__} changes other parameters than opacities, which are all that "
                    "render_fn is given: remove the members that change others from the score's regularizer."
                )
            if first is None:
                first = drawn.clone()  # the callable may edit its opacities
            else:
                differ.append((drawn != first).any())
            yield (drawn.clone() if drawn is flat.opacities else drawn).view_as(x.opacities)

    def _renders(self, drawn: Iterator[Tensor], view: Any) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield colors and alpha for each draw of the opacities, several per call if the renderer can."""
        render_batch = getattr(self.render_fn, "render_batch", None)
        if render_batch is None or self.alpha_fn is not None:
            yield from (self._render(opacity, view) for opacity in drawn)
        else:
            while some := list(itertools.islice(drawn, BATCH)):
                answers = list(zip(*render_batch(torch.stack(some), view), strict=True))
                if len(answers) != len(some):
                    raise ValueError(
                        f"render_batch must return an image and an alpha for each of the {len(some)} sets of "
                        f"opacities, got {len(answers)}."
                    )
                yield from map(self._read, answers)

    def _render(self, opacity: Tensor, view: Any) -> tuple[Tensor, Tensor]:
        """Render colors (3, H, W) and alpha (H, W) with these opacities."""
        if self.alpha_fn is not None:
            # Copies: the second pass may overwrite the buffer of the first, and either may edit opacities in place.
            image = read_rendering(self.render_fn(opacity.clone(), view), layout=self.layout).image.clone()
            alpha = read_alpha_pass(self.alpha_fn(opacity, view), image, layout=self.layout)
            return image, alpha.to(image.device)
        return self._read(self.render_fn(opacity, view))

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


class _AdaptiveScore(CAScore):
    """See :meth:`CAScore.adaptive`."""

    def __init__(
        self, render_fn: RenderFn, target: float, most: int, alpha_fn: RenderFn | None, seed: int, **common: Any
    ) -> None:
        check_finite(target, "relative_error")
        if target <= 0:
            raise ValueError(f"relative_error must be above 0, got {target}; CAScore.exact has no error.")
        check_count(most, "max_samples", minimum=MIN_RENDERS)
        self._set_renderer(render_fn, alpha_fn, seed)
        self._set("adaptive", **common, ddof=1, seed=self.seed, relative_error=float(target), max_samples=int(most))

    def _measure(self, x: Params, view: Any, index: int) -> CAResult:
        """Render until the error is small enough.

        The region must not come from the sampled renders: pixels that all of them happen to cover tend to vary little.
        """
        settings = self.settings
        assert settings.max_samples is not None
        assert settings.relative_error is not None
        mean, multiplier = self._alpha_factor(x)
        expected, alpha = self._render((mean.opacities * multiplier.mean).view_as(x.opacities), view)
        visible = alpha > settings.threshold
        expected, broken = finite_colors(expected, alpha, visible, 0)
        moments, deviations = RenderMoments(), Deviations(expected, visible)
        del expected, alpha  # may be buffers of the renderer, which the next render overwrites
        result, differ = None, list[Tensor]()
        renders = self._renders(self._drawn(x, index, settings.max_samples, differ), view)
        for k, (image, alpha) in enumerate(renders, start=1):
            image, odd = finite_colors(image, alpha, visible, 0)
            broken |= odd
            moments.add(image)
            deviations.add(image)
            if k == settings.max_samples or (k >= MIN_RENDERS and k % BATCH == 0):
                variance = moments.variance(ddof=1)
                value, reason = visible_mean(variance, visible, broken, k / (k - 1))
                if reason is Reason.OK and k == settings.max_samples:
                    reason = effect_of(value, differ)
                if value == 0:  # no render differed, which is certain only if nothing is dropped
                    error = 0.0 if settings.drop_rate == 0 else math.nan
                else:
                    error = deviations.std_error() if math.isfinite(value) else math.nan
                result = self._result(value, error, variance, visible, reason, k)
                if reason is not Reason.OK or error <= settings.relative_error * value:
                    break
        assert result is not None
        return result


class ExactView(NamedTuple):
    """An exact score and the inputs of its moments, to render them again; the background in the callable's layout."""

    result: CAResult
    opacity: Tensor
    multiplier: Multiplier
    background: Tensor | None


class ExactScore(CAScore):
    """See :meth:`CAScore.exact`."""

    def __init__(self, moments_fn: MomentsFn, neutral: bool, **common: Any) -> None:
        check_callable(moments_fn, "moments_fn", "opacity, view, multiplier, background")
        self._set("exact_neutral" if neutral else "exact", **common)
        self.moments_fn = moments_fn

    def _measure(self, x: Params, view: Any, index: int) -> CAResult:
        return self._exact(x, view).result

    @torch.no_grad()
    def measure(self, given: Tensor | Params, view: Any) -> ExactView:
        """Measure one view, and return the inputs of its moments as well, with which they can be rendered again."""
        return self._exact(self._params(given), view)

    def _exact(self, x: Params, view: Any) -> ExactView:
        settings = self.settings
        rendered, multiplier = self._alpha_factor(x)
        opacity = rendered.opacities.view_as(x.opacities)

        def moments(background: Tensor | None) -> tuple[ExactMoments, Tensor]:
            # A copy: the callable may edit its opacities in place.
            read = read_moments(self.moments_fn(opacity.clone(), view, multiplier, background), layout=self.layout)
            if read.alpha_mean is None:
                raise TypeError("a score needs alpha_mean, the expected accumulated alpha, for its visible region.")
            return read, read.alpha_mean.to(read.variance.device)

        broken, background = False, None
        if settings.method == "exact_neutral":
            # Over black the mean is sum w c and the expected alpha sum w: their ratio is the neutral background.
            over_black, total = moments(opacity.new_zeros(3))
            black, broken = finite_colors(over_black.mean, total, total, 0)
            neutral = (black / torch.where(total > 0, total, 1.0)).nan_to_num(0.0, 0.0, 0.0)
            background = neutral if self.layout == "CHW" else neutral.permute(1, 2, 0)
        image, alpha = moments(background)
        variance, visible, value, reason = exact_mean(image, alpha, settings.threshold, broken)
        std_error = 0.0 if reason is Reason.OK else math.nan
        result = self._result(value, std_error, variance, visible, reason, None)
        return ExactView(result, opacity, multiplier, background)
