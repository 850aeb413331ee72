"""Measure a model at views: image quality where there is a photograph, co-adaptation and color variance anywhere."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAResult, CAScore, attribute
from ca_reg.error_maps import ErrorMap
from reference_trainer.evaluation.error_maps import ErrorMaps, error_map
from reference_trainer.evaluation.lpips import LPIPS
from reference_trainer.evaluation.metrics import (
    DepthErrors,
    color_variance_map,
    counted,
    depth_errors,
    on_white,
    psnr,
    ssim,
)
from reference_trainer.evaluation.pictures import PANEL, file_names, heat_map, save_png, side_by_side
from reference_trainer.evaluation.results import ResultStore, machine
from reference_trainer.evaluation.trained_model import MaskedRenders, TrainedModel
from reference_trainer.scenes.scene import View, Viewpoint

__all__ = [
    "Evaluation", "ViewScores", "ca_picture", "error_picture", "evaluate", "expected_error_picture",
    "training_snapshot",
]  # fmt: skip

_log = logging.getLogger(__name__)

CA_PICTURE_RANGE = 0.02
"""Variance that maps to the brightest color of CA heat maps."""
ERROR_PICTURE_RANGE = 0.25
"""Absolute error, averaged over channels, that maps to the brightest color."""


_EXPECTED = "psnr_expected", "psnr_low", "psnr_high"


@dataclass(frozen=True)
class ViewScores:
    """What was measured at one view; nan where a quantity does not exist, such as ``psnr`` without a photograph.

    ``ca`` follows the paper's protocol; ``ca_half`` does so at drop rate 0.5 for every model, which compares models of
    different dropout rates on equal terms. ``ca_exact`` is the limit for infinitely many samples, at the drop rate of
    ``ca`` and over the pixels whose expected alpha is above 0.8; ``ca_exact_half`` the same at drop rate 0.5;
    ``ca_neutral`` is ``ca_exact`` with every pixel composited on its own expected color, so that the background does
    not count. ``visible`` is the share of pixels that ``ca`` covers, ``covered`` the mean alpha of the test-time image.
    ``depth_abs_rel`` to ``depth_log10`` are the `DepthErrors` of the test-time image where the true depth is known.
    ``ca_reason`` is the name of the `Reason` why ``ca`` has its value, or is nan. ``psnr_expected`` is what an
    `ErrorMap` expects without the photograph, of views that the model was not trained on, and in 80 % of the cases the
    PSNR is between ``psnr_low`` and ``psnr_high``.
    """

    name: str
    split: str
    psnr: float
    ssim: float
    lpips: float
    ca: float
    ca_std_error: float
    ca_half: float
    ca_exact: float
    ca_exact_half: float
    ca_neutral: float
    visible: float
    covered: float
    cv: float
    depth_abs_rel: float = math.nan
    depth_rmse: float = math.nan
    depth_mae: float = math.nan
    depth_log10: float = math.nan
    ca_reason: str = ""
    psnr_expected: float = math.nan
    psnr_low: float = math.nan
    psnr_high: float = math.nan


@dataclass(frozen=True)
class Evaluation:
    """Scores of all views, of one or more splits, and their means."""

    views: list[ViewScores]
    gaussians: int
    perceptual_metric: str | None = None

    def mean(self, split: str, quantity: str) -> float:
        """Return the mean of a quantity over the views of a split that have it; nan if none has.

        For ``ca_std_error`` it is the standard error of the mean of ``ca``: masks are drawn independently for every
        view, from the seed and its position, so the squared errors add up. nan if a view has a score without an error,
        as with two samples.
        """
        views = [view for view in self.views if view.split == split]
        if quantity == "ca_std_error":
            errors = [view.ca_std_error for view in views if math.isfinite(view.ca)]
            return math.hypot(*errors) / len(errors) if errors else math.nan
        finite = [value for view in views if math.isfinite(value := getattr(view, quantity))]
        return sum(finite) / len(finite) if finite else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data, for JSON."""
        quantities = [name for name in ViewScores.__dataclass_fields__ if name not in ("name", "split", "ca_reason")]
        splits = dict.fromkeys(view.split for view in self.views)
        return {
            "gaussians": self.gaussians,
            "perceptual_metric": self.perceptual_metric,
            "mean": {split: {name: self.mean(split, name) for name in quantities} for split in splits},
            "views": [asdict(view) for view in self.views],
        }


