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
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.lpips import LPIPS
from reference_trainer.evaluation.metrics import color_variance_map, counted, depth_errors, on_white, psnr, ssim
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


@dataclass(frozen=True)
class ViewScores:
    """What was measured at one view; nan where a quantity does not exist, such as ``psnr`` without a photograph.

    The exact scores are limits for infinitely many samples, over the pixels whose expected alpha is above 0.8. Those at
    drop rate 1/2 compare models of different dropout rates on equal terms.
    """

    name: str
    split: str
    psnr: float
    ssim: float
    lpips: float
    ca: float  # of the paper's protocol
    ca_std_error: float
    ca_half: float  # the same at drop rate 1/2
    ca_exact: float  # at the drop rate of ``ca``
    ca_exact_half: float  # at drop rate 1/2
    ca_neutral: float  # ``ca_exact`` with every pixel on its own expected color, so that the background does not count
    visible: float  # share of pixels that ``ca`` covers
    covered: float  # mean alpha of the test-time image
    cv: float  # mean of `color_variance_map`
    depth_abs_rel: float = math.nan  # this and the next are the `DepthErrors` of the test-time image
    depth_rmse: float = math.nan
    depth_mae: float = math.nan
    depth_log10: float = math.nan
    ca_reason: str = ""  # name of the `Reason` why ``ca`` has its value, or is nan
    psnr_expected: float = math.nan  # by an `ErrorMap`, without the photograph, of views that were not trained on
    psnr_low: float = math.nan  # in 80 % of the cases the PSNR is between this
    psnr_high: float = math.nan  # and this


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
            error, expected error and exact CA map, or, where there is no photograph, of render, expected error and the
            maps of all scores; None for none.
        partial: file for the scores of finished views, see `ResultStore`: an interrupted evaluation continues with the
            next view. The caller removes it once the result is written.
        on_view: called before each view is measured.
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
    photograph = mask = truth = None
    if isinstance(view, View):
        photograph, mask, truth = view.as_taken(view.image), view.mask, view.depth
    out = model.test_rendering(view, depth=truth is not None)
    image = (view.as_taken(out.image) if isinstance(view, View) else out.image).clamp(0, 1)
    quality = dict.fromkeys(("psnr", "ssim", "lpips"), math.nan)
    if photograph is not None and counted(photograph, mask).numel():
        pair = on_white(image, mask), on_white(photograph, mask)
        quality |= {"psnr": psnr(image, photograph, mask), "ssim": ssim(*pair)}
        quality |= {} if perceptual is None else {"lpips": perceptual(*pair)}
    if truth is not None and out.depth is not None:
        errors_of_depth = depth_errors(out.depth / out.alpha.clamp_min(1e-6), truth)
        quality |= {f"depth_{name}": error for name, error in errors_of_depth._asdict().items()}
    expected = errors(view, mask) if errors is not None and split != "train" else None
    if expected is not None:
        low, high = expected.interval
        quality |= {"psnr_expected": expected.psnr, "psnr_low": low, "psnr_high": high}
    found: dict[Any, CAResult] = {}
    for score in scores:  # some coincide for models trained without dropout, whose drop rate is 1/2 anyway
        if score.settings not in found:
            found[score.settings] = score(model.gaussians.opacities, view, index=index)
    ca, half, exact, exact_half, neutral = (found[score.settings] for score in scores)
    variance, covered = color_variance_map(out.splats)
    measured = ViewScores(
        name=view.name,
        split=split,
        ca=ca.value,
        ca_std_error=ca.std_error,
        ca_half=half.value,
        ca_exact=exact.value,
        ca_exact_half=exact_half.value,
        ca_neutral=neutral.value,
        visible=ca.visible.double().mean().item(),
        covered=out.alpha.double().mean().item(),
        cv=variance[covered].double().mean().item() if bool(covered.any()) else math.nan,
        ca_reason=ca.reason.name,
        **quality,
    )
    if files:
        maps = {"exact CA": exact_half}
        of_errors, of_ca = (("0", f"{end:g}") for end in (ERROR_PICTURE_RANGE, CA_PICTURE_RANGE))
        panels: list[tuple[str, Tensor, tuple[str, str] | None]]  # title, picture, ends of its color bar
        panels = [(_titled("render", measured.psnr, "{:.2f} dB"), image, None)]
        if photograph is not None:
            panels.insert(0, ("photograph", photograph, None))
            panels.append(("error", error_picture(image, photograph), of_errors))
        else:
            if exact is not exact_half:
                maps[f"exact CA{_at(exact)}"] = exact
            maps |= {f"CA, {ca.samples} renders{_at(ca)}": ca, f"neutral CA{_at(neutral)}": neutral}
        if expected is not None:
            title = _titled("expected error", expected.psnr, "{:.1f} dB")
            panels.append((title, expected_error_picture(expected), of_errors))
        panels += [(_titled(name, x.value * 1e3, "{:.2f}e-3"), ca_picture(x), of_ca) for name, x in maps.items()]
        titles, images, scales = zip(*panels, strict=True)
        save_png(files[0], image)
        save_png(files[1], side_by_side(images, titles, scales=scales))
    return measured


@torch.no_grad()
def training_snapshot(model: TrainedModel, view: View) -> dict[str, Tensor]:
    """Return what is worth watching while a model trains: pictures of a view (3, H, W), and shares of the exact score.

    Co-adaptation and shares are at drop rate 1/2; Gaussians without a share are left out.
    """
    image = model.test_rendering(view).image.clamp(0, 1)
    score = model.exact_ca_score(drop_rate=0.5)
    shares, result = attribute(score, model.shares, model.gaussians.opacities, view)
    return {
        "render": image,
        "error": error_picture(image, view.image),
        "co-adaptation": ca_picture(result),
        # By the model alone: the photographs would take four times as long as the rest.
        "expected error": expected_error_picture(ErrorMaps(model)(view)),
        "log10 of share": shares[shares > 0].log10(),
    }


def _at(result: CAResult) -> str:
    """Return what a title says of a drop rate other than 1/2, that of the score for people."""
    return "" if result.drop_rate == 0.5 or result.drop_rate is None else f" at drop rate {result.drop_rate:g}"


def _titled(name: str, value: float, form: str) -> str:
    """Return the title of a picture with its value, if it has one."""
    return name if math.isnan(value) else f"{name} {form.format(value)}"


def ca_picture(result: CAResult) -> Tensor:
    """Return the variance of a score as a heat map (3, H, W), gray where a pixel does not count."""
    return heat_map(result.variance.masked_fill(~result.visible, math.nan).float(), CA_PICTURE_RANGE)


def error_picture(image: Tensor, photograph: Tensor) -> Tensor:
    """Return the absolute difference of two pictures (3, H, W), averaged over channels, as a heat map."""
    return heat_map((image - photograph).abs().mean(0), ERROR_PICTURE_RANGE)


def expected_error_picture(found: ErrorMap) -> Tensor:
    """Return an expected error as a heat map (3, H, W), in the colors of `error_picture`."""
    return heat_map(found.error, ERROR_PICTURE_RANGE)
