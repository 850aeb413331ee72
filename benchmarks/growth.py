"""How time and memory of a rendering grow with the Gaussians, the pixels, and the Gaussians at a pixel.

``OMP_NUM_THREADS=1 python -m benchmarks.growth``.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import tyro

from benchmarks.calls import PASSES, gradients, image, processor_clock, render_with
from benchmarks.memory import peak_memory
from benchmarks.workloads import WORKLOADS, WorkloadSpec, covered_pairs
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.style import new_figure
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.render.engine import engines_on
from reference_trainer.studies.study import in_turns

__all__ = [
    "Axis",
    "Fit",
    "calibrated",
    "extrapolated",
    "fit_exponent",
    "fits",
    "gaussians_per_pixel",
    "growth",
    "growth_axes",
    "growth_figure",
    "growth_tables",
    "measure_growth",
]

_SAMPLE = 10_000  # Gaussians that are counted; they are independent, so their number only scales the count
_TOLERANCE = 0.01
_ATTEMPTS = 60
_PER_PIXEL = 45.0  # as in the standard workloads
_GAUSSIANS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
_SIDES = (64, 128, 256, 512, 1024)
_LISTS = (15.0, 45.0, 150.0, 450.0, 1500.0)
_MEDIUM = WORKLOADS["medium"]


class Axis(NamedTuple):
    """One quantity that grows.

    Args:
        title: what grows and what stays.
        unit: of what grows.
        points: workloads by how much there is of it, in growing order.
    """

    title: str
    unit: str
    points: dict[float, WorkloadSpec]


def growth_axes(largest: int) -> dict[str, Axis]:
    """Choose the workloads.

    Args:
        largest: number of Gaussians that none exceeds.

    Returns:
        Axes by name: "gaussians" (of shrinking size, so that as many as before cover a pixel), "layers" (Gaussians of
        the same size, so that the lists grow with them), "pixels" and "lists" (the same Gaussians grow).

    Raises:
        ValueError: if ``largest`` is below the smallest workload.
    """
    numbers = [n for n in _GAUSSIANS if n <= largest]
    if not numbers:
        raise ValueError(f"largest must be at least {_GAUSSIANS[0]} Gaussians, got {largest}.")
    some = min(_MEDIUM.gaussians, largest)
    width, height = _MEDIUM.width, _MEDIUM.height
    return {
        "gaussians": Axis(
            f"Gaussians, 512x512, {_PER_PIXEL:g} of them at a pixel",
            "Gaussians",
            {n: calibrated(n, 512, 512, _PER_PIXEL) for n in numbers},
        ),
        "layers": Axis(
            f"Gaussians of constant size, {width}x{height}",
            "Gaussians",
            {n: WorkloadSpec(n, width, height, _MEDIUM.base_scale) for n in numbers},
        ),
        "pixels": Axis(
            f"pixels, {some} Gaussians, {_PER_PIXEL:g} of them at a pixel",
            "pixels",
            {side * side: calibrated(some, side, side, _PER_PIXEL) for side in _SIDES},
        ),
        "lists": Axis(
            f"Gaussians at a pixel, {some} of growing size, {width}x{height}",
            "Gaussians at a pixel",
            {x: calibrated(some, width, height, x) for x in _LISTS},
        ),
    }


def gaussians_per_pixel(spec: WorkloadSpec) -> float:
    """Return how many Gaussians reach an alpha of 1/255 at the mean pixel, estimated from 10,000 of them."""
    counted = min(spec.gaussians, _SAMPLE)
    pairs = covered_pairs(WorkloadSpec(counted, spec.width, spec.height, spec.base_scale).make())
    return pairs * spec.gaussians / counted / (spec.width * spec.height)


def calibrated(gaussians: int, width: int, height: int, per_pixel: float) -> WorkloadSpec:
    """Choose the scale at which so many Gaussians reach the mean pixel, to 1 percent.

    Args:
        gaussians: number of them.
        width: of the picture, pixels.
        height: of the picture, pixels.
        per_pixel: how many shall reach an alpha of 1/255 at the mean pixel.

    Raises:
        ValueError: if even points, which are drawn about a pixel wide, cover more, or all of them together less.

    Example:
        >>> spec = calibrated(2_000, 128, 128, 45.0)
        >>> round(spec.base_scale / WORKLOADS["small"].base_scale, 1)
        1.0
    """
    scale = (per_pixel / gaussians) ** 0.5 / 7  # near the answer while Gaussians are wider than a pixel
    for _ in range(_ATTEMPTS):
        spec = WorkloadSpec(gaussians, width, height, scale)
        ratio = per_pixel / gaussians_per_pixel(spec)
        if abs(ratio - 1) <= _TOLERANCE:
            return spec
        # The area grows with the square of the scale or more slowly, so this never steps over the answer.
        scale *= ratio**0.5
    raise ValueError(
        f"{gaussians} Gaussians on {width}x{height} pixels cannot be {per_pixel:g} at the mean pixel: "
        "choose a number between what points cover and all of them."
    )


_MIB = 1 << 20
_FEWEST = 3  # points of a fit: a line through two has no error


@dataclass(frozen=True)
class Fit:
    """A power law y = c x^exponent over the upper part of a measurement.

    Args:
        exponent: slope in log-log.
        std_error: its standard error, from the residuals.
        start: smallest x that was used.
        end: largest x.
        points: how many were used.
        at_end: the fitted y at the largest x.
    """

    exponent: float
    std_error: float
    start: float
    end: float
    points: int
    at_end: float

    def __call__(self, x: float) -> float:
        """Return the fitted y at an x."""
        return float(self.at_end * (x / self.end) ** self.exponent)


def fit_exponent(points: Mapping[float, float]) -> Fit | None:
    """Fit a power law to the upper half of the points, at least three, by least squares in log-log.

    Args:
        points: positive y by positive x.

    Returns:
        The fit; None if there are fewer than three points.

    Example:
        >>> fit = fit_exponent({x: 3 * x**1.5 for x in (1, 10, 100, 1000)})
        >>> round(fit.exponent, 6), fit.start, fit.points
        (1.5, 10, 3)
    """
    xs = sorted(points)[-max(_FEWEST, math.ceil(len(points) / 2)) :]
    if len(xs) < _FEWEST:
        return None
    line, covariance = np.polyfit(np.log(xs), np.log([points[x] for x in xs]), 1, cov=True)
    slope, error = float(line[0]), math.sqrt(covariance[0, 0])
    return Fit(slope, error, xs[0], xs[-1], len(xs), math.exp(np.polyval(line, math.log(xs[-1]))))


class _Curve(NamedTuple):
    """One quantity along an axis: the time or the peak memory of a pass of an engine."""

    name: str
    engine: str
    what: str
    values: dict[float, float]


def _curves(points: Sequence[Mapping[str, Any]]) -> Iterator[_Curve]:
    """Yield what was measured along an axis; points that were left out, and unknown memory, are not in it."""
    measured = [p for p in points if "skipped" not in p]
    for engine in dict.fromkeys(e for p in measured for e in p["medians"]):
        for x in PASSES:
            times = {p["x"]: p["medians"][engine][x] for p in measured}
            yield _Curve(f"{engine}, {x}, time", engine, "time", times)
            memory = {p["x"]: p["memory"][engine][x] / _MIB for p in measured if p["memory"][engine]}
            yield _Curve(f"{engine}, {x}, memory", engine, "memory", {n: y for n, y in memory.items() if y > 0})


def fits(points: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Fit times (seconds) and peaks of the memory (MiB) of an axis, where there are enough points.

    Args:
        points: of an axis in the report.

    Returns:
        Fits as plain data by "loops, forward, time", "loops, forward, memory" and so on.
    """
    found = {curve.name: fit_exponent(curve.values) for curve in _curves(points)}
    return {name: asdict(fit) for name, fit in found.items() if fit is not None}


