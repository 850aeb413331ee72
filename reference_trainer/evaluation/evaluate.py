"""Measure a model on the views of a scene: image quality, co-adaptation, colour variance."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from ca_reg import CAScore
from reference_trainer.evaluation.kept import KeptRecords
from reference_trainer.evaluation.metrics import psnr, ssim
from reference_trainer.evaluation.pictures import PANEL, error_map, file_names, heat_map, save_png, side_by_side
from reference_trainer.evaluation.results import machine
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render.statistics import color_variance_map
from reference_trainer.scenes.scene import Scene, View

__all__ = ["Evaluation", "PerceptualMetric", "ViewScores", "evaluate", "mean_over"]

CA_PICTURE_RANGE = 0.02
"""Variance that gets the brightest colour in CA heat maps."""


class PerceptualMetric(Protocol):
    """A perceptual distance between two images (3, H, W) in [0, 1]."""

    name: str

    def __call__(self, image: Tensor, target: Tensor) -> float:
        """Return the distance."""


@dataclass(frozen=True)
class ViewScores:
    """What was measured at one view; nan where a quantity does not exist."""

    name: str
    split: str
    psnr: float
    ssim: float
    lpips: float
    ca: float
    ca_std_error: float
    ca_half: float
    ca_exact: float
    visible: float
    cv: float


@dataclass(frozen=True)
class Evaluation:
    """Scores of all views and their means.

    ``ca`` is the paper's protocol; ``ca_half`` the same at a drop rate of 0.5 for every model, which compares models of
    different dropout rates on equal terms; ``ca_exact`` the limit for infinitely many samples, at the drop rate of
    ``ca`` and over the pixels whose expected alpha is above 0.8; ``visible`` the share of pixels that ``ca`` covers.
    """

    views: list[ViewScores]
    gaussians: int
    perceptual_metric: str | None

    def mean(self, split: str, quantity: str) -> float:
        """Return the mean of a quantity over the views of a split that have it, see `mean_over`; nan if none has."""
        return mean_over([view for view in self.views if view.split == split], quantity)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data, for JSON."""
        quantities = [name for name in ViewScores.__dataclass_fields__ if name not in ("name", "split")]
        splits = sorted({view.split for view in self.views})
        return {
            "gaussians": self.gaussians,
            "perceptual_metric": self.perceptual_metric,
            "mean": {split: {name: self.mean(split, name) for name in quantities} for split in splits},
            "views": [asdict(view) for view in self.views],
        }


def mean_over(views: Sequence[Any], quantity: str) -> float:
    """Return the mean of a quantity over the views that have it; nan if none has.

    Of ``ca_std_error`` it is the standard error of the mean of ``ca``: the masks of a view are drawn from the seed and
    its position alone, independently of those of the others, so the squares of the errors add up. nan if a view that
    has a score has no error, as with two samples.

    Args:
        views: objects with the quantity as an attribute, and ``ca``, all of one split.
        quantity: its name.
    """
    if quantity == "ca_std_error":
        errors = [view.ca_std_error for view in views if math.isfinite(view.ca)]
        return math.hypot(*errors) / len(errors) if errors else math.nan
    finite = [value for view in views if math.isfinite(value := getattr(view, quantity))]
    return sum(finite) / len(finite) if finite else math.nan


@torch.no_grad()
def evaluate(
    model: TrainedModel,
    scene: Scene,
    *,
    samples: int = 5,
    seed: int = 0,
    perceptual: PerceptualMetric | None = None,
    pictures: Path | None = None,
    keep: Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Evaluation:
    """Measure a model on the training and test views of a scene.

    Images are compared as floats clamped to [0, 1], without a detour over 8 bits.

    Args:
        model: what to measure.
        scene: with views on the model's device.
        samples: K of the CA score.
        seed: of the CA score's masks.
        perceptual: a perceptual metric, or None to leave it out.
        pictures: a folder for one PNG per view: photograph, render, error, CA map; None for no pictures.
        keep: a file for the scores of the views that are done, see `KeptRecords`: an interrupted evaluation continues
            with the next view. The caller removes it when the result is written.
        progress: receives the number and the name of each view before it is measured, and the time left.

    Returns:
        Scores per view and their means.
    """
    score = model.ca_score(samples=samples, seed=seed)
    half = model.ca_score(samples=samples, seed=seed, drop_rate=0.5)
    members = [(split, *each) for split in ("train", "test") for each in enumerate(getattr(scene, split))]
    names = [name for views in (scene.train, scene.test) for name in file_names([view.name for view in views])]
    device = model.background.device
    metric = perceptual and [_identity(perceptual, view.image.to(device)) for _, _, view in members[:1]]
    depends_on = (model, scene.train, scene.test, samples, seed, metric, machine())
    kept = KeptRecords(keep, depends_on, progress)
    views: list[ViewScores] = []
    start, measured = time.perf_counter(), 0
    for number, (split, index, view) in enumerate(members):
        folder = None if pictures is None else pictures / split
        files = [] if folder is None else [folder / f"{names[number]}{end}.png" for end in ("", PANEL)]
        known = kept.get(f"{split} {index}", files)
        if known is not None:
            views.append(ViewScores(**known))
            continue
        seconds = (time.perf_counter() - start) / measured * (len(members) - number) if measured else None
        left = "" if seconds is None else f", about {seconds:.0f} s left"
        progress(f"[{number + 1}/{len(members)}] {split} {view.name}{left}")
        views.append(_measure(model, view, split, index, score, half, perceptual, files))
        kept.add(f"{split} {index}", asdict(views[-1]))
        measured += 1
    return Evaluation(views, len(model.gaussians), None if perceptual is None else perceptual.name)


def _measure(
    model: TrainedModel,
    photograph: View,
    split: str,
    index: int,
    score: CAScore,
    half: CAScore,
    perceptual: PerceptualMetric | None,
    files: Sequence[Path],
) -> ViewScores:
    """Measure one view, and write its picture and its panel if there are files for them."""
    opacities = model.gaussians.opacities
    view = photograph.to(opacities.device)
    out = model.rendering(model.test_opacities, view)
    image = out.image.clamp(0, 1)
    ca = score(opacities, view, index=index)
    ca_half = ca if score.settings.drop_rate == 0.5 else half(opacities, view, index=index)
    variance, covered = color_variance_map(out.splats)
    scores = ViewScores(
        name=view.name,
        split=split,
        psnr=psnr(image, view.image),
        ssim=ssim(image, view.image),
        lpips=math.nan if perceptual is None else perceptual(image, view.image),
        ca=ca.value,
        ca_std_error=ca.std_error,
        ca_half=ca_half.value,
        ca_exact=model.exact_ca_score()(opacities, view).value,
        visible=ca.visible.double().mean().item(),
        cv=variance[covered].double().mean().item() if bool(covered.any()) else math.nan,
    )
    if files:
        ca_map = heat_map(ca.variance.masked_fill(~ca.visible, math.nan).float(), CA_PICTURE_RANGE)
        panels = [view.image, image, error_map(image, view.image), ca_map]
        labels = ["photograph", f"render {scores.psnr:.2f} dB", "error", f"CA {ca.value * 1e3:.2f}e-3"]
        save_png(files[0], image)
        save_png(files[1], side_by_side(panels, labels))
    return scores


def _identity(perceptual: PerceptualMetric, image: Tensor) -> tuple[str, float]:
    """Return what tells a metric from others: its name, and what it says of a photograph, as weights may differ."""
    return perceptual.name, float(perceptual(image, image.flip(2)))
