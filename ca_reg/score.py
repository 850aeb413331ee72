"""The Co-Adaptation Score: how much a view changes when random Gaussians are left out."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from ca_reg._accumulate import RenderMoments, jackknife_error, merge
from ca_reg._check import check_count, check_finite, check_opacity, check_opacity_range, check_rate
from ca_reg.functional import apply_dropout, draw_keep_mask
from ca_reg.reason import Reason
from ca_reg.result import CAResult, CASettings, CASummary, ViewTally
from ca_reg.types import Layout, RenderFn, Rendering, check_layout, read_alpha_pass, read_rendering

__all__ = ["CAScore"]

# The renders are pooled in at most this many groups, which bounds the memory; with fewer groups the standard error
# would be known less well (relative error about 1/sqrt(2 (groups - 1)), here 27 %).
_GROUPS = 8


class CAScore:
    """Measure co-adaptation with any renderer, by Monte Carlo over masks (paper, "Quantifying Co-Adaptation").

    One view is rendered ``samples`` times, each time without a random subset of the Gaussians. The score is the
    variance of these renders, per pixel and channel, averaged over RGB and over the pixels whose accumulated alpha
    exceeds ``threshold`` in every render. The defaults are the protocol of the authors' released code: 5 renders, drop
    rate ``1 - (1 - p)/2``, alpha above 0.8, population variance, opacities not scaled and without noise, colours not
    clamped.

    Read the numbers with their error. At 5 samples a single pixel's variance is known to about 70 %; the mean over an
    image is better, and ``std_error`` says by how much: a delete-a-group jackknife over the renders with the visible
    region held fixed. It errs on the large side when samples are few (by some 15 % at 5 samples, 50 % at 3), and needs
    at least three.

    The memory does not grow with ``samples``: renders are pooled in at most 8 groups, each with one float64 image and
    two maps.

    Convention: ``opacity`` is activated, in [0, 1], (N,) or (N, 1), and neither scaled nor dropped; images are
    (3, H, W), or (H, W, 3) with ``layout="HWC"``. Regularizers inside the callable must be off.

    Args:
        render_fn: the renderer of the model, ``render_fn(opacity, view)``; see :class:`ca_reg.types.RenderFn`.
        samples: number of renders K, at least 2.
        p: dropout rate that the model was trained with, 0 if it was trained without (or with compensated) dropout.
        drop_rate: fraction of the Gaussians to drop in each render, in [0, 1); by default ``1 - (1 - p)/2``, that is
            half of those that training left.
        threshold: accumulated alpha above which a pixel is visible.
        ddof: the variance divides by ``samples - ddof``: 0 as in the released code, 1 for an unbiased estimate.
        layout: order of the axes of the images, ``"CHW"`` or ``"HWC"``.
        alpha_fn: for renderers that return no alpha: ``alpha_fn(opacity, view)`` renders the same view with all colours
            1 over a background of 0, or returns an alpha of its own. It is called once per render and so doubles the
            cost; if it is given, an alpha from ``render_fn`` is not used.
        seed: seed of the masks. They are drawn on the CPU from (seed, view index) alone: the same on every device, and
            adding a view does not change the masks of the others.

    Raises:
        TypeError: if an argument is of the wrong type.
        ValueError: if one is out of range.

    Example:
        A wall of ten layers of different grey; with a layer missing the next one shows through.

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

    higher_is_better = False

    def __init__(
        self,
        render_fn: RenderFn,
        *,
        samples: int = 5,
        p: float = 0.0,
        drop_rate: float | None = None,
        threshold: float = 0.8,
        ddof: int = 0,
        layout: Layout = "CHW",
        alpha_fn: RenderFn | None = None,
        seed: int = 0,
    ) -> None:
        for name, fn in (("render_fn", render_fn), ("alpha_fn", alpha_fn)):
            if fn is not None and not callable(fn):
                raise TypeError(f"{name} must be callable as {name}(opacity, view), got {type(fn).__name__}.")
        check_count(samples, "samples", minimum=2)
        check_rate(p)
        drop_rate = 1.0 - (1.0 - p) / 2.0 if drop_rate is None else drop_rate
        check_rate(drop_rate, "drop_rate")
        check_finite(threshold, "threshold")
        check_count(ddof, "ddof", minimum=0)
        if ddof >= samples:
            raise ValueError(f"ddof must be below samples, got ddof {ddof} and {samples} samples.")
        check_layout(layout)
        check_count(seed, "seed", minimum=0)
        self.render_fn = render_fn
        self.alpha_fn = alpha_fn
        self.layout: Layout = layout
        self.p = p
        self.settings = CASettings(
            samples=int(samples), drop_rate=drop_rate, threshold=threshold, ddof=int(ddof), seed=int(seed)
        )
        self.reset()

    def __call__(self, opacity: Tensor, view: Any, *, index: int = 0) -> CAResult:
        """Measure one view, and forget it.

        Args:
            opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
            view: passed on to the callables as it is.
            index: position of the view among all views, at least 0; it decides the masks together with the seed.

        Returns:
            The score with its maps. Without visible pixels the value is nan and ``reason`` says so.

        Raises:
            TypeError: if ``opacity`` or a render is not of the right type.
            ValueError: if a shape is wrong, ``opacity`` looks like logits, or no alpha can be had.
        """
        check_opacity(opacity)
        check_opacity_range(opacity)
        check_count(index, "index", minimum=0)
        settings = self.settings
        generator = torch.Generator()
        entropy = np.random.SeedSequence([settings.seed, index]).generate_state(1, np.uint64)
        generator.manual_seed(int(entropy[0] >> np.uint64(1)))
        groups = [RenderMoments() for _ in range(min(settings.samples, _GROUPS))]
        with torch.no_grad():
            opacity = opacity.detach()
            for k in range(settings.samples):
                keep = draw_keep_mask(opacity.shape[0], settings.drop_rate, generator=generator, device=opacity.device)
                image, alpha = self._render(apply_dropout(opacity, keep), view)
                groups[k % len(groups)].add(image, alpha > settings.threshold)
            return self._result(groups)

    def update(self, opacity: Tensor, view: Any, *, index: int | None = None) -> CAResult:
        """Measure one view and count it in the mean that :meth:`compute` returns.

        Args:
            opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
            view: passed on to the callables as it is.
            index: position of the view among all views; by default the number of updates since the last reset. When
                the views are split over ranks, give the position in the whole set, so that every view gets masks of
                its own and the result does not depend on the number of ranks.

        Returns:
            The result of this view.

        Raises:
            TypeError: as for a call of the score.
            ValueError: as for a call of the score.
        """
        result = self(opacity, view, index=self._updates if index is None else index)
        self._tally.add(result)
        self._updates += 1
        return result

    def compute(self) -> CASummary:
        """Return the mean over the views counted so far; over those of all ranks if torch.distributed is initialised.

        Views without visible pixels have no share in the mean; ``empty_views`` counts them. The standard error is that
        of the mean over the masks, the views held fixed. On several ranks every rank must call this.
        """
        tally = ViewTally()
        tally.sums = self._tally.sums.clone()
        if dist.is_available() and dist.is_initialized():
            on_gpu = dist.get_backend() == "nccl"
            sums = tally.sums.to(torch.device("cuda", torch.cuda.current_device()) if on_gpu else "cpu")
            dist.all_reduce(sums)
            tally.sums = sums.cpu()
        return tally.summary(self.settings)

    def reset(self) -> None:
        """Forget all views."""
        self._tally = ViewTally()
        self._updates = 0

    def _render(self, opacity: Tensor, view: Any) -> tuple[Tensor, Tensor]:
        """Render colours (3, H, W) and alpha (H, W) with masked opacities."""
        rendering: Rendering = read_rendering(self.render_fn(opacity, view), layout=self.layout)
        if self.alpha_fn is not None:
            alpha = read_alpha_pass(self.alpha_fn(opacity, view), rendering.image, layout=self.layout)
        elif rendering.alpha is not None:
            alpha = rendering.alpha
        else:
            raise ValueError(
                "render_fn returned an image without an alpha, which the visible region needs. Do one of three: return "
                "(image, alpha); return a mapping or object with an alpha named alpha, rendered_alpha or accumulation; "
                "or give CAScore an alpha_fn(opacity, view) that renders all colours 1 on a background of 0."
            )
        return rendering.image, alpha.to(rendering.image.device)

    def _result(self, groups: list[RenderMoments]) -> CAResult:
        """Reduce the moments to the score."""
        settings = self.settings
        total = merge(groups)
        variance = total.scatter / (settings.samples - settings.ddof)
        value = std_error = math.nan
        if not bool(total.visible.any()):
            reason = Reason.EMPTY
        else:
            mean = float(variance[total.visible].mean())
            reason = Reason.OK if math.isfinite(mean) else Reason.NOT_FINITE
            if reason is Reason.OK:
                value = mean
                # For a given visible region the two variances differ by this factor exactly, and so do their errors.
                std_error = jackknife_error(groups, total) * (settings.samples - 1) / (settings.samples - settings.ddof)
        return CAResult(
            value=value,
            std_error=std_error,
            variance=variance,
            visible=total.visible,
            reason=reason,
            **asdict(settings),
        )
