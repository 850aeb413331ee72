"""The pruning study: which Gaussians can go, by their shares of the score or by opacity, at equal count."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from reference_trainer.density.statistics import DensityStatistics
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.results import format_mean_std, machine, markdown_table, mean_std, write_json
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import replacing, write_text
from reference_trainer.json_files import read_json
from reference_trainer.runs.folder import CHECKPOINT, CONFIG
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.runs.settings import read_run_settings
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.studies.attribution import blend_weights, mean_shares, share_per_weight
from reference_trainer.training.randomness import stream
from reference_trainer.training.trainer import Trainer

__all__ = ["CRITERIA", "Pruned", "prune_lowest", "pruning_order", "study_pruning", "train_on"]

Say = Callable[[str], None]

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


@dataclasses.dataclass(frozen=True)
class Pruned:
    """What was measured on the test views of a pruned model; means over the views, nan where none has a value.

    Args:
        criterion: who went first, of `CRITERIA`; another text where nothing was removed.
        fraction: the part that was removed.
        steps: of training afterwards.
        gaussians: how many are left.
        psnr: of the test-time render.
        ca_exact: the exact score at drop rate 1/2.
        covered: the part of the pixels that the exact score covers: one that falls with it says little.
        ca_protocol: the paper's protocol at drop rate 1/2.
    """

    criterion: str
    fraction: float
    steps: int
    gaussians: int
    psnr: float
    ca_exact: float
    covered: float
    ca_protocol: float


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
    trainer.statistics = DensityStatistics.zeros(len(trainer.gaussians), trainer.device)


def train_on(trainer: Trainer, steps: int) -> None:
    """Train on, without densification, pruning and resets, and with the means at their final learning rate.

    Args:
        trainer: changed.
        steps: how many.

    Raises:
        TrainingStoppedError: as for `Trainer.train`.
    """
    config = trainer.config
    trainer.config = dataclasses.replace(
        config,
        iterations=trainer.step + steps,
        densify_every=0,
        opacity_reset_every=0,
        means_rate=config.means_rate_final,
    )
    trainer.train()


def study_pruning(
    runs: Sequence[Path],
    out: Path,
    *,
    fractions: Sequence[float] = (0.1, 0.2, 0.4),
    refine: int = 300,
    device: str = "cpu",
    say: Say = print,
) -> dict[str, list[Pruned]]:
    """Prune every run by every criterion; write ``pruning.json``, ``pruning.md`` and ``pruning.png``.

    What was measured before, on the same checkpoint, is not measured again.

    Args:
        runs: folders of runs that differ only in their seed.
        out: folder of the study; every run has a file in ``measured/``, written after each measurement.
        fractions: parts of the Gaussians to remove, in (0, 1).
        refine: steps of further training; 0 for none. With some, what was pruned is measured before and after them.
        device: where to render and train.
        say: receives the progress and the table.

    Returns:
        The measurements by run.

    Raises:
        ValueError: if there is no run or fraction, one is out of range, or the runs differ in more than their seed.
        FileNotFoundError: if a folder holds no run.
        TrainingStoppedError: as for `Trainer.train`.
    """
    folders = list(dict.fromkeys(run.resolve() for run in runs))
    if not fractions or not all(0 < fraction < 1 for fraction in fractions):
        raise ValueError(f"fractions to remove must be at least one, each in (0, 1), got {tuple(fractions)}.")
    if refine < 0:
        raise ValueError(f"refine must not be negative, got {refine}.")
    _refuse_different(folders)
    variants = [(_NONE, 0.0), *((name, fraction) for fraction in fractions for name in CRITERIA)]
    wanted = [(name, fraction, steps) for name, fraction in variants for steps in sorted({0, refine})]
    found = {str(folder): _measure_run(folder, out, wanted, device, say) for folder in folders}
    records = {run: [dataclasses.asdict(each) for each in measured] for run, measured in found.items()}
    write_json(out / "pruning.json", {"criteria": CRITERIA, "runs": records, "machine": machine()})
    text = _report(found)
    write_text(out / "pruning.md", text)
    _figure(found, out / "pruning.png")
    say(text)
    say(f"Numbers, table and figure are in {out}")
    return found


def _refuse_different(folders: Sequence[Path]) -> None:
    """Refuse runs whose mean says nothing."""
    settings: list[dict[str, Any]] = []
    for folder in folders:
        if not (folder / CHECKPOINT).exists():
            raise FileNotFoundError(f"{folder} holds no run (no {CHECKPOINT}): give the --out folder of ca-reg train.")
        of_both = read_run_settings(folder / CONFIG)
        settings.append({name: value for each in of_both for name, value in vars(each).items() if name != "seed"})
    if not settings:
        raise ValueError("expected at least 1 run, got none: give the --out folders of ca-reg train.")
    for folder, other in zip(folders, settings, strict=True):
        if names := [name for name, value in other.items() if value != settings[0][name]]:
            raise ValueError(
                f"{folders[0]} and {folder} differ in {', '.join(names)}; runs whose mean is taken may differ in their "
                "seed only: make a study of each kind."
            )


def _measure_run(
    folder: Path, out: Path, wanted: Iterable[tuple[str, float, int]], device: str, say: Say
) -> list[Pruned]:
    """Measure what is wanted of a run, and write it down at once."""
    fields = [field.name for field in dataclasses.fields(Pruned)]
    key = [str(folder), (folder / CHECKPOINT).stat().st_mtime_ns, CRITERIA, fields]
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:12]
    file = out / "measured" / f"{folder.parent.name}_{folder.name}_{digest}.json"
    known = [_read(record) for record in read_json(file)] if file.exists() else []
    by_key = {(each.criterion, each.fraction, each.steps): each for each in known}
    missing = [each for each in wanted if each not in by_key]
    if missing:
        start = load_run(folder, device)
        order = pruning_order(
            model_of(start), start.views, generator=stream(start.config.seed, start.step, "prune", start.device)
        )
        order[_NONE] = torch.zeros_like(order["random"])
    for number, each in enumerate(missing, start=1):
        criterion, fraction, steps = each
        trainer = Trainer.load(folder / CHECKPOINT, start.scene, device)
        prune_lowest(trainer, order[criterion], fraction)
        if steps:
            train_on(trainer, steps)
        by_key[each] = Pruned(criterion, fraction, steps, len(trainer.gaussians), **_score(trainer, start.scene))
        write_json(file, [dataclasses.asdict(measured) for measured in by_key.values()])
        text = f"{by_key[each].psnr:.2f} dB, exact CA {by_key[each].ca_exact * 1e3:.3f}e-3"
        say(f"[{number}/{len(missing)}] {folder}: {criterion}, {100 * fraction:g}%, {steps} steps: {text}")
    return [by_key[each] for each in wanted]


def _read(record: dict[str, Any]) -> Pruned:
    """Read a measurement; what JSON has no word for was nan."""
    values: dict[str, Any] = {name: math.nan if value is None else value for name, value in record.items()}
    return Pruned(**values)


@torch.no_grad()
def _score(trainer: Trainer, scene: Scene) -> dict[str, float]:
    """Measure the test views."""
    model = model_of(trainer)
    opacities = model.gaussians.opacities
    exact, protocol = model.exact_ca_score(drop_rate=_HALF), model.ca_score(drop_rate=_HALF)
    found: dict[str, list[float]] = {name: [] for name in _QUANTITIES}
    for index, view in enumerate(view.to(trainer.device) for view in scene.test):
        image = model.rendering(model.test_opacities, view).image.clamp(0, 1)
        limit = exact(opacities, view)
        found["psnr"].append(psnr(image, view.image))
        found["ca_exact"].append(limit.value)
        found["covered"].append(limit.visible.double().mean().item())
        found["ca_protocol"].append(protocol(opacities, view, index=index).value)
    return {name: mean_std(values)[0] for name, values in found.items()}


def _groups(found: dict[str, list[Pruned]]) -> dict[tuple[str, float, int], list[Pruned]]:
    """Return the measurements of all runs by what was done."""
    groups: dict[tuple[str, float, int], list[Pruned]] = {}
    for measured in found.values():
        for each in measured:
            groups.setdefault((each.criterion, each.fraction, each.steps), []).append(each)
    return groups


def _report(found: dict[str, list[Pruned]]) -> str:
    """Return the table in Markdown, mean and standard deviation over the runs."""
    groups = _groups(found)
    parts = [
        f"# Pruning at equal count, {len(found)} runs",
        "\n".join(f"- {name}: {text}" for name, text in CRITERIA.items()),
        "Who goes is decided on the training views, once; what is left is measured on the test views, both scores at "
        "drop rate 1/2. `covered`: the pixels of the exact score.",
    ]
    for steps in sorted({steps for _, _, steps in groups}):
        rows = []
        for (criterion, fraction, of_steps), members in groups.items():
            if of_steps == steps:
                row: dict[str, object] = {"removed first": criterion, "removed": f"{100 * fraction:g}%"}
                row["left"] = round(mean_std(each.gaussians for each in members)[0])
                for name, (title, unit) in _QUANTITIES.items():
                    row[title] = format_mean_std([getattr(each, name) for each in members], unit=unit)
                rows.append(row)
        title = f"## After {steps} further steps" if steps else "## As pruned"
        parts += [title, markdown_table(rows, list(rows[0])).rstrip()]
    return "\n\n".join(parts) + "\n"


def _figure(found: dict[str, list[Pruned]], path: Path) -> None:
    """Draw PSNR and exact score against the fraction, a line per criterion, a row for each number of steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    groups = _groups(found)
    rows = sorted({steps for _, _, steps in groups})
    figure = Figure(figsize=(10, 3.8 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), 2, squeeze=False)
    for steps, panels in zip(rows, grid, strict=True):
        for ax, quantity in zip(panels, ("psnr", "ca_exact"), strict=True):
            title, unit = _QUANTITIES[quantity]
            for number, criterion in enumerate(CRITERIA):
                points = sorted((key[1], key) for key in groups if key[0] in (criterion, _NONE) and key[2] == steps)
                stats = [mean_std(getattr(each, quantity) / unit for each in groups[key]) for _, key in points]
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
    with replacing(path) as place:
        figure.savefig(place, dpi=110, format="png")
