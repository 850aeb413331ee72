"""The same training with different regularizers over several scenes and seeds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from reference_trainer.runs.compare_report import Comparison, save
from reference_trainer.runs.engines.engine import Failure
from reference_trainer.runs.grid import Run, Running, run_grid
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["compare", "scene_folders", "strategies"]


def strategies(
    config: TrainConfig, *, dropout: float = 0.2, noise: float = 0.8, scale_noise: bool = False
) -> dict[str, TrainConfig]:
    """Return the four settings of the paper's comparison, and dropout and noise in expectation instead of sampled.

    Example:
        >>> analytic = strategies(TrainConfig())["analytic-dropout"]
        >>> analytic.dropout, analytic.noise, analytic.analytic
        (0.2, 0.0, True)
    """
    rates = {"baseline": (0.0, 0.0), "dropout": (dropout, 0.0), "noise": (0.0, noise), "both": (dropout, noise)}
    sampled = {
        name: dataclasses.replace(config, dropout=p, noise=sigma, scale_noise=scale_noise and sigma > 0)
        for name, (p, sigma) in rates.items()
    }
    expected = {f"analytic-{name}": dataclasses.replace(sampled[name], analytic=True) for name in ("dropout", "noise")}
    return sampled | expected


def scene_folders(paths: Sequence[str], options: SceneOptions, out: Path) -> dict[Path, SceneOptions]:
    """Return the folder of the comparison of every scene: ``out`` for a single one, else ``out/<name of the scene>``.

    Args:
        paths: of the scenes, or ``"synthetic"``.
        options: all other options, which hold for every scene.
        out: folder of the whole.

    Raises:
        ValueError: if there is no scene, or two have the same name.

    Example:
        >>> [str(folder) for folder in scene_folders(["data/fern", "synthetic"], SceneOptions(), Path("runs"))]
        ['runs/fern', 'runs/synthetic']
        >>> [str(folder) for folder in scene_folders(["data/fern"], SceneOptions(), Path("runs"))]
        ['runs']
    """
    names = [path if path == "synthetic" else Path(path).resolve().name for path in paths]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"expected at least 1 scene, and scenes whose folders have different names, got {[*paths]}.")
    shared = dataclasses.asdict(options)  # a command line may have a class of its own, which workers need not know
    return {
        out if len(names) == 1 else out / name: SceneOptions(**shared | {"path": path})
        for name, path in zip(names, paths, strict=True)
    }


def compare(
    scenes: Mapping[Path, SceneOptions],
    configs: Mapping[str, TrainConfig],
    seeds: Sequence[int],
    running: Running,
) -> dict[Path, Comparison]:
    """Train every strategy on every scene with every seed; finished runs are kept, interrupted ones continue.

    Args:
        scenes: by folder of the comparison; run k of a strategy lives in ``<folder>/<strategy>/seed_<k>``.
        configs: settings by name of the strategy.
        seeds: of the runs; they replace the seed of the settings.
        running: where and how the runs are done.

    Returns:
        For every folder the results of the runs that finished, and why the others did not. Both are also written
        there.

    Raises:
        ValueError: if there is nothing to run.
    """
    if not scenes or not configs or not seeds:
        raise ValueError(
            f"expected at least 1 scene, 1 strategy and 1 seed, got {len(scenes)}, {len(configs)} and {len(seeds)}."
        )
    grid = [(folder, name, seed) for seed in seeds for folder in scenes for name in configs]
    runs = [
        Run(
            label=_label(name, seed) if len(scenes) == 1 else f"{folder.name}, {_label(name, seed)}",
            options=scenes[folder],
            config=dataclasses.replace(configs[name], seed=seed),
            out=folder / name / f"seed_{seed}",
        )
        for folder, name, seed in grid
    ]
    comparisons = {folder: Comparison({}, {}) for folder in scenes}
    for (folder, name, seed), outcome in zip(grid, run_grid(runs, running), strict=True):
        if isinstance(outcome, Failure):
            comparisons[folder].failures[_label(name, seed)] = outcome
        else:
            comparisons[folder].runs.setdefault(name, []).append(outcome)
    for folder, comparison in comparisons.items():
        save(comparison, folder)
    return comparisons


def _label(name: str, seed: int) -> str:
    """Return what a run is called among those of its scene."""
    return f"{name}, seed {seed}"
