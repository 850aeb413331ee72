"""How time and memory of a rendering grow with the Gaussians, the pixels, and the Gaussians at a pixel."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from reference_trainer.evaluation.report import machine, write_json
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.studies.speed.calls import SUBJECT, gradients, image
from reference_trainer.studies.speed.growth_memory import count, predict
from reference_trainer.studies.speed.growth_points import Axis, gaussians_per_pixel, growth_axes
from reference_trainer.studies.speed.growth_report import fits, growth_figure, growth_tables
from reference_trainer.studies.speed.measure import PASSES
from reference_trainer.studies.speed.memory import peak_memory
from reference_trainer.studies.speed.workloads import WorkloadSpec
from reference_trainer.studies.timing import in_turns

__all__ = ["extrapolated", "study", "study_growth"]

REPORT = "growth.json"
TABLE = "growth.md"
FIGURE = "growth.png"

_ONE = WorkloadSpec(1, 8, 8, 0.01)  # what it takes, the libraries take
_THRESHOLD = "MALLOC_MMAP_THRESHOLD_"  # of glibc, bytes
_MEMORY_ROUNDS = 2  # each of the two measurements of the memory is a rendering and a gradient

Say = Callable[[str], None]


def study_growth(
    out: Path,
    *,
    largest: int = 1_000_000,
    repeats: int = 3,
    time_limit: float = 300.0,
    device: str = "cpu",
    say: Say = print,
) -> dict[str, Any]:
    """Measure how time and memory grow, along the axes of `growth_axes`, see `study`.

    Args:
        out: folder for the results.
        largest: number of Gaussians that no workload exceeds.
        repeats: number of timed rounds, at least 1.
        time_limit: seconds that a single workload may take in all; larger ones are left out.
        device: where to render, "cpu" or "cuda".
        say: receives the progress and the tables.

    Raises:
        ValueError: as `growth_axes` and `study`.
    """
    axes = growth_axes(largest)
    return study(axes, out, repeats=repeats, time_limit=time_limit, device=device, say=say)


def study(
    axes: Mapping[str, Axis],
    out: Path,
    *,
    repeats: int = 3,
    time_limit: float = 300.0,
    device: str = "cpu",
    say: Say = print,
) -> dict[str, Any]:
    """Measure the workloads of every axis, and write ``growth.json``, ``growth.md`` and ``growth.png``.

    Each finished workload is written at once. One that is in the JSON file already, with the same settings, threads and
    device, is not measured again: delete the file after a change of the renderer. A workload whose time, extrapolated
    from the smaller ones of its axis, exceeds the limit is left out, and the report says so.

    Args:
        axes: by name.
        out: folder for the results.
        repeats: number of timed rounds, at least 1.
        time_limit: seconds that a single workload may take in all.
        device: where to render.
        say: receives the progress and the tables.

    Returns:
        The content of ``growth.json``: "axes" by name, each with "points" in growing order and "fits".

    Raises:
        ValueError: if there is no axis, or ``repeats`` or ``time_limit`` is not positive.
    """
    if not axes or repeats < 1 or not time_limit > 0:
        raise ValueError(
            f"expected at least 1 axis, 1 round and a positive limit, got {len(axes)}, {repeats} and {time_limit}."
        )
    file, place = out / REPORT, torch.device(device)
    measured: dict[str, Any] = read_json(file)["measured"] if file.exists() else {}
    settings = {"repeats": repeats, "device": str(place), "threads": torch.get_num_threads()}

    def once(name: str, spec: WorkloadSpec, expected: float) -> dict[str, Any]:
        """Measure, or take what was measured with the same settings; leave out what is expected to take too long."""
        wanted = {"spec": asdict(spec), **settings}
        if measured.get(name, {}).get("settings") == wanted:
            say(f"{name}: measured before, kept")
        elif expected > time_limit:
            reason = f"it would take about {expected:.2g} s, extrapolated; the limit is {time_limit:g} s"
            say(f"{name}: left out, {reason}")
            return {"skipped": reason}
        else:
            say(f"{name}: {spec.gaussians} Gaussians, {spec.width}x{spec.height}")
            measured[name] = {"settings": wanted, **_measure(spec, repeats=repeats, device=place)}
            write_json(file, {"measured": measured})
        return {key: value for key, value in measured[name].items() if key != "settings"}

    libraries = once("libraries", _ONE, 0.0)["memory"]["tensors"]
    results: dict[str, Any] = {}
    for name, axis in axes.items():
        points: list[dict[str, Any]] = []
        seconds: dict[float, float] = {}  # of one rendering and one gradient
        for x, spec in axis.points.items():
            expected = (repeats + 1 + _MEMORY_ROUNDS) * extrapolated(seconds, x)
            point = once(f"{name} {x:.10g}", spec, expected)
            if "skipped" not in point:
                seconds[x] = sum(point["medians"].values())
                point["memory"] = _without(point["memory"], libraries)
            points.append({"x": x, **point})
        results[name] = {"title": axis.title, "unit": axis.unit, "points": points, "fits": fits(points)}
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": place.type,
        "machine": machine(),
        "repeats": repeats,
        "libraries": libraries,
        "axes": results,
        "measured": measured,
    }
    write_json(file, report)
    text = growth_tables(report)
    write_text(out / TABLE, text)
    growth_figure(report, out / FIGURE)
    say(text)
    say(f"numbers, tables and figure: {file}, {out / TABLE}, {out / FIGURE}")
    return report


def extrapolated(seconds: Mapping[float, float], x: float) -> float:
    """Extrapolate a time from the last two, at least in proportion: what grows later is not seen in small ones.

    Args:
        seconds: by size, in growing order.
        x: the next size.

    Returns:
        Seconds; 0 if there is nothing to extrapolate from.

    Example:
        >>> extrapolated({10: 1.0, 20: 4.0}, 40), extrapolated({10: 1.0, 20: 1.1}, 40)
        (16.0, 2.2)
    """
    if not seconds:
        return 0.0
    last, exponent = list(seconds)[-1], 1.0
    if len(seconds) > 1:
        before = list(seconds)[-2]
        exponent = max(exponent, math.log(seconds[last] / seconds[before]) / math.log(last / before))
    return float(seconds[last] * (x / last) ** exponent)


def _measure(spec: WorkloadSpec, *, repeats: int, device: torch.device) -> dict[str, Any]:
    """Measure times and memory of a workload, and evaluate the formula for it."""
    workload = spec.make().to(device)
    counts = count(workload)
    calls = {PASSES[0]: lambda: image(SUBJECT, workload), PASSES[1]: lambda: gradients(SUBJECT, workload)}
    seconds = in_turns(calls, repeats, device)
    return {
        "per_pixel": gaussians_per_pixel(spec),
        "counts": {**asdict(counts), "chunks": [list(sizes) for sizes in counts.chunks]},  # as JSON gives them back
        "seconds": seconds,
        "medians": {name: statistics.median(times) for name, times in seconds.items()},
        "formula": {name: peak._asdict() for name, peak in predict(counts).items()},
        "memory": _memory(spec, device),
    }


def _memory(spec: WorkloadSpec, device: torch.device) -> dict[str, dict[str, int] | None]:
    """Measure the peaks of the "tensors" and, on a CPU, of the whole "process"."""
    if device.type == "cuda":
        return {"tensors": peak_memory(spec, device), "process": None}
    with _every_tensor_mapped():
        tensors = peak_memory(spec, device)
    return {"tensors": tensors, "process": peak_memory(spec, device)}


@contextmanager
def _every_tensor_mapped() -> Iterator[None]:
    """Let glibc, in processes started meanwhile, give freed tensors back at once instead of holding them back."""
    before = os.environ.get(_THRESHOLD)
    os.environ[_THRESHOLD] = str(1 << 16)
    try:
        yield
    finally:
        del os.environ[_THRESHOLD]
        if before is not None:
            os.environ[_THRESHOLD] = before


def _without(memory: Mapping[str, Any], libraries: Mapping[str, int] | None) -> dict[str, Any]:
    """Take what the libraries need off the peaks of the tensors."""
    tensors = memory["tensors"]
    if tensors is None or libraries is None:
        return dict(memory)
    return {**memory, "tensors": {name: max(0, tensors[name] - libraries[name]) for name in tensors}}
