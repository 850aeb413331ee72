"""The speed study: measure, write, compare with an older measurement."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from reference_trainer.evaluation.report import machine, write_json
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.speed.limits import measure_limits
from reference_trainer.studies.speed.measure import measure_workload
from reference_trainer.studies.speed.report import regressions, speed_tables
from reference_trainer.studies.speed.steps import similarity, training_step
from reference_trainer.studies.speed.workloads import WORKLOADS, WorkloadSpec

__all__ = ["study", "study_speed"]

REPORT = "speed.json"
TABLE = "speed.md"

Say = Callable[[str], None]


def study_speed(
    out: Path,
    *,
    workloads: Sequence[str] = ("small", "medium"),
    scene: SceneOptions | None = None,
    repeats: int = 7,
    device: str = "cpu",
    against: Path | None = None,
    say: Say = print,
) -> dict[str, Any]:
    """Measure the speed of the renderer on the standard workloads, see `study`.

    Args:
        out: folder for the results.
        workloads: names of `WORKLOADS`. "large" takes minutes, nearly all of them in the baseline, whose gradient keeps
            about 2.5 GB.
        scene: of the training step; the built-in scene by default.
        repeats: number of timed rounds, at least 1.
        device: where to render, "cpu" or "cuda".
        against: an older ``speed.json`` to compare with.
        say: receives the progress and the tables.

    Raises:
        ValueError: if there is no such workload, or as `study`.
        RuntimeError: as `study`.
    """
    if unknown := [name for name in workloads if name not in WORKLOADS]:
        raise ValueError(f"there is no workload {unknown[0]!r}; choose among {', '.join(WORKLOADS)}.")
    specs = {name: WORKLOADS[name] for name in workloads}
    return study(specs, out, scene=scene, repeats=repeats, device=device, against=against, say=say)


def study(
    specs: Mapping[str, WorkloadSpec],
    out: Path,
    *,
    scene: SceneOptions | None = None,
    repeats: int = 7,
    device: str = "cpu",
    against: Path | None = None,
    say: Say = print,
) -> dict[str, Any]:
    """Measure workloads, and write ``speed.json`` and ``speed.md``.

    Args:
        specs: recipes of the workloads by name.
        out: folder for the results.
        scene: of the training step; the built-in scene by default.
        repeats: number of timed rounds, at least 1.
        device: where to render.
        against: an older ``speed.json``; the new numbers are written before they are compared.
        say: receives the progress and the tables.

    Returns:
        The content of ``speed.json``. Its "ratios" and "errors" are what later measurements are compared by.

    Raises:
        FileNotFoundError: if ``against`` is missing.
        ValueError: if there is no workload, ``repeats`` is not positive, ``against`` is another file, or as
            `regressions`.
        RuntimeError: if a ratio of times or an error has grown by more than `regressions` allows; lists them.
    """
    if not specs or repeats < 1:
        raise ValueError(f"expected at least 1 workload and 1 round, got {len(specs)} and {repeats}.")
    old = None if against is None else _read(against)
    place = torch.device(device)
    say("limits of the machine")
    limits = measure_limits(place, repeats=repeats)
    results = {}
    for name, spec in specs.items():
        say(f"{name}: {spec.gaussians} Gaussians, {spec.width}x{spec.height}")
        results[name] = measure_workload(spec, limits, repeats=repeats, device=place)
    say("structural similarity and training step")
    similar = similarity(repeats=repeats, device=place)
    step = training_step(scene or SceneOptions(), repeats=repeats, device=place)
    ratios = {f"{name}: {key}": x for name, result in results.items() for key, x in result.ratios().items()}
    ratios["ssim_map / kornia"] = statistics.median(
        a / b for a, b in zip(similar["ssim_map"], similar["kornia"], strict=True)
    )
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": place.type,
        "machine": machine(),
        "repeats": repeats,
        "limits": asdict(limits),
        "workloads": {name: result.as_dict() for name, result in results.items()},
        "similarity": similar,
        "training_step": step,
        "ratios": ratios,
        "errors": {f"{name}: {key}": x for name, result in results.items() for key, x in result.errors().items()},
    }
    write_json(out / REPORT, report)
    text = speed_tables(report)
    write_text(out / TABLE, text)
    say(text)
    say(f"numbers and tables: {out / REPORT}, {out / TABLE}")
    if old is not None:
        _check(regressions(report, old), against)
    return report


def _read(against: Path) -> dict[str, Any]:
    """Read an older report before minutes are spent on a new one."""
    old: dict[str, Any] = read_json(against)
    if missing := {"device", "machine", "ratios", "errors"} - old.keys():
        raise ValueError(f"{against} has no {sorted(missing)}: give a {REPORT} that this study has written.")
    return old


def _check(lines: Sequence[str], against: Path | None) -> None:
    """Raise if anything got worse."""
    if lines:
        raise RuntimeError(f"{len(lines)} numbers are worse than in {against}:\n" + "\n".join(f"  {x}" for x in lines))
