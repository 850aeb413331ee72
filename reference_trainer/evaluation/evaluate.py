"""Measure a model on the views of a scene: image quality, co-adaptation, colour variance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from reference_trainer.evaluation.metrics import psnr, ssim
from reference_trainer.evaluation.model import Model
from reference_trainer.evaluation.pictures import error_map, heat_map, save_png, side_by_side
from reference_trainer.render.statistics import color_variance_map
from reference_trainer.scenes.scene import Scene

__all__ = ["Evaluation", "PerceptualMetric", "ViewScores", "evaluate"]

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
        """Return the mean of a quantity over the views of a split that have it; nan if none has."""
        values = [getattr(view, quantity) for view in self.views if view.split == split]
        finite = [value for value in values if math.isfinite(value)]
        return sum(finite) / len(finite) if finite else math.nan

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


@torch.no_grad()
def evaluate(
    model: Model,
    scene: Scene,
    *,
    samples: int = 5,
    seed: int = 0,
    perceptual: PerceptualMetric | None = None,
    pictures: Path | None = None,
    progress: Callable[[str], None] | None = None,
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
        progress: called with the name of each view before it is measured.

    Returns:
        Scores per view and their means.
    """
    views: list[ViewScores] = []
    opacities = model.gaussians.opacities
    score = model.ca_score(samples=samples, seed=seed)
    half = model.ca_score(samples=samples, seed=seed, drop_rate=0.5)
    exact = model.exact_ca_score()
    for split, members in (("train", scene.train), ("test", scene.test)):
        for index, view in enumerate(member.to(opacities.device) for member in members):
            if progress is not None:
                progress(f"{split} {view.name}")
            out = model.rendering(model.test_opacities, view)
            image = out.image.clamp(0, 1)
            ca = score(opacities, view, index=index)
            ca_half = ca if score.settings.drop_rate == 0.5 else half(opacities, view, index=index)
            variance, covered = color_variance_map(out.splats)
            views.append(
                ViewScores(
                    name=view.name,
                    split=split,
                    psnr=psnr(image, view.image),
                    ssim=ssim(image, view.image),
                    lpips=math.nan if perceptual is None else perceptual(image, view.image),
                    ca=ca.value,
                    ca_std_error=ca.std_error,
                    ca_half=ca_half.value,
                    ca_exact=exact(opacities, view).value,
                    visible=ca.visible.double().mean().item(),
                    cv=variance[covered].double().mean().item() if bool(covered.any()) else math.nan,
                )
            )
            if pictures is not None:
                stem = pictures / split / Path(view.name).stem
                ca_map = heat_map(ca.variance.masked_fill(~ca.visible, math.nan).float(), CA_PICTURE_RANGE)
                panels = [view.image, image, error_map(image, view.image), ca_map]
                labels = ["photograph", f"render {views[-1].psnr:.2f} dB", "error", f"CA {ca.value * 1e3:.2f}e-3"]
                save_png(stem.with_name(stem.name + ".png"), image)
                save_png(stem.with_name(stem.name + "_panel.png"), side_by_side(panels, labels))
    return Evaluation(views, len(model.gaussians), None if perceptual is None else perceptual.name)
