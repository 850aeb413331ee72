"""Runs that are killed with SIGKILL at random moments, and what must be true of what they leave."""

from __future__ import annotations

import multiprocessing
import random
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from ca_reg._log import read_log
from ca_reg.monitor import LOG_NAME
from reference_trainer.json_files import read_json
from reference_trainer.model.ply import load_ply
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.run import CHECKPOINT, RESULTS, run_experiment
from reference_trainer.training.checkpoint import load_checkpoint
from reference_trainer.training.config import TrainConfig

__all__ = ["Outcome", "Settings", "campaign", "differences"]


@dataclass(frozen=True)
class Settings:
    """The run that is killed.

    Args:
        scene: what it trains on.
        config: how.
        monitor_every: steps between measurements.
        checkpoint_every: steps between checkpoints.
        threads: of its process.
    """

    scene: SceneOptions
    config: TrainConfig
    monitor_every: int
    checkpoint_every: int
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


def campaign(settings: Settings, folder: Path, kills: int, *, seed: int = 0) -> Outcome:
    """Kill runs until so many kills are done, and then let the last one come to its end.

    Args:
        settings: of the runs.
        folder: an empty one.
        kills: how many.
        seed: of the moments, from the begin of a process to half of the time of a whole run, more of them early: so
            that a run is killed several times before it comes to its end.
    """
    context = multiprocessing.get_context("forkserver")  # imports once, and forks the runs from there
    context.set_forkserver_preload([__name__])
    whole, draw, out = folder / "whole", random.Random(seed), Outcome()

    def start(place: Path) -> Any:
        process = context.Process(target=_run, args=(settings, place))
        process.start()
        return process

    begin = time.perf_counter()
    process = start(whole)
    process.join()
    if process.exitcode != 0:
        raise RuntimeError("the uninterrupted run failed, see above")
    seconds = time.perf_counter() - begin
    run, step = folder / "run_0", -1
    while out.kills < kills or out.finished == 0 or run.exists():
        process = start(run)
        process.join(0.5 * seconds * draw.random() ** 2 if out.kills < kills else None)
        process.kill()  # no effect on a process that has ended
        process.join()
        if process.exitcode < 0:
            out.kills += 1
            step = _inspect(run, step, out)
            continue
        if process.exitcode == 0:
            out.defects += [f"{run.name}: {text}" for text in differences(run, whole)]
        else:
            out.defects.append(f"{run.name} did not continue after a kill at step {step}, see above")
        out.finished += 1
        run, step = folder / f"run_{out.finished}", -1
    return out


def differences(run: Path, whole: Path) -> list[str]:
    """Return what two finished runs differ in, but for the time they took."""
    names = [sorted(str(p.relative_to(f)) for p in f.rglob("*") if "tfevents" not in p.name) for f in (run, whole)]
    found = [] if names[0] == names[1] else [f"files {sorted(set(names[0]) ^ set(names[1]))}"]
    for name in sorted(set(names[0]) & set(names[1])):
        one, other = run / name, whole / name
        if name == CHECKPOINT:
            left, right = load_checkpoint(one), load_checkpoint(other)
            same = _same({**left, "seconds": 0}, {**right, "seconds": 0})
        elif name == RESULTS:
            left, right = read_json(one), read_json(other)
            same = {**left, "seconds": 0} == {**right, "seconds": 0}
        else:
            same = one.is_dir() or one.read_bytes() == other.read_bytes()
        found += [] if same else [name]
    return found


def _run(settings: Settings, out: Path) -> None:
    """Begin or continue the run: what the killed process does."""
    torch.set_num_threads(settings.threads)
    run_experiment(
        settings.scene,
        settings.config,
        out,
        monitor_every=settings.monitor_every,
        checkpoint_every=settings.checkpoint_every,
    )


def _inspect(run: Path, step: int, out: Outcome) -> int:
    """Read everything that a killed run has left; return the step of its checkpoint."""
    files = [path for path in run.rglob("*") if path.is_file()]
    out.half_written += any(path.suffix in (".part", ".tmp") for path in files)
    before = step
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
            out.defects.append(f"{run.name}, {path.name} after a kill: {error}")
    if step < before:
        out.defects.append(f"{run.name}: the checkpoint went back from step {before} to {step}")
    evaluating = any(path.suffix == ".ply" for path in files)
    out.moments["evaluating" if evaluating else "training" if step >= 0 else "before the first checkpoint"] += 1
    return step


def _same(one: Any, other: Any) -> bool:
    """Whether two nested dicts are equal, tensors bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(x, other[key]) for key, x in one.items())
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return bool(one == other)