def growth_tables(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown: the exponents, and every axis."""
    machine, axes = report["machine"], report["axes"]
    rows = [row for axis in axes.values() for row in _exponents(axis)]
    lines = [
        f"{report['date']}, {report['device']}, {machine['threads']} threads, {machine['cpu']}, torch "
        f"{machine['torch']}. Medians of {report['repeats']} rounds, float32. Exponents of a power law over the upper "
        "half of the points, at least three, by least squares in log-log; memory is the peak above the inputs.",
        "",
    ]
    lines += [markdown_table(rows, list(rows[0])).rstrip()] if rows else []
    for axis in axes.values():
        lines += ["", f"### {axis['title']}", ""]
        rows = [_row(axis["unit"], point) for point in axis["points"] if "skipped" not in point]
        lines += [markdown_table(rows, list(rows[0])).rstrip(), ""] if rows else []
        for point in axis["points"]:
            if "skipped" in point:
                lines += [f"- {point['x']:.10g} {axis['unit']}: left out, {point['skipped']}."]
    return "\n".join([*lines, ""])


def _exponents(axis: Mapping[str, Any]) -> Iterator[dict[str, object]]:
    """Yield the row of every engine, of the gradient."""
    for curve in _curves(axis["points"]):
        time = axis["fits"].get(curve.name)
        if curve.what == "time" and curve.name.startswith(f"{curve.engine}, {PASSES[1]}") and time:
            memory = axis["fits"].get(curve.name.replace("time", "memory"))
            last = max(curve.values)
            yield {
                "against": axis["title"],
                "engine": curve.engine,
                "range of the fit": f"{time['start']:.10g} to {time['end']:.10g}",
                f"{PASSES[1]}: time": f"{time['exponent']:.2f} ± {time['std_error']:.2f}",
                "memory": memory and f"{memory['exponent']:.2f} ± {memory['std_error']:.2f}",
                "at the largest point": f"{curve.values[last]:.2g} s"
                + (f", {memory['at_end']:.0f} MiB" if memory else ""),
            }


def _row(unit: str, point: Mapping[str, Any]) -> dict[str, object]:
    """Return times and memory of a measured point."""
    row: dict[str, object] = {unit: f"{point['x']:.10g}", "at a pixel": point["per_pixel"]}
    for curve in _curves([point]):
        value = curve.values.get(point["x"])
        row[curve.name.replace("time", "ms").replace("memory", "MiB")] = (
            value * 1e3 if value is not None and curve.what == "time" else value
        )
    return row


def growth_figure(report: Mapping[str, Any], path: Path) -> None:
    """Plot times above and memory below, one column per axis, with the fitted lines.

    Args:
        report: what `measure_growth` returns.
        path: the PNG to write.
    """
    with new_figure(path) as figure:
        _plot(report["axes"], figure)


def _plot(axes: Mapping[str, Any], figure: Any) -> None:
    """Plot all axes."""
    figure.set_size_inches(4.2 * len(axes), 7.5)
    panels = figure.subplots(2, len(axes), squeeze=False, sharex="col")
    for column, axis in enumerate(axes.values()):
        for i, curve in enumerate(_curves(axis["points"])):
            panel = panels[int(curve.what == "memory"), column]
            fit, label = axis["fits"].get(curve.name), curve.name.rpartition(", ")[0]
            if fit is not None:
                label = f"{label}: {fit['exponent']:.2f} ± {fit['std_error']:.2f}"
                ends = (fit["start"], fit["end"])
                panel.plot(ends, [Fit(**fit)(x) for x in ends], "-", color=f"C{i // 2}", linewidth=1)
            panel.plot(curve.values.keys(), curve.values.values(), "o", color=f"C{i // 2}", label=label, markersize=4)
        panels[0, column].set_title(axis["title"], fontsize="small")
        panels[1, column].set_xlabel(axis["unit"])
        for panel in panels[:, column]:
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.grid(alpha=0.3)
            if panel.get_legend_handles_labels()[0]:
                panel.legend(fontsize="x-small")
    panels[0, 0].set_ylabel("seconds")
    panels[1, 0].set_ylabel("peak memory above the inputs, MiB")


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
        engine: what renders; the limit stops both at what is too slow for one.
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
            print(f"{name}: measured before, kept")
        elif expected > time_limit:
            reason = f"it would take about {expected:.2g} s, extrapolated; the limit is {time_limit:g} s"
            print(f"{name}: left out, {reason}")
            return {"skipped": reason}
        else:
            print(f"{name}: {spec.gaussians} Gaussians, {spec.width}x{spec.height}")
            measured[name] = {"settings": wanted, **measure_workload(spec, engines, repeats=repeats, device=place)}
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
    print(growth_tables(report))
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


def measure_workload(
    spec: WorkloadSpec, engines: Sequence[str], *, repeats: int, device: torch.device
) -> dict[str, Any]:
    """Measure times and memory of a workload, rendered by every engine."""
    workload = spec.make().to(device)
    calls = {
        (engine, x): partial(call, render_with(engine), workload)
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