@torch.no_grad()
def evaluate(
    model: TrainedModel,
    views: Mapping[str, Sequence[Viewpoint]],
    *,
    samples: int = 5,
    seed: int = 0,
    perceptual: LPIPS | None = None,
    pictures: Path | None = None,
    partial: Path | None = None,
    on_view: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Measure a model at views, with their photographs or without.

    Images are compared as floats clamped to [0, 1], not rounded to 8 bits. If a view has a mask, PSNR counts the pixels
    inside it, and SSIM and LPIPS see white outside (the DTU protocol); a mask that leaves no pixel leaves no quality.

    Args:
        model: what to measure.
        views: by split, such as those of `measured_views`; the photographs of "train" are those of the error maps.
        samples: K of the CA score.
        seed: of the CA score's masks.
        perceptual: a perceptual metric, or None to leave it out.
        pictures: folder for two PNG files per view, ``<split>/<view>``: the render, and a panel of photograph, render,
            error, expected error and exact CA map, or without a photograph of the render, the expected error and the
            maps of all scores; None for none.
        partial: file for the scores of finished views, see `ResultStore`: an interrupted evaluation continues with the
            next view. The caller removes it once the result is written.
        on_view: called before each view is measured.

    Returns:
        Scores per view and their means.
    """
    renders = MaskedRenders(model)
    scores = (
        model.ca_score(samples=samples, seed=seed, render_fn=renders),
        model.ca_score(samples=samples, seed=seed, render_fn=renders, drop_rate=0.5),
        model.exact_ca_score(),
        model.exact_ca_score(drop_rate=0.5),
        model.exact_ca_score(neutral=True),
    )
    own = [view for view in views.get("train", ()) if isinstance(view, View)]
    errors = ErrorMaps(model, own) if {*views} - {"train"} else None
    members = [(split, *each) for split, group in views.items() for each in enumerate(group)]
    names = [name for group in views.values() for name in file_names([view.name for view in group])]
    photographs = (view.image.to(model.background.device) for _, _, view in members if isinstance(view, View))
    # Weights may differ under one name: the metric of a photograph and its mirror image tells them apart.
    metric = perceptual and [perceptual.name, *(float(perceptual(x, x.flip(2))) for x in islice(photographs, 1))]
    store = ResultStore(partial, (model, views, samples, seed, metric, machine(model.background.device)))
    done: list[ViewScores] = []
    start, measured = time.perf_counter(), 0
    for number, (split, index, view) in enumerate(members):
        files = [] if pictures is None else [pictures / split / f"{names[number]}{end}.png" for end in ("", PANEL)]
        known = store.get(f"{split} {index}", files)
        if known is not None:
            done.append(ViewScores(**known))
            continue
        seconds = (time.perf_counter() - start) / measured * (len(members) - number) if measured else None
        left = "" if seconds is None else f", about {seconds:.0f} s left"
        _log.info("[%d/%d] %s %s%s", number + 1, len(members), split, view.name, left)
        on_view()
        done.append(_measure(model, view.to(model.background.device), split, index, scores, errors, perceptual, files))
        store.add(f"{split} {index}", asdict(done[-1]))
        measured += 1
    return Evaluation(done, len(model.gaussians), None if perceptual is None else perceptual.name)


def _measure(
    model: TrainedModel,
    view: Viewpoint,
    split: str,
    index: int,
    scores: Sequence[CAScore],
    errors: ErrorMaps | None,
    perceptual: LPIPS | None,
    files: Sequence[Path],
) -> ViewScores:
    """Measure one view, and write its render and its panel if ``files`` names them."""
    opacities = model.gaussians.opacities
    truth = view.depth if isinstance(view, View) else None
    out = model.test_rendering(view, depth=truth is not None)
    image, photograph = out.image.clamp(0, 1), view.image if isinstance(view, View) else None
    quality, depth = (math.nan,) * 3, DepthErrors()
    if truth is not None and out.depth is not None:
        depth = depth_errors(out.depth / out.alpha.clamp_min(1e-6), truth)
    if isinstance(view, View) and counted(view.image, view.mask).numel():
        pair = on_white(image, view.mask), on_white(view.image, view.mask)
        quality = psnr(image, view.image, view.mask), ssim(*pair), math.nan if perceptual is None else perceptual(*pair)
    found: dict[Any, CAResult] = {}
    for score in scores:  # some coincide for models trained without dropout, whose drop rate is 1/2 anyway
        if score.settings not in found:
            found[score.settings] = score(opacities, view, index=index)
    ca, half, exact, exact_half, neutral = (found[score.settings] for score in scores)
    variance, covered = color_variance_map(out.splats)
    mask = view.mask if isinstance(view, View) else None
    expected = errors(view, mask) if errors is not None and split != "train" else None
    measured = ViewScores(
        name=view.name,
        split=split,
        psnr=quality[0],
        ssim=quality[1],
        lpips=quality[2],
        ca=ca.value,
        ca_std_error=ca.std_error,
        ca_half=half.value,
        ca_exact=exact.value,
        ca_exact_half=exact_half.value,
        ca_neutral=neutral.value,
        visible=ca.visible.double().mean().item(),
        covered=out.alpha.double().mean().item(),
        cv=variance[covered].double().mean().item() if bool(covered.any()) else math.nan,
        **{f"depth_{name}": error for name, error in depth._asdict().items()},
        ca_reason=ca.reason.name,
        **{} if expected is None else dict(zip(_EXPECTED, (expected.psnr, *expected.interval), strict=True)),
    )
    if files:
        bar, found = ("0", f"{ERROR_PICTURE_RANGE:g}"), {"exact CA": exact_half}
        guessed = {}
        if expected is not None:
            guessed = {_titled("expected error", expected.psnr, "{:.1f} dB"): (expected_error_picture(expected), bar)}
        title = _titled("render", measured.psnr, "{:.2f} dB")
        panels: dict[str, tuple[Tensor, tuple[str, str] | None]] = {title: (image, None)}
        if photograph is None:
            if scores[2].settings != scores[3].settings:
                found[f"exact CA{_at(exact)}"] = exact
            found |= {f"CA, {ca.samples} renders{_at(ca)}": ca, f"neutral CA{_at(neutral)}": neutral}
        else:
            panels = {"photograph": (photograph, None)} | panels | {"error": (error_picture(image, photograph), bar)}
        panels |= guessed | _maps(found)
        save_png(files[0], image)
        pictures, scales = zip(*panels.values(), strict=True)
        save_png(files[1], side_by_side(pictures, [*panels], scales=scales))
    return measured


@torch.no_grad()
def training_snapshot(model: TrainedModel, view: View) -> dict[str, Tensor]:
    """Return what is worth watching while a model trains: pictures of a view, and the shares of the exact score.

    Returns:
        ``"render"``, ``"error"``, ``"expected error"`` (by the model alone: the photographs would take four times
        as long as the rest) and ``"co-adaptation"``, (3, H, W), and ``"log10 of share"`` of the Gaussians that
        have a share; the last two at drop rate 1/2.
    """
    image = model.test_rendering(view).image.clamp(0, 1)
    score = model.exact_ca_score(drop_rate=0.5)
    shares, result = attribute(score, model.shares, model.gaussians.opacities, view)
    pictures = {"render": image, "error": error_picture(image, view.image), "co-adaptation": ca_picture(result)}
    pictures["expected error"] = expected_error_picture(error_map(model, view))
    return pictures | {"log10 of share": shares[shares > 0].log10()}


def _at(result: CAResult) -> str:
    """Return what a title says of a drop rate other than 1/2, that of the score for people."""
    return "" if result.drop_rate == 0.5 or result.drop_rate is None else f" at drop rate {result.drop_rate:g}"


def _titled(name: str, value: float, form: str) -> str:
    """Return the title of a picture with its value, if it has one."""
    return name if math.isnan(value) else f"{name} {form.format(value)}"


def _maps(results: Mapping[str, CAResult]) -> dict[str, tuple[Tensor, tuple[str, str] | None]]:
    """Return the maps of scores with the ends of their color bars, titled with name and value."""
    ends = "0", f"{CA_PICTURE_RANGE:g}"
    return {_titled(name, of.value * 1e3, "{:.2f}e-3"): (ca_picture(of), ends) for name, of in results.items()}


def ca_picture(result: CAResult) -> Tensor:
    """Return the variance of a score as a heat map (3, H, W), gray where a pixel does not count."""
    return heat_map(result.variance.masked_fill(~result.visible, math.nan).float(), CA_PICTURE_RANGE)


def error_picture(image: Tensor, photograph: Tensor) -> Tensor:
    """Return the absolute difference of two pictures (3, H, W), averaged over channels, as a heat map."""
    return heat_map((image - photograph).abs().mean(0), ERROR_PICTURE_RANGE)


def expected_error_picture(found: ErrorMap) -> Tensor:
    """Return an expected error as a heat map (3, H, W), in the colors of `error_picture`."""
    return heat_map(found.error, ERROR_PICTURE_RANGE)
