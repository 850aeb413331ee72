"""Grids of runs on an engine: finished runs are kept, interrupted ones continue, failing ones do not stop the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from reference_trainer.render import chosen_engine, use_engine
from reference_trainer.runs.engines.engine import Engine, Failure, Task, Value, attempt
from reference_trainer.runs.engines.run_all import run_all
from reference_trainer.runs.folder import RESULTS
from reference_trainer.runs.run import check_intervals, run_experiment
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["Run", "Running", "run_grid", "train_run"]


@dataclass(frozen=True)
class Run:
    """One run of a grid.

    Args:
        label: what to call it.
        options: the scene.
        config: the training.
        out: folder of the run, unique within the grid.
    """

    label: str
    options: SceneOptions
    config: TrainConfig
    out: Path


@dataclass(frozen=True)
class Running:
    """How the runs of a grid are executed; this does not affect what is trained.

    Args:
        engine: where to run.
        retries: how many dead workers of one run are replaced; each continues from the last checkpoint.
        device: where to train.
        monitor_every: steps between measurements of CA and PSNR; 0 for none.
        checkpoint_every: steps between checkpoints, the most that a dead worker costs.
        lpips: perceptual metric of the evaluation: None, ``"installed"``, or a weights file.
        say: receives a line about every run and every worker that died.

    Raises:
        ValueError: if ``retries`` is negative, or an interval out of range.
    """

    engine: Engine
    retries: int = 3
    device: str = "cpu"
    monitor_every: int = 500
    checkpoint_every: int = 500
    lpips: str | None = None
    say: Callable[[str], None] = lambda text: None

    def __post_init__(self) -> None:
        check_intervals(self.monitor_every, self.checkpoint_every)
        if self.retries < 0:
            raise ValueError(f"expected retries of at least 0, got {self.retries}.")


def run_grid(
    runs: Sequence[Run], running: Running, *, done: Callable[[Run, dict[str, Any]], None] = lambda run, results: None
) -> list[dict[str, Any] | Failure]:
    """Execute all runs; finished ones are read in this process instead.

    The folders of the runs are made here, so that a worker on another machine can tell whether it shares them.

    Args:
        runs: what to run.
        running: where and how.
        done: called in this process with each finished run and its results, before another run takes its place.

    Returns:
        For every run the content of ``results.json``, or its failure.
    """
    outcomes: dict[int, dict[str, Any] | Failure] = {}

    def note(number: int, outcome: Value | Failure, when: str) -> None:
        outcomes[number] = outcome.value if isinstance(outcome, Value) else outcome
        running.say(f"[{len(outcomes)}/{len(runs)}] {runs[number].label}: {_line(outcomes[number], when)}")
        if isinstance(outcome, Value):
            done(runs[number], outcome.value)

    tasks: dict[int, Task] = {}
    for number, run in enumerate(runs):
        if (run.out / RESULTS).exists():
            note(number, _read(run), "before")
        else:
            run.out.mkdir(parents=True, exist_ok=True)
            lpips = running.lpips if running.lpips in (None, "installed") else str(Path(running.lpips).resolve())
            how = {"device": running.device, "lpips": lpips, "monitor_every": running.monitor_every}
            how["checkpoint_every"] = running.checkpoint_every
            tasks[number] = Task(run.label, train_run, (*_where(run), chosen_engine(), how))
    numbers = list(tasks)
    for index, outcome in run_all(running.engine, list(tasks.values()), retries=running.retries, say=running.say):
        note(numbers[index], outcome, "now")
    for number in numbers:  # a run that failed here because another sweep held its folder may be finished by now
        if isinstance(outcomes[number], Failure) and (runs[number].out / RESULTS).exists():
            note(number, _read(runs[number]), "meanwhile")
    return [outcomes[number] for number in range(len(runs))]


def train_run(
    options: SceneOptions, config: TrainConfig, out: Path, engine: str, how: Mapping[str, Any]
) -> dict[str, Any]:
    """Start or continue one run in a worker; ``how`` is for `run_experiment`, ``engine`` for `use_engine`.

    Raises:
        FileNotFoundError: if the folder of the run does not exist, because this machine does not share it.
    """
    if not out.is_dir():
        raise FileNotFoundError(
            f"{out} is not on the machine of the worker: --out must be on a file system that all machines of the "
            f"cluster share under the same path, and so must the scenes."
        )
    use_engine(engine)  # a machine of a cluster has an environment of its own
    return run_experiment(options, config, out, **how)


def _read(run: Run) -> Value | Failure:
    """Return the results of a finished run, or a failure if it has other settings."""
    return attempt(Task(run.label, run_experiment, _where(run)), torch.get_num_threads())


def _where(run: Run) -> tuple[SceneOptions, TrainConfig, Path]:
    """Return scene, training and folder of a run with absolute paths: a worker's working directory may differ."""
    return run.options.absolute(), run.config, run.out.resolve()


def _line(outcome: dict[str, Any] | Failure, when: str) -> str:
    """Summarize an outcome in one line."""
    if isinstance(outcome, Failure):
        return f"FAILED, {outcome.error}"
    mean = outcome["mean"]
    psnr = mean["test" if "test" in mean else "train"].get("psnr")
    quality = "no PSNR" if psnr is None else f"{psnr:.2f} dB"
    return f"{quality}, finished {when}" if when != "now" else f"{quality} in {outcome['seconds']:.0f} s"
