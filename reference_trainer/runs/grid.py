"""Grids of runs: finished ones are kept, interrupted ones continue, failing ones do not stop the rest."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from reference_trainer.render import chosen_engine, use_engine
from reference_trainer.runs.executors import Executor, Failure, Task, Value, attempt, run_all
from reference_trainer.runs.folder import RESULTS
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["Run", "Running", "outcome_line", "run_grid", "train_run"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """One run of a grid: its label for messages, its scene and training, and its folder, unique within the grid.

    What is measured and saved on the way is what the grid says, or what the run itself says.
    """

    label: str
    options: SceneOptions
    config: TrainConfig
    out: Path
    monitoring: Monitoring | None = None


@dataclass(frozen=True)
class Running:
    """How the runs of a grid are executed; this does not affect what is trained.

    Args:
        executor: where to run.
        retries: how many dead workers of one run are replaced; each continues from the last checkpoint.
        device: where to train.
        monitoring: what is measured and saved on the way.
        lpips: perceptual metric of the evaluation: None, ``"installed"``, or a weights file.
        auto: leave out what the scene does not need (`make_plan`).
        progress: whether the first run that is trained shows a progress bar.

    Raises:
        ValueError: if ``retries`` is negative.
    """

    executor: Executor
    retries: int = 3
    device: str = "cpu"
    monitoring: Monitoring = Monitoring()  # noqa: RUF009, frozen
    lpips: str | None = None
    auto: bool = False
    progress: bool = False

    def __post_init__(self) -> None:
        if self.retries < 0:
            raise ValueError(f"expected retries of at least 0, got {self.retries}.")


def run_grid(
    runs: Sequence[Run], running: Running, *, done: Callable[[Run, dict[str, Any]], None] = lambda run, results: None
) -> list[dict[str, Any] | Failure]:
    """Execute all runs; finished ones are read in this process instead.

    The folders of the runs are made here, so that a worker on another machine can tell whether it shares them.

    ``done`` is called in this process with each finished run and its results, before another run takes its place.
    Returns, for every run, the content of ``results.json`` or its failure.
    """
    outcomes: dict[int, dict[str, Any] | Failure] = {}

    def note(number: int, outcome: Value | Failure, when: str) -> None:
        outcomes[number] = outcome.value if isinstance(outcome, Value) else outcome
        line = outcome_line(outcomes[number], when)
        _log.info("[%d/%d] %s: %s", len(outcomes), len(runs), runs[number].label, line)
        if isinstance(outcome, Value):
            done(runs[number], outcome.value)

    tasks: dict[int, Task] = {}
    for number, run in enumerate(runs):
        if (run.out / RESULTS).exists():
            note(number, _read(run, running), "before")
        else:
            run.out.mkdir(parents=True, exist_ok=True)
            lpips = running.lpips if running.lpips in (None, "installed") else str(Path(running.lpips).resolve())
            how: dict[str, Any] = {"device": running.device, "lpips": lpips, "auto": running.auto}
            how |= {"monitoring": run.monitoring or running.monitoring, "progress": running.progress and not tasks}
            tasks[number] = Task(run.label, train_run, (*_where(run), chosen_engine(), how))
    numbers = list(tasks)
    for index, outcome in run_all(running.executor, list(tasks.values()), retries=running.retries):
        note(numbers[index], outcome, "now")
    for number in numbers:  # a run that failed here because another sweep held its folder may be finished by now
        if isinstance(outcomes[number], Failure) and (runs[number].out / RESULTS).exists():
            note(number, _read(runs[number], running), "meanwhile")
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


def _read(run: Run, running: Running) -> Value | Failure:
    """Return the results of a finished run, or a failure if it has other settings."""
    read = functools.partial(run_experiment, auto=running.auto)
    return attempt(Task(run.label, read, _where(run)), torch.get_num_threads())


def _where(run: Run) -> tuple[SceneOptions, TrainConfig, Path]:
    """Return scene, training and folder of a run with absolute paths: a worker's working directory may differ."""
    return run.options.absolute(), run.config, run.out.resolve()


def outcome_line(outcome: dict[str, Any] | Failure, when: str) -> str:
    """Summarize an outcome in one line."""
    if isinstance(outcome, Failure):
        return f"FAILED, {outcome.error}"
    mean = outcome["mean"]
    psnr = mean["test" if "test" in mean else "train"].get("psnr")
    quality = "no PSNR" if psnr is None else f"{psnr:.2f} dB"
    return f"{quality}, finished {when}" if when != "now" else f"{quality} in {outcome['seconds']:.0f} s"
