"""How time and memory of a rendering grow with the Gaussians, the pixels, and the Gaussians at a pixel.

``OMP_NUM_THREADS=1 PYTHONPATH=tests python -m benchmarks.growth``.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.calls import PASSES, draw_of, gradients, image
from benchmarks.growth_axes import Axis, gaussians_per_pixel, growth_axes
from benchmarks.growth_report import fits, growth_figure, growth_tables
from benchmarks.memory import peak_memory
from benchmarks.workloads import WorkloadSpec
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.render.engine import engines_on
from reference_trainer.studies.clocks import in_turns, processor_clock

__all__ = ["extrapolated", "growth", "measure_growth"]

REPORT, TABLE, FIGURE = "growth.json", "growth.md", "growth.png"
_MEMORY_ROUNDS = 1  # the measurement of the memory is a rendering and a gradient of each engine


def growth(
    out: Path = Path("runs/growth"),
    largest: int = 1_000_000,
    repeats: int = 3,
    time_limit: float = 300.0,
    device: str = "cpu",
    engine: Literal["all", "numba", "torch"] = "all",
) -> None:
    """Measure time and memory of the engines against Gaussians, pixels, and Gaussians per pixel, with exponents.

    Args:
        out: folder for the JSON, the tables and the figure; what is in it is not measured again.
        largest: number of Gaussians that no workload exceeds.
        repeats: rounds of which the medians are taken.
        time_limit: seconds that one point may take; larger ones are left out, with the reason.
        device: where to render, "cpu" or "cuda".
        engine: what draws; the limit stops both at what is too slow for one.
    """
    only = {} if engine == "all" else {"engines": (engine,)}
    measure_growth(growth_axes(largest), out, repeats=repeats, time_limit=time_limit, device=device, **only)


def measure_growth(
    axes: Mapping[str, Axis],
    out: Path,
    *,
    repeats: int = 3,
    time_limit: float = 300.0,
    device: str = "cpu",
    engines: Sequence[str] = (),
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Measure the workloads of every axis; see `growth`.

    Each finished workload is written at once. One that is in the JSON file already, with the same settings, threads and
    device, is not measured again: delete the file after a change of the renderer. A workload whose time, extrapolated
    from the smaller ones of its axis, exceeds the limit is left out, and the report says so.

    Returns:
        The content of ``growth.json``: "axes" by name, each with "points" in growing order and "fits".
    """
    file, place = out / REPORT, torch.device(device)
    measured: dict[str, Any] = read_json(file)["measured"] if file.exists() else {}
    engines = list(engines or engines_on(place))
    settings = {"repeats": repeats, "device": str(place), "engines": engines, "threads": torch.get_num_threads()}

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
            measured[name] = {"settings": wanted, **_measure(spec, engines, repeats=repeats, device=place)}
            write_json(file, {"measured": measured})
        return {key: value for key, value in measured[name].items() if key != "settings"}

    results: dict[str, Any] = {}
    for name, axis in axes.items():
        points: list[dict[str, Any]] = []
        seconds: dict[float, float] = {}  # of one rendering and one gradient by every engine
        for x, spec in axis.points.items():
            point = once(f"{name} {x:.10g}", spec, (repeats + 1 + _MEMORY_ROUNDS) * extrapolated(seconds, x))
            if "skipped" not in point:
                seconds[x] = sum(sum(passes.values()) for passes in point["medians"].values())
            points.append({"x": x, **point})
        results[name] = {"title": axis.title, "unit": axis.unit, "points": points, "fits": fits(points)}
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": place.type,
        "machine": machine(),
        "repeats": repeats,
        "axes": results,
        "measured": measured,
    }
    write_json(file, report)
    write_text(out / TABLE, growth_tables(report))
    growth_figure(report, out / FIGURE)
    say(growth_tables(report))
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


def _measure(spec: WorkloadSpec, engines: Sequence[str], *, repeats: int, device: torch.device) -> dict[str, Any]:
    """Measure times and memory of a workload, drawn by every engine."""
    workload = spec.make().to(device)
    calls = {
        (engine, x): partial(call, draw_of(engine), workload)
        for engine in engines
        for x, call in zip(PASSES, (image, gradients), strict=True)
    }
    seconds = in_turns({", ".join(name): call for name, call in calls.items()}, repeats, processor_clock(device))
    return {
        "per_pixel": gaussians_per_pixel(spec),
        "seconds": seconds,
        "medians": {e: {x: statistics.median(seconds[f"{e}, {x}"]) for x in PASSES} for e in engines},
        "memory": {engine: peak_memory(spec, engine, device) for engine in engines},
    }


if __name__ == "__main__":
    tyro.cli(growth)
