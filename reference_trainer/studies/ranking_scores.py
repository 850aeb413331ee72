"""Variants of the CA score at one model: the paper's protocol, its limits, and what lies between them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier
from ca_reg.types import read_moments
from reference_trainer.evaluation.kept import KeptRecords
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.results import machine, mean_std
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.runs.folder import CONFIG
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.runs.settings import read_run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.training.config import TrainConfig

__all__ = ["VARIANTS", "Ranking", "RunScores", "score_run", "score_view"]

VARIANTS = {
    "protocol": "the paper's protocol: 5 renders at drop rate 1 - (1 - p)/2, over the pixels that all of them cover",
    "protocol_half": "the same at drop rate 1/2 for every model",
    "repeat": "protocol_half with other masks",
    "unconditioned": "the renders of protocol_half over the region of exact_half",
    "exact": "variance at the protocol's drop rate, over the pixels of expected alpha above 0.8",
    "exact_half": "the same at drop rate 1/2 for every model",
    "limit_conditioned": "the variance of exact_half over the region of protocol_half",
    "weighted_half": "the variance of exact_half over all pixels, weighted by their expected alpha",
    "neutral_half": "exact_half composited over the expected colour instead of the background",
}
"""The scores that are compared, in the order of the tables."""

_HALF = 0.5
_IN_LABEL = ("views", "images", "downscale", "seed", "dropout", "compensate", "noise", "clip_noise")


@dataclass(frozen=True)
class RunScores:
    """What was measured on one run.

    Args:
        folder: the run.
        scene: name of the scene, with its resolution.
        strategy: what the training regularized with.
        training_views: number of photographs.
        seed: of the training.
        settings: all other settings of scene and training.
        gaussians: size of the model.
        views: for every view its name and the quantities of `score_view`.

    Example:
        >>> views = [{"name": "a", "exact": 0.5}, {"name": "b", "exact": math.nan}]
        >>> run = RunScores("runs/a", "fern", "baseline", 3, 0, {}, 1000, views)
        >>> run.mean("exact"), run.missing("exact")
        (0.5, 1)
    """

    folder: str
    scene: str
    strategy: str
    training_views: int
    seed: int
    settings: dict[str, Any]
    gaussians: int
    views: list[dict[str, Any]]

    def mean(self, quantity: str) -> float:
        """Return the mean over the views that have the quantity; nan if none has."""
        return mean_std(view[quantity] for view in self.views)[0]

    def missing(self, quantity: str) -> int:
        """Return how many views lack the quantity, because no pixel is visible."""
        return sum(not math.isfinite(view[quantity]) for view in self.views)


@dataclass(frozen=True)
class Ranking:
    """All runs of a ranking study, by scene and by `exact` within it.

    Args:
        split: ``"train"`` or ``"test"``: which views were measured.
        runs: the measurements.
    """

    split: str
    runs: tuple[RunScores, ...]

    def scenes(self) -> dict[str, list[RunScores]]:
        """Return the runs of each scene."""
        out: dict[str, list[RunScores]] = {}
        for run in self.runs:
            out.setdefault(run.scene, []).append(run)
        return out


@torch.no_grad()
def score_view(model: TrainedModel, view: View, *, index: int) -> dict[str, float]:
    """Measure all variants at one view.

    Args:
        model: what to measure.
        view: a view on the model's device.
        index: its position in its split, which decides the masks as it does in `evaluate`.

    Returns:
        PSNR of the test-time render, every variant by name, and under ``"visible NAME"`` the share of the pixels in
        the region of the variants that have one of their own; nan where the region of a variant is empty.
    """
    opacities = model.gaussians.opacities
    moments = read_moments(model.moments(opacities, view, Multiplier.dropout(_HALF)), layout="CHW")
    assert moments.alpha_mean is not None
    exact_half = CAScore(exact=lambda *_: moments, drop_rate=_HALF)(opacities, view)
    half = model.ca_score(drop_rate=_HALF)(opacities, view, index=index)
    repeat = model.ca_score(drop_rate=_HALF, seed=1)(opacities, view, index=index)
    neutral = model.exact_ca_score(drop_rate=_HALF, neutral=True)(opacities, view)
    if model.treatment.dropout > 0:
        protocol = model.ca_score()(opacities, view, index=index)
        exact = model.exact_ca_score()(opacities, view)
    else:
        protocol, exact = half, exact_half
    results = {
        "protocol": protocol,
        "protocol_half": half,
        "repeat": repeat,
        "exact": exact,
        "exact_half": exact_half,
        "neutral_half": neutral,
    }
    values = {name: result.value for name, result in results.items()}
    values["unconditioned"] = _average(half.variance, exact_half.visible)
    values["limit_conditioned"] = _average(exact_half.variance, half.visible)
    values["weighted_half"] = _average(exact_half.variance, moments.alpha_mean)
    image = model.rendering(model.test_opacities, view).image.clamp(0, 1)
    return {
        "psnr": psnr(image, view.image),
        **{name: values[name] for name in VARIANTS},
        **{
            f"visible {name}": result.visible.double().mean().item()
            for name, result in results.items()
            if result is not neutral  # the region of exact_half
        },
    }


def score_run(
    folder: Path,
    *,
    split: str,
    views: int | None = None,
    device: str = "cpu",
    keep: Path | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> RunScores:
    """Measure all variants on the views of a run.

    Args:
        folder: the run; its last checkpoint is measured.
        split: ``"train"`` or ``"test"``.
        views: measure only the first so many; None for all.
        device: where to render.
        keep: a file for the scores of the views that are done, see `KeptRecords`; the caller removes it when the
            result is written.
        say: receives the number and the name of each view before it is measured.

    Raises:
        ValueError: if the split has no view.
        FileNotFoundError: if the folder holds no run.
    """
    trainer = load_run(folder, device)
    members = (trainer.scene.train if split == "train" else trainer.scene.test)[:views]
    if not members:
        raise ValueError(f"{folder} has no {split} views to measure.")
    model = model_of(trainer)
    options, _ = read_run_settings(folder / CONFIG)
    config = trainer.config
    settings = dataclasses.asdict(options) | dataclasses.asdict(config)
    kept = KeptRecords(keep, (model, members, VARIANTS, machine()), say)
    measured = []
    for index, view in enumerate(members):
        scores = kept.get(str(index))
        if scores is None:
            say(f"    [{index + 1}/{len(members)}] {view.name}")
            scores = score_view(model, view.to(device), index=index)
            kept.add(str(index), scores)
        measured.append({"name": view.name, **scores})
    return RunScores(
        folder=str(folder),
        scene=_scene(trainer.scene.name, options),
        strategy=_strategy(config),
        training_views=len(trainer.scene.train),
        seed=config.seed,
        settings={name: value for name, value in settings.items() if name not in _IN_LABEL},
        gaussians=len(model.gaussians),
        views=measured,
    )


def _scene(name: str, options: SceneOptions) -> str:
    """Name a scene with what decides its resolution."""
    smaller = f"1/{options.downscale:g}" if options.downscale != 1 else None
    size = ", ".join(text for text in (options.images, smaller) if text is not None)
    return f"{name} ({size})" if size else name


def _strategy(config: TrainConfig) -> str:
    """Name the regularizers of a training."""
    dropout = f"{'inverted ' if config.compensate else ''}dropout {config.dropout:g}" if config.dropout else ""
    noise = f"{'clipped ' if config.clip_noise else ''}noise {config.noise:g}" if config.noise else ""
    return " + ".join(name for name in (dropout, noise) if name) or "baseline"


def _average(values: Tensor, weights: Tensor) -> float:
    """Average (H, W) with weights, or over a region; nan where all weights are 0."""
    weights = weights.double()
    total = weights.sum()
    return ((values.double() * weights).sum() / total).item() if total > 0 else math.nan
