"""The pruning study: which Gaussians can go, by their shares of the score or by opacity, at equal count.

``python -m benchmarks.pruning RUN ...``.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from reference_trainer.cli import log_shown
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.shares import blend_weights, mean_shares, share_per_weight
from reference_trainer.evaluation.tables import format_mean_std, markdown_table, mean_std
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.runs.folder import CONFIG, read_run_settings
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.studies.study import Record, Records, Study, checkpoints, run_study
from reference_trainer.training.density import DensityStrategy
from reference_trainer.training.randomness import stream
from reference_trainer.training.trainer import Trainer

__all__ = ["CRITERIA", "prune_lowest", "pruning_order", "pruning_study", "train_on"]

CRITERIA = {
    "lowest opacity": "what density control prunes by",
    "lowest blend weight": "sum of alpha times transmittance over all pixels of the training views",
    "lowest share": "share of the exact score at drop rate 1/2, mean over the training views",
    "highest share": "the same, from the other end",
    "highest share per weight": "those first that co-adapt most for what they contribute",
    "random": "the control",
}
"""What decides who goes first."""

_NONE = "nothing removed"
_QUANTITIES = {
    "psnr": ("PSNR", 1.0),
    "ca_exact": ("exact CA x1e-3", 1e-3),
    "covered": ("covered %", 1e-2),
    "ca_protocol": ("protocol CA x1e-3", 1e-3),
}
_HALF = 0.5


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("runs/pruning"),
    fractions: tuple[float, ...] = (0.1, 0.2, 0.4),
    refine: int = 300,
    device: str = "cpu",
) -> None:
    """Prune by the shares and by opacity, equally many Gaussians: test PSNR and co-adaptation of what is left.

    Args:
        runs: folders of runs that differ only in their seed.
        out: folder for the JSON, the table and the figure; what is in it is not measured again.
        fractions: parts of the Gaussians to remove.
        refine: steps of further training after pruning, without densification; 0 for none.
        device: "cpu" or "cuda".
    """
    with log_shown():
        run_study(pruning_study(runs, fractions=fractions, refine=refine, device=device), out)


def pruning_order(model: TrainedModel, views: Sequence[View], *, generator: torch.Generator) -> dict[str, Tensor]:
    """Return a number per Gaussian for every criterion; the lowest are to be removed first.

    Args:
        model: what to prune.
        views: the training views, on the model's device.
        generator: on the model's device, for the control.

    Returns:
        By the names of `CRITERIA`, each of shape (N,).

    Raises:
        ValueError: if no view has a score.
    """
    opacities, weights = model.gaussians.opacities, blend_weights(model, views)
    shares, _ = mean_shares(model, views, drop_rate=_HALF)
    order = [opacities, weights, shares, -shares, -share_per_weight(shares, weights)]
    order.append(torch.rand(opacities.shape, generator=generator, device=opacities.device))
    return dict(zip(CRITERIA, order, strict=True))


def prune_lowest(trainer: Trainer, values: Tensor, fraction: float) -> None:
    """Remove the Gaussians with the lowest values; the others keep parameters and optimizer state.

    Args:
        trainer: changed.
        values: one per Gaussian, shape (N,); of equal ones the first go first.
        fraction: the part to remove, in [0, 1).

    Raises:
        ValueError: if ``fraction`` is out of range.
    """
    if not 0 <= fraction < 1:
        raise ValueError(f"a fraction to remove must be in [0, 1), got {fraction}.")
    keep = torch.ones_like(values, dtype=torch.bool)
    keep[values.argsort(stable=True)[: round(fraction * len(values))]] = False
    trainer.optimizer.select(keep)
    trainer.density.reset(len(trainer.gaussians))


def train_on(trainer: Trainer, steps: int) -> None:
    """Train on, without density control, and with the means at their final learning rate.

    Args:
        trainer: changed.
        steps: how many.

    Raises:
        TrainingStoppedError: as for `Trainer.train`.
    """
    config = trainer.config
    trainer.config = dataclasses.replace(config, iterations=trainer.step + steps, means_rate=config.means_rate_final)
    trainer.models[0].density = _LeftAlone()
    trainer.train()


class _LeftAlone(DensityStrategy):
    """Neither adds nor removes Gaussians."""

    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Do nothing."""


def pruning_study(
    runs: Sequence[Path], *, fractions: Sequence[float] = (0.1, 0.2, 0.4), refine: int = 300, device: str = "cpu"
) -> Study:
    """Declare the study: every run is pruned by every criterion, and measured on its test views.

    Args:
        runs: folders of runs that differ only in their seed.
        fractions: parts of the Gaussians to remove, in (0, 1).
        refine: steps of further training; 0 for none. With some, what was pruned is measured before and after them.
        device: where to render and train.

    Raises:
        ValueError: if there is no run or fraction, one is out of range, or the runs differ in more than their seed.
        FileNotFoundError: if a folder holds no run.
    """
    if not fractions or not all(0 < fraction < 1 for fraction in fractions):
        raise ValueError(f"fractions to remove must be at least one, each in (0, 1), got {tuple(fractions)}.")
    if refine < 0:
        raise ValueError(f"refine must not be negative, got {refine}.")
    found = checkpoints(runs)
    _refuse_different([checkpoint.parent for checkpoint in found.values()])
    variants = [(_NONE, 0.0), *((name, fraction) for fraction in fractions for name in CRITERIA)]
    cases = {
        f"{run}: {criterion}, {100 * fraction:g}%, {steps} steps": {
            "checkpoint": checkpoint, "criterion": criterion, "fraction": fraction, "steps": steps, "device": device
        }
        for run, checkpoint in found.items() for criterion, fraction in variants for steps in sorted({0, refine})
    }  # fmt: skip
    return Study("pruning", _measure, cases, _report, _plot)


