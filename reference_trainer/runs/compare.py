"""Comparisons: the same training with different regularizers over several scenes and seeds, and their tables."""

from __future__ import annotations

import dataclasses
import logging
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from reference_trainer.evaluation.pictures import comparison_figure, dynamics_figure, file_names, is_own_png
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.tables import comparison_table
from reference_trainer.files import write_text
from reference_trainer.runs.executors import Failure
from reference_trainer.runs.folder import (
    COMPARISON,
    CONFIG,
    RESULTS,
    check_output,
    folder_name,
    read_results,
    read_run_settings,
    report_file,
    settings_of_run,
)
from reference_trainer.runs.grid import Run, Running, run_grid
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.assembly import check, make_losses
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LossTerm

__all__ = ["NAMED", "TABLE", "Comparison", "compare", "report", "save", "scene_folders", "strategies"]

TABLE = "comparison.md"
_log = logging.getLogger(__name__)

NAMED: dict[str, set[str]] = {
    "baseline": set(),
    "dropout": {"dropout"},
    "noise": {"noise"},
    "both": {"dropout", "noise"},
    "analytic-dropout": {"dropout"},
    "analytic-noise": {"noise"},
}
"""Strategies of the paper's comparison, and analytic dropout and noise: which of the two rates each uses."""


def strategies(
    names: Sequence[str], config: TrainConfig, *, dropout: float = 0.2, noise: float = 0.8
) -> dict[str, TrainConfig]:
    """Return the settings of a comparison, by names that can serve as folder names.

    ``names`` are keys of `NAMED`, with these rates of dropout and noise, or expressions of regularizers, such as
    ``"d2gs"`` or ``"dropout(0.1) + noise(0.4)"``; ``config`` is everything else. Raises ValueError if an expression
    cannot be parsed, or ``config`` is analytic or has a ``regularizer``.

    Example:
        >>> made = strategies(["analytic-dropout", "dropout(0.1) + noise(0.4)"], TrainConfig())
        >>> made["analytic-dropout"].dropout, made["analytic-dropout"].analytic
        (0.2, True)
        >>> made["dropout_0.1_noise_0.4"].regularizer
        'dropout(0.1) + noise(0.4)'
    """
    if config.regularizer or config.analytic:
        raise ValueError(
            "--strategies says what is compared: name regularizers there, and analytic-dropout or analytic-noise."
        )
    rates = {"dropout": dropout, "noise": noise}
    plain, made = _plain(config), {}
    for name in names:
        if name in NAMED:
            p, sigma = (rates[rate] if rate in NAMED[name] else 0.0 for rate in ("dropout", "noise"))
            made[name] = dataclasses.replace(plain, dropout=p, noise=sigma, analytic=name.startswith("analytic"))
        else:
            made[folder_name(name)] = dataclasses.replace(plain, regularizer=name)
    for settings in made.values():
        check(settings)
    return made


def _plain(config: TrainConfig) -> TrainConfig:
    """Return the settings without what a strategy changes."""
    return dataclasses.replace(config, dropout=0.0, noise=0.0, regularizer="", analytic=False)


def scene_folders(paths: Sequence[str], options: SceneOptions, out: Path) -> dict[Path, SceneOptions]:
    """Return the scenes of a comparison by folder: ``out`` for a single scene, else ``out/<scene name>`` for each.

    ``paths`` are those of the scenes, or ``"synthetic"``; they share all other options. Raises ValueError if there is
    no scene, or two have the same name.

    Example:
        >>> [str(folder) for folder in scene_folders(["data/fern", "synthetic"], SceneOptions(), Path("runs"))]
        ['runs/fern', 'runs/synthetic']
        >>> [str(folder) for folder in scene_folders(["data/fern"], SceneOptions(), Path("runs"))]
        ['runs']
    """
    names = [path if path == "synthetic" else Path(path).resolve().name for path in paths]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"expected at least 1 scene, and scenes whose folders have different names, got {[*paths]}.")
    shared = dataclasses.asdict(options)  # the command line may pass a subclass, which workers need not import
    return {
        out if len(names) == 1 else out / name: SceneOptions(**shared | {"path": path})
        for name, path in zip(names, paths, strict=True)
    }


