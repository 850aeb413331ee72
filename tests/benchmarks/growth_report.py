"""Exponents, tables and the figure of the growth benchmark."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.calls import PASSES
from reference_trainer.evaluation.results import markdown_table
from reference_trainer.runs.figures import new_figure

__all__ = ["Fit", "fit_exponent", "fits", "growth_figure", "growth_tables"]

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
        Fits as plain data by "numba, forward, time", "numba, forward, memory" and so on.
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
    """Draw times above and memory below, one column per axis, with the fitted lines.

    Args:
        report: what `measure_growth` returns.
        path: the PNG to write.
    """
    with new_figure(path) as figure:
        _draw(report["axes"], figure)


def _draw(axes: Mapping[str, Any], figure: Any) -> None:
    """Draw all axes."""
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