def _refuse_different(folders: Sequence[Path]) -> None:
    """Refuse runs whose mean says nothing."""
    settings = [
        {name: value for each in read_run_settings(folder / CONFIG) for name, value in vars(each).items()}
        for folder in folders
    ]
    for folder, other in zip(folders, settings, strict=True):
        if names := [name for name, value in other.items() if value != settings[0][name] and name != "seed"]:
            raise ValueError(
                f"{folders[0]} and {folder} differ in {', '.join(names)}; runs whose mean is taken may differ in their "
                "seed only: make a study of each kind."
            )


def _measure(checkpoint: Path, criterion: str, fraction: float, steps: int, device: str) -> Record:
    """Prune and measure on the test views: means over those that have a value.

    ``covered`` is the part of the pixels that the exact score covers: a score that falls with it says little.
    """
    scene, order = _scene_and_order(checkpoint, device)
    trainer = Trainer.load(checkpoint, scene, device)
    if fraction:
        prune_lowest(trainer, order[criterion], fraction)
    if steps:
        train_on(trainer, steps)
    what = {"criterion": criterion, "fraction": fraction, "steps": steps, "gaussians": len(trainer.gaussians)}
    return {**what, **_score(trainer, scene)}


@functools.lru_cache(maxsize=1)
def _scene_and_order(checkpoint: Path, device: str) -> tuple[Scene, dict[str, Tensor]]:
    """Do once per run what all of its cases need."""
    start = load_run(checkpoint.parent, device)
    generator = stream(start.config.seed, start.step, "prune", start.device)
    return start.scene, pruning_order(model_of(start), start.views, generator=generator)


@torch.no_grad()
def _score(trainer: Trainer, scene: Scene) -> dict[str, float]:
    """Measure the test views."""
    model = model_of(trainer)
    opacities = model.gaussians.opacities
    exact, protocol = model.exact_ca_score(drop_rate=_HALF), model.ca_score(drop_rate=_HALF)
    found: dict[str, list[float]] = {name: [] for name in _QUANTITIES}
    for index, view in enumerate(view.to(trainer.device) for view in scene.test):
        image = model.test_rendering(view).image.clamp(0, 1)
        limit = exact(opacities, view)
        found["psnr"].append(psnr(image, view.image, view.mask))
        found["ca_exact"].append(limit.value)
        found["covered"].append(limit.visible.double().mean().item())
        found["ca_protocol"].append(protocol(opacities, view, index=index).value)
    return {name: mean_std(values)[0] for name, values in found.items()}


def _over_runs(records: Records) -> dict[tuple[str, float, int], list[Record]]:
    """Return the records of all runs by what was done."""
    groups: dict[tuple[str, float, int], list[Record]] = {}
    for record in records.values():
        groups.setdefault((record["criterion"], record["fraction"], record["steps"]), []).append(record)
    return groups


def _report(records: Records) -> str:
    """Return the tables, mean and standard deviation over the runs."""
    groups = _over_runs(records)
    parts = [
        f"# Pruning at equal count, {len(next(iter(groups.values())))} runs",
        "\n".join(f"- {name}: {text}" for name, text in CRITERIA.items()),
        "Who goes is decided on the training views, once; what is left is measured on the test views, both scores at "
        "drop rate 1/2. `covered`: the pixels of the exact score.",
    ]
    for steps in sorted({steps for _, _, steps in groups}):
        rows = [
            {"removed first": criterion, "removed": f"{100 * fraction:g}%"}
            | {"left": round(mean_std(each["gaussians"] for each in group)[0])}
            | {title: format_mean_std([x[q] for x in group], unit=unit) for q, (title, unit) in _QUANTITIES.items()}
            for (criterion, fraction, of_steps), group in groups.items()
            if of_steps == steps
        ]
        title = f"## After {steps} further steps" if steps else "## As pruned"
        parts += [title, markdown_table(rows, list(rows[0])).rstrip()]
    return "\n\n".join(parts) + "\n"


def _plot(records: Records, figure: Any) -> None:
    """Plot PSNR and exact score against the fraction, a line per criterion, a row for each number of steps."""
    groups = _over_runs(records)
    rows = sorted({steps for _, _, steps in groups})
    figure.set_size_inches(10, 3.8 * len(rows))
    grid = figure.subplots(len(rows), 2, squeeze=False)
    for steps, panels in zip(rows, grid, strict=True):
        for ax, quantity in zip(panels, ("psnr", "ca_exact"), strict=True):
            title, unit = _QUANTITIES[quantity]
            for number, criterion in enumerate(CRITERIA):
                points = sorted((key[1], key) for key in groups if key[0] in (criterion, _NONE) and key[2] == steps)
                stats = [mean_std(each[quantity] / unit for each in groups[key]) for _, key in points]
                ax.errorbar(
                    [100 * fraction for fraction, _ in points],
                    [mean for mean, _ in stats],
                    [0.0 if math.isnan(std) else std for _, std in stats],
                    label=criterion,
                    marker="osD^v*"[number],
                    capsize=3,
                )
            after = f"after {steps} further steps" if steps else "as pruned"
            ax.set(xlabel="Gaussians removed (%)", ylabel=f"test {title}", title=after)
            ax.grid(linewidth=0.3)
    grid[0][1].legend(fontsize=8)


if __name__ == "__main__":
    tyro.cli(main)
