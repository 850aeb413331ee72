"""Runs that are killed, and what must be true of what they leave."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from ca_reg.monitor import LOG_NAME, read_log
from reference_trainer.json_files import read_json
from reference_trainer.model.ply import load_ply
from reference_trainer.runs.folder import CHECKPOINT, LOCK, RESULTS
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.checkpoint import load_checkpoint
from reference_trainer.training.config import TrainConfig

__all__ = ["Outcome", "Settings", "differences", "inspect", "run", "start"]

_USED_BY_RUNS = ("matplotlib", "torch._dynamo", "torch.utils.tensorboard", "PIL.PngImagePlugin", "kornia.core.check")
_TIMES = {"seconds": 0, "processor_seconds": 0}
_NO_RESULTS = ("events.out.tfevents", LOCK)  # TensorBoard's own files, and who was at work there


@dataclass(frozen=True)
class Settings:
    """The run that is killed.

    Args:
        scene: what it trains on.
        config: how.
        monitor_every: steps between measurements.
        checkpoint_every: steps between checkpoints.
        auto: whether it makes a plan.
        threads: of its process.
    """

    scene: SceneOptions
    config: TrainConfig
    monitor_every: int
    checkpoint_every: int
    auto: bool = False
    threads: int = 1


@dataclass
class Outcome:
    """What a campaign found.

    Args:
        kills: processes killed.
        finished: runs that came to their end in spite of that; each was compared with the uninterrupted one.
        half_written: kills that left a file half written, beside the one that it was to replace.
        moments: how many kills found how far a run was.
        defects: what should not have been.
    """

    kills: int = 0
    finished: int = 0
    half_written: int = 0
    moments: Counter[str] = field(default_factory=Counter)
    defects: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        where = ", ".join(f"{count} {moment}" for moment, count in self.moments.most_common())
        lines = [
            f"{self.kills} kills ({where}), {self.half_written} in the middle of writing a file",
            f"{self.finished} runs came to their end, compared bit for bit with the uninterrupted one",
            f"{len(self.defects)} defects",
        ]
        return "\n    ".join(["\n".join(lines), *self.defects])


def start(target: Callable[..., None], *arguments: Any) -> Any:
    """Start a process that is killed."""
    context = multiprocessing.get_context("forkserver")  # imports once, and forks the runs from there
    context.set_forkserver_preload([__name__, *_USED_BY_RUNS])
    process = context.Process(target=target, args=arguments)
    process.start()
    return process


def run(settings: Settings, out: Path) -> None:
    """Begin or continue the run: what the killed process does."""
    torch.set_num_threads(settings.threads)
    run_experiment(
        settings.scene,
        settings.config,
        out,
        auto=settings.auto,
        monitoring=Monitoring(settings.monitor_every, checkpoint_every=settings.checkpoint_every),
    )


def inspect(run: Path, step: int, out: Outcome, *, name: str) -> int:
    """Read everything that a killed run has left and count the kill; return the step of its checkpoint.

    Args:
        run: its folder.
        step: of its checkpoint at the kill before, -1 for none.
        out: receives what is found.
        name: of the run in the defects.
    """
    files = [path for path in run.rglob("*") if path.is_file()]
    out.kills += 1
    out.half_written += any(path.suffix in (".part", ".tmp") for path in files)
    before, step = step, -1
    for path in files:
        try:
            if path.name == CHECKPOINT:
                step = load_checkpoint(path)["step"]
            elif path.suffix == ".json":
                read_json(path)
            elif path.suffix == ".ply":
                load_ply(path)
            elif path.suffix == ".png":
                Image.open(path).load()
            elif path.name == LOG_NAME:
                list(read_log(path))
        except (ValueError, OSError) as error:
            out.defects.append(f"{name}: {path.name} after a kill: {error}")
    if step < before:
        out.defects.append(f"{name}: the checkpoint went back from step {before} to {step}")
    evaluating = any(path.suffix == ".ply" for path in files)
    out.moments["evaluating" if evaluating else "training" if step >= 0 else "before the first checkpoint"] += 1
    return step


def differences(run: Path, whole: Path) -> list[str]:
    """Return what two finished runs differ in, but for the time they took."""
    names = [
        sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if not path.name.startswith(_NO_RESULTS))
        for folder in (run, whole)
    ]
    found = [] if names[0] == names[1] else [f"files {sorted(set(names[0]) ^ set(names[1]))}"]
    for name in sorted(set(names[0]) & set(names[1])):
        one, other = run / name, whole / name
        if name == CHECKPOINT:
            left, right = load_checkpoint(one), load_checkpoint(other)
            same = _same({**left, **_TIMES}, {**right, **_TIMES})
        elif name == RESULTS:
            left, right = read_json(one), read_json(other)
            same = {**left, **_TIMES} == {**right, **_TIMES}
        else:
            same = one.is_dir() or one.read_bytes() == other.read_bytes()
        found += [] if same else [name]
    return found


def _same(one: Any, other: Any) -> bool:
    """Whether two nested dicts are equal, tensors bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(x, other[key]) for key, x in one.items())
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return bool(one == other)
