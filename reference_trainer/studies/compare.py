"""The same training with different regularizers over several seeds, and one table with mean and spread."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from ca_reg.monitor import LOG_NAME
from reference_trainer.evaluation.report import format_mean_std, machine, markdown_table, write_json
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.figures import comparison_figure, dynamics_figure
from reference_trainer.studies.run import run_experiment
from reference_trainer.training.config import TrainConfig

__all__ = ["Comparison", "compare", "comparison_table", "report", "strategies"]

REPORT = "comparison.json"
TABLE = "comparison.md"


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


@dataclass(frozen=True)
class Comparison:
    """The results of all runs.

    Args:
        runs: for every strategy the content of ``results.json`` of each finished seed.
        failures: runs that did not finish, with the error of each.
    """

    runs: dict[str, list[dict[str, Any]]]
    failures: dict[str, str]


def _run(
    options: SceneOptions,
    config: TrainConfig,
    out: Path,
    threads: int,
    device: str,
    monitor_every: int,
    lpips: str | None,
) -> dict[str, Any]:
    """Do one run in a process of its own."""
    torch.set_num_threads(threads)
    return run_experiment(options, config, out, device=device, monitor_every=monitor_every, lpips=lpips)


def compare(
    options: SceneOptions,
    configs: Mapping[str, TrainConfig],
    seeds: Sequence[int],
    out: Path,
    *,
    jobs: int = 1,
    device: str = "cpu",
    monitor_every: int = 500,
    lpips: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Train every strategy with every seed; finished runs are kept, interrupted ones continue.

    Args:
        options: the scene.
        configs: settings by name of the strategy.
        seeds: of the runs; they replace the seed of the settings.
        out: folder of the comparison; run k of a strategy lives in ``<strategy>/seed_<k>``.
        jobs: how many runs at a time, each in a process of its own with its share of the processors.
        device: where to train.
        monitor_every: steps between measurements of CA and PSNR.
        lpips: perceptual metric of the evaluation: None, ``"installed"``, or a weights file.
        say: receives a line about every run.

    Returns:
        The results of the runs that finished, and the errors of the others.

    Raises:
        ValueError: if there is nothing to run, or ``jobs`` is not positive.
    """
    if jobs < 1 or not configs or not seeds:
        raise ValueError(
            f"expected at least 1 strategy, 1 seed and 1 job, got {len(configs)}, {len(seeds)} and {jobs}."
        )
    threads = max(1, (os.cpu_count() or 1) // jobs)
    grid = [(name, seed) for seed in seeds for name in configs]
    results: dict[tuple[str, int], dict[str, Any]] = {}
    failures: dict[str, str] = {}
    with ProcessPoolExecutor(max_workers=jobs, mp_context=get_context("spawn")) as pool:
        futures = {
            pool.submit(
                _run,
                options,
                dataclasses.replace(configs[name], seed=seed),
                out / name / f"seed_{seed}",
                threads,
                device,
                monitor_every,
                lpips,
            ): (name, seed)
            for name, seed in grid
        }
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                name, seed = futures[future]
                try:
                    results[name, seed] = result = future.result()
                except Exception as error:  # one failing run must not stop the others; it is reported
                    failures[f"{name}, seed {seed}"] = f"{type(error).__name__}: {error}"
                    say(f"[{done}/{len(grid)}] {name}, seed {seed}: FAILED, {error}")
                    continue
                psnr = result["mean"].get("test", result["mean"]["train"])["psnr"]
                quality = "no PSNR" if psnr is None else f"{psnr:.2f} dB"
                say(f"[{done}/{len(grid)}] {name}, seed {seed}: {quality} in {result['seconds']:.0f} s")
        except BaseException:  # an interruption must not wait for the runs that have not begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    runs = {name: [results[name, seed] for seed in seeds if (name, seed) in results] for name in configs}
    comparison = Comparison({name: of for name, of in runs.items() if of}, failures)
    if comparison.runs:
        write_json(out / REPORT, {**dataclasses.asdict(comparison), "machine": machine()})
        (out / TABLE).write_text(comparison_table(comparison.runs) + "\n", encoding="utf-8")
    return comparison


def comparison_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return one row per strategy in Markdown, every entry the mean and sample standard deviation over the seeds.

    CA is the paper's protocol, whose drop rate depends on p; "CA at 1/2" drops half of the Gaussians of every model.
    Both are in units of 1e-3.
    """
    columns: dict[str, tuple[str, str, float]] = {
        "test PSNR": ("test", "psnr", 1.0),
        "test SSIM": ("test", "ssim", 1.0),
        "test LPIPS": ("test", "lpips", 1.0),
        "test CA x1e-3": ("test", "ca", 1e-3),
        "test CA at 1/2": ("test", "ca_half", 1e-3),
        "test CV": ("test", "cv", 1.0),
        "train PSNR": ("train", "psnr", 1.0),
        "train CA x1e-3": ("train", "ca", 1e-3),
    }
    rows: list[dict[str, object]] = []
    for name, of in runs.items():
        row: dict[str, object] = {"strategy": name, "seeds": len(of)}
        for column, (split, quantity, unit) in columns.items():
            values = [run["mean"].get(split, {}).get(quantity) for run in of]
            known = [value for value in values if value is not None]
            if known:
                row[column] = format_mean_std(known, unit=unit)
        row["Gaussians"] = format_mean_std([run["gaussians"] for run in of], unit=1e3) + "k"
        row["seconds"] = format_mean_std([run["seconds"] for run in of])
        rows.append(row)
    present = [column for column in columns if any(column in row for row in rows)]
    return markdown_table(rows, ["strategy", "seeds", *present, "Gaussians", "seconds"])


def report(comparison: Comparison, out: Path, *, say: Callable[[str], None] = print) -> None:
    """Print the table, draw the figures of the first seed, and name the runs that failed.

    Args:
        comparison: the results.
        out: folder of the comparison.
        say: receives the text.

    Raises:
        RuntimeError: if no run finished.
    """
    for name, error in comparison.failures.items():
        say(f"FAILED {name}: {error}")
    if not comparison.runs:
        raise RuntimeError(f"no run of the comparison in {out} finished; the errors are above.")
    say("")
    say(comparison_table(comparison.runs))
    first = {name: out / name / f"seed_{of[0]['config']['seed']}" for name, of in comparison.runs.items()}
    say("")
    if all((folder / LOG_NAME).exists() for folder in first.values()):
        dynamics_figure(first, out / "dynamics.png")
        say(f"CA and PSNR against the iteration: {out / 'dynamics.png'}")
    views = next(iter(comparison.runs.values()))[0]["views"]
    for view in (view for view in views if view["split"] == "test"):
        stem = Path(view["name"]).stem
        comparison_figure(first, out / f"test_{stem}.png", view=stem)
        say(f"photograph, render, error and CA map of each strategy: {out / f'test_{stem}.png'}")
    say(f"table and all numbers: {out / TABLE}, {out / REPORT}; curves: tensorboard --logdir {out}")