def compare(
    scenes: Mapping[Path, SceneOptions], configs: Mapping[str, TrainConfig], seeds: Sequence[int], running: Running
) -> dict[Path, Comparison]:
    """Train every strategy on every scene with every seed; finished runs are kept, interrupted ones continue.

    The run with seed k is in ``<folder>/<strategy>/seed_<k>``; seeds replace that of the settings. Returns, for every
    folder, the results of the finished runs, those of other strategies among them that were trained there before on the
    same scene with the same settings, and the failures of the others; both are also written there.

    Raises:
        ValueError: if there is nothing to run, a scene lacks what a term of the loss needs, a folder holds a table, a
            figure or a page of somebody else's, or a run itself, or one of the runs was begun with other settings.
    """
    for folder, options in scenes.items():
        if (folder / CONFIG).exists():
            raise ValueError(
                f"{folder} holds a run itself ({CONFIG}), which a report would show in place of a comparison: give "
                "another --out."
            )
        report_file([folder])
        check_output(folder, options.path, () if (folder / COMPARISON).exists() else (TABLE, "dynamics.png"))
    if not scenes or not configs or not seeds:
        raise ValueError(
            f"expected at least 1 scene, 1 strategy and 1 seed, got {len(scenes)}, {len(configs)} and {len(seeds)}."
        )
    runs: dict[tuple[Path, str, int], Run] = {}
    for seed, folder, name in product(seeds, scenes, configs):
        label = _label(name, seed) if len(scenes) == 1 else f"{folder.name}, {_label(name, seed)}"
        run = Run(label, scenes[folder], dataclasses.replace(configs[name], seed=seed), folder / name / f"seed_{seed}")
        # Refused before any failure of these runs could take the place of their results in the file.
        settings_of_run(run.out, run.options, run.config, auto=False, given=())
        runs[folder, name, seed] = run
    terms = [term for config in configs.values() for term in make_losses(config)]
    if looking := [term for term in terms if type(term).begin is not LossTerm.begin]:
        for options in {run.options for run in runs.values() if not (run.out / RESULTS).exists()}:
            scene = load_scene(options)
            for term in looking:
                term.begin(scene)
    comparisons = {folder: Comparison(_others(folder, scenes[folder], configs), {}) for folder in scenes}
    for (folder, name, seed), outcome in zip(runs, run_grid([*runs.values()], running), strict=True):
        if isinstance(outcome, Failure):
            comparisons[folder].failures[_label(name, seed)] = outcome
        else:
            comparisons[folder].runs.setdefault(name, []).append(outcome)
    for folder, comparison in comparisons.items():
        save(comparison, folder)
    return comparisons


def _others(folder: Path, options: SceneOptions, configs: Mapping[str, TrainConfig]) -> dict[str, list[dict[str, Any]]]:
    """Return the results of strategies trained in the folder before, on the same scene and otherwise alike."""
    alike = {dataclasses.replace(_plain(config), seed=0) for config in configs.values()}
    found: dict[str, list[dict[str, Any]]] = {}
    for run in sorted(path.parent for path in folder.glob(f"*/seed_*/{RESULTS}")):
        with suppress(ValueError, OSError):  # of a damaged one: the new runs are worth a table all the same
            scene, config = read_run_settings(run / CONFIG)
            same = scene == options.absolute() and dataclasses.replace(_plain(config), seed=0) in alike
            if same and run.parent.name not in configs:
                found.setdefault(run.parent.name, []).append(read_results(run))
    return found


def _label(name: str, seed: int) -> str:
    """Return the label of a run among those of its scene."""
    return f"{name}, seed {seed}"


@dataclass(frozen=True)
class Comparison:
    """The results of all runs on one scene."""

    runs: dict[str, list[dict[str, Any]]]  # for every strategy the content of ``results.json`` of each finished seed
    failures: dict[str, Failure]  # runs that did not finish, and why


def save(comparison: Comparison, out: Path) -> None:
    """Write the results as JSON, and the table if any run finished."""
    write_json(out / COMPARISON, {**dataclasses.asdict(comparison), "machine": machine()})
    if comparison.runs:
        write_text(out / TABLE, comparison_table(comparison.runs) + "\n")


def report(comparisons: Mapping[Path, Comparison]) -> None:
    """Log the table of every scene, plot the figures of its first seed, and name the runs that failed."""
    for out, comparison in comparisons.items():
        _log.info(f"\n{out.name}:\n" if len(comparisons) > 1 else "")
        if comparison.runs:
            _report(comparison, out)
    failed = [(out, name, why) for out, of in comparisons.items() for name, why in of.failures.items()]
    if failed:
        finished = sum(len(runs) for of in comparisons.values() for runs in of.runs.values())
        _log.info("")
        _log.info("%d of %d runs FAILED; the same command tries them again:", len(failed), finished + len(failed))
        for out, name, why in failed:
            _log.info("FAILED %s: %s (%s has the traceback)", name, why.error, out / COMPARISON)


def _report(comparison: Comparison, out: Path) -> None:
    """Log the table of one scene and plot its figures."""
    _log.info(comparison_table(comparison.runs))
    first = {name: out / name / f"seed_{of[0]['config']['seed']}" for name, of in comparison.runs.items()}
    try:
        dynamics_figure(first, out / "dynamics.png")
        _log.info("CA and PSNR against the iteration: %s", out / "dynamics.png")
    except (FileNotFoundError, ValueError) as error:  # runs of --monitor-every 0
        _log.info("no figure of CA and PSNR against the iteration: %s", error)
    views = next(iter(comparison.runs.values()))[0]["views"]
    splits, figures = {view["split"] for view in views}, list[Path]()
    try:
        for split in sorted(splits - {"train"}) or splits:
            for name in file_names([view["name"] for view in views if view["split"] == split]):
                if is_own_png(figure := out / f"{split}_{name}.png"):
                    comparison_figure(first, figure, view=name, split=split)
                    figures.append(figure)
                else:
                    _log.info("%s is not from here, and is kept.", figure)
        such = "".join(f", such as {path}" for path in figures[:1])
        _log.info("every view under each strategy: %d pictures%s", len(figures), such)
    except FileNotFoundError as error:  # somebody has deleted them
        _log.info("no pictures of the views under each strategy: %s", error)
    _log.info(
        "table and all numbers: %s, %s; curves: tensorboard --logdir %s", out / TABLE, COMPARISON, shlex.quote(str(out))
    )
