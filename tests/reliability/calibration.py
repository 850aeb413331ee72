"""Adaptive scores of many seeds against the exact score: their bias, and how often they are within their stated error.

Print the table: ``PYTHONPATH=.:tests python tests/reliability/calibration.py 200``; with ``--out`` also as JSON.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from oracles import random_scene
from torch import Tensor

from ca_reg import CAScore, MomentsFn, RenderFn
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render import render_masks, splat
from reference_trainer.render.renderer import render_moments
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = ["MODELS", "Calibration", "Case", "calibrate", "main"]

TARGETS = (0.1, 0.05, 0.02)


@dataclass(frozen=True)
class Case:
    """A model, one view of it, and how it is scored."""

    render: RenderFn
    moments: MomentsFn
    opacity: Tensor
    view: Any
    settings: dict[str, float]


@dataclass(frozen=True)
class Calibration:
    """How the scores of many seeds lie about the exact one; all but counts and shares in fractions of that.

    Args:
        model: its name.
        target: the relative error asked for.
        scores: how many were made.
        samples: renders that they took, on average.
        bias: mean of the scores, less 1.
        bias_error: standard error of it.
        region: the part of it that comes from the region: the exact variance over the pixels of the score, less 1.
        spread: standard deviation of the scores.
        stated: the standard error that they state, root mean square.
        within_one: share of the scores within one stated error of the exact score; 0.68 if normal.
        within_two: within two; 0.95 if normal.
    """

    model: str
    target: float
    scores: int
    samples: float
    bias: float
    bias_error: float
    region: float
    spread: float
    stated: float
    within_one: float
    within_two: float


def built_in_scene(dropout: float) -> Case:
    """Return the view beyond the rig of a model of the built-in scene, trained for 400 steps at 32x24."""
    scene = synthetic_scene(32, 24, points=500)
    config = TrainConfig(iterations=400, dropout=dropout, opacity_reset_every=0, densify_from=100)
    trainer = Trainer(scene, config)
    trainer.train()
    model = TrainedModel(trainer.gaussians, scene.background, f"dropout({dropout})")
    return Case(model.render, model.moments, trainer.gaussians.opacities.detach(), scene.test[-1], {"p": dropout})


def gaussians_at_random(drop_rate: float, n: int = 12, size: float = 0.4) -> Case:
    """Return Gaussians at random places: the fewer they are, the longer the tails of what one render contributes."""
    scene = random_scene(n, 8, 6, 5, size=size)
    background = torch.ones(3, dtype=torch.float64)
    model = 0.1 + 0.6 * scene.opacities
    whole = splat(*scene[:3], model, scene.camera, colors=scene.colors)

    class Renders:
        """Many masks at a time."""

        def many(self, opacities: Tensor, view: None) -> tuple[Tensor, Tensor]:
            return render_masks(whole, opacities, background=background)

        def __call__(self, opacity: Tensor, view: None) -> tuple[Tensor, Tensor]:
            images, alphas = self.many(opacity[None], view)
            return images[0], alphas[0]

    def moments_fn(opacity: Tensor, view: None, multiplier: Any, behind: Tensor | None) -> Any:
        splats = splat(*scene[:3], opacity, scene.camera, colors=scene.colors)
        return render_moments(splats, multiplier, background=background if behind is None else behind)

    return Case(Renders(), moments_fn, model, None, {"drop_rate": drop_rate, "threshold": 0.5})


MODELS: dict[str, Callable[[], Case]] = {
    "built-in scene, baseline": lambda: built_in_scene(0.0),
    "built-in scene, dropout 0.2": lambda: built_in_scene(0.2),
    "12 Gaussians, drop rate 0.5": lambda: gaussians_at_random(0.5),
    "12 Gaussians, drop rate 0.3": lambda: gaussians_at_random(0.3),
}


def calibrate(name: str, case: Case, target: float, scores: int, *, max_samples: int = 100_000) -> Calibration:
    """Score a view with the seeds 0, 1, ..., and hold the scores against the exact one."""
    limit = CAScore(exact=case.moments, **case.settings)(case.opacity, case.view)
    results = [
        CAScore(case.render, relative_error=target, max_samples=max_samples, seed=seed, **case.settings)(
            case.opacity, case.view
        )
        for seed in range(scores)
    ]
    values = torch.tensor([r.value for r in results], dtype=torch.float64) / limit.value
    errors = torch.tensor([r.std_error for r in results], dtype=torch.float64) / limit.value
    regions = torch.stack([limit.variance[r.visible].mean() for r in results]) / limit.value
    distance = (values - 1).abs() / errors
    return Calibration(
        model=name,
        target=target,
        scores=scores,
        samples=sum(r.samples or 0 for r in results) / scores,
        bias=values.mean().item() - 1,
        bias_error=values.std().item() / scores**0.5,
        region=regions.mean().item() - 1,
        spread=values.std().item(),
        stated=errors.square().mean().sqrt().item(),
        within_one=(distance < 1).double().mean().item(),
        within_two=(distance < 2).double().mean().item(),
    )


def main() -> None:
    """Run the calibration that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scores", type=int, help="seeds per model and target")
    parser.add_argument("--only", default="", help="models whose name contains this")
    parser.add_argument("--out", type=Path, help="JSON file for the numbers")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    print("| model | target | renders | bias | of the region | spread | stated | within 1 | within 2 |")
    print("|:---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in (name for name in MODELS if options.only in name):
        case = MODELS[name]()
        for target in TARGETS:
            row = calibrate(name, case, target, options.scores)
            rows.append(asdict(row))
            print(
                f"| {name} | {target} | {row.samples:.0f} | {row.bias:+.2%} ± {row.bias_error:.2%} | {row.region:+.2%} "
                f"| {row.spread:.1%} | {row.stated:.1%} | {row.within_one:.0%} | {row.within_two:.0%} |",
                flush=True,
            )
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
