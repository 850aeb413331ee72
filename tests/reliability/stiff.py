"""Trainings that are pushed too far: each goes on with finite numbers, or stops with a reason and a good checkpoint.

Print the table: ``PYTHONPATH=.:tests python tests/reliability/stiff.py --path scene --images images_16``.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from reference_trainer.evaluation.metrics import psnr
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.trainer import Trainer

__all__ = ["CASES", "Ending", "main", "push"]

Push = Callable[[Scene, TrainConfig], tuple[Scene, TrainConfig]]
RATES = ("means_rate", "means_rate_final", "scales_rate", "quaternions_rate", "opacity_rate", "color_rate")
_CHECKPOINT_EVERY = 10


@dataclass(frozen=True)
class Ending:
    """How a training ended.

    Args:
        reason: why it stopped; empty if it came to its end.
        step: of the last checkpoint.
        gaussians: how many that has.
        before: PSNR of the training views at the start.
        after: the same of the last checkpoint.
    """

    reason: str
    step: int
    gaussians: int
    before: float
    after: float


def push(scene: Scene, config: TrainConfig, path: Path) -> Ending:
    """Train with frequent checkpoints, then load the last one, which is refused unless all of it is finite."""
    trainer, reason = Trainer(scene, config), ""
    trainer.save(path)
    before = _quality(trainer)

    def after_step(trainer: Trainer) -> None:
        if trainer.step % _CHECKPOINT_EVERY == 0:
            trainer.save(path)

    try:
        trainer.train(after_step=after_step)
    except TrainingStoppedError as error:
        reason = str(error)
    saved = Trainer.load(path, scene)
    return Ending(reason, saved.step, len(saved.gaussians), before, _quality(saved))


def _faster(factor: float, names: tuple[str, ...] = RATES) -> Push:
    """Multiply learning rates."""

    def change(scene: Scene, config: TrainConfig) -> tuple[Scene, TrainConfig]:
        changes: dict[str, Any] = {name: factor * getattr(config, name) for name in names}
        return scene, dataclasses.replace(config, **changes)

    return change


def _with(**changes: Any) -> Push:
    """Change settings."""
    return lambda scene, config: (scene, dataclasses.replace(config, **changes))


def _one_view(scene: Scene, config: TrainConfig) -> tuple[Scene, TrainConfig]:
    return dataclasses.replace(scene, train=scene.train[:1]), config


def _points(change: Callable[[torch.Tensor], torch.Tensor]) -> Push:
    """Change the positions of the initial points."""

    def changed(scene: Scene, config: TrainConfig) -> tuple[Scene, TrainConfig]:
        assert scene.points is not None
        cloud = dataclasses.replace(scene.points, positions=change(scene.points.positions))
        return dataclasses.replace(scene, points=cloud), config

    return changed


def _photographs(value: float) -> Push:
    """Make all photographs one gray."""

    def changed(scene: Scene, config: TrainConfig) -> tuple[Scene, TrainConfig]:
        views = tuple(dataclasses.replace(view, image=torch.full_like(view.image, value)) for view in scene.train)
        return dataclasses.replace(scene, train=views), config

    return changed


CASES: dict[str, Push] = {
    "as it should be": _with(),
    "all learning rates x10": _faster(10),
    "all learning rates x100": _faster(100),
    "all learning rates x1e4": _faster(1e4),
    "all learning rates x1e8": _faster(1e8),
    "rate of the means x100": _faster(100, ("means_rate", "means_rate_final")),
    "rate of the scales x100": _faster(100, ("scales_rate",)),
    "rate of the opacities x100": _faster(100, ("opacity_rate",)),
    "rate of the colors x100": _faster(100, ("color_rate",)),
    "one view": _one_view,
    "every point twice": _points(lambda x: torch.cat([x[::2], x[::2], x])[: len(x)]),
    "all points at one place": _points(lambda x: x.median(0).values.expand_as(x).clone()),
    "black photographs": _photographs(0.0),
    "gray photographs": _photographs(0.5),
    "white photographs": _photographs(1.0),
    "reset to 0.01, noise 0.8": _with(opacity_reset=0.01, noise=0.8),
    "reset to 0.01, noise 3": _with(opacity_reset=0.01, noise=3.0),
    "reset below the pruning": _with(opacity_reset=0.004),
    "dropout 0.99": _with(dropout=0.99),
    "dropout 0.99, inverted": _with(regularizer="dropout(0.99, compensate=True)"),
    "noise 10": _with(noise=10.0),
    "noise 10, exact expectation": _with(noise=10.0, analytic=True),
    "densify at every step": _with(densify_every=1, densify_from=1, densify_gradient=1e-6, max_gaussians=20_000),
}


def main() -> None:
    """Print the table that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--path", default="synthetic", help="scene folder")
    parser.add_argument("--images", help="image folder within the scene")
    parser.add_argument("--downscale", type=float, default=1.0, help="make pictures smaller")
    parser.add_argument("--iterations", type=int, default=200)
    options = parser.parse_args()
    scene = load_scene(options.path, seed=0, images=options.images, downscale=options.downscale)
    n = options.iterations
    config = TrainConfig(
        iterations=n, sh_every=n // 4, densify_from=n // 10, densify_every=n // 10, opacity_reset_from=n // 4,
        opacity_reset_every=3 * n // 4,
    )  # fmt: skip
    print("| case | ending | checkpoint | Gaussians | train PSNR before | after |\n|:---|:---|---:|---:|---:|---:|")
    for name, change in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            end = push(*change(scene, config), Path(folder, "checkpoint.pt"))
        numbers = f"{end.step} | {end.gaussians} | {end.before:.1f} | {end.after:.1f}"
        print(f"| {name} | {end.reason or 'trained'} | {numbers} |", flush=True)


@torch.no_grad()
def _quality(trainer: Trainer) -> float:
    """Mean PSNR over the training views, with the opacities of the test."""
    model = model_of(trainer)
    images = [model.test_rendering(view).image.clamp(0, 1) for view in trainer.views]
    return sum(psnr(image, view.image) for image, view in zip(images, trainer.views, strict=True)) / len(images)


if __name__ == "__main__":
    main()
