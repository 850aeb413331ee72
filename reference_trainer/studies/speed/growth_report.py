"""Exponents, tables and the figure of the growth study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reference_trainer.evaluation.report import markdown_table
from reference_trainer.files import replacing
from reference_trainer.render.footprints import PIXELS
from reference_trainer.studies.speed.growth_memory import PHASES
from reference_trainer.studies.speed.measure import PASSES

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
    u, v = [math.log(x) for x in xs], [math.log(points[x]) for x in xs]
    u_mean, v_mean = math.fsum(u) / len(u), math.fsum(v) / len(v)
    spread = math.fsum((a - u_mean) ** 2 for a in u)
    slope = math.fsum((a - u_mean) * (b - v_mean) for a, b in zip(u, v, strict=True)) / spread
    residual = math.fsum((b - v_mean - slope * (a - u_mean)) ** 2 for a, b in zip(u, v, strict=True))
    error = math.sqrt(residual / (len(xs) - 2) / spread)
    return Fit(slope, error, xs[0], xs[-1], len(xs), math.exp(v_mean + slope * (u[-1] - u_mean)))


def fits(points: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Fit the times and the peaks of the memory of an axis, where there are enough points.

    Args:
        points: of an axis in the report.

    Returns:
        Fits as plain data by "forward, time", "forward, memory" and so on.
    """
    found = {
        f"{x}, {what}": fit_exponent(values)
        for x in PASSES
        for what, values in (("time", _times(points, x)), ("memory", _tensors(points, x)))
    }
    return {name: asdict(fit) for name, fit in found.items() if fit is not None}


def growth_tables(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown: the exponents, every axis, and the formula of the memory."""
    machine, axes = report["machine"], report["axes"]
    lines = [
        f"{report['date']}, {report['device']}, {machine['threads']} threads, {machine['cpu']}, torch "
        f"{machine['torch']}. Medians of {report['repeats']} rounds, float32.",
    ]
    rows = [_exponents(axis) for axis in axes.values()]
    lines += ["", "### Exponents", "", markdown_table(rows, list(rows[0])).rstrip(), "", *_ABOUT_FITS]
    for axis in axes.values():
        lines += ["", f"### {axis['title']}", ""]
        measured = [point for point in axis["points"] if "skipped" not in point]
        for rows in ([row(axis["unit"], point) for point in measured] for row in (_row, _memory_row)):
            lines += [markdown_table(rows, list(rows[0])).rstrip(), ""] if rows else []
        for point in axis["points"]:
            if "skipped" in point:
                lines += [f"- {point['x']:.10g} {axis['unit']}: left out, {point['skipped']}."]
    rows = [
        {"phase": name, **_bytes(phase)}
        for name, phase in (PHASES[PASSES[0]] | PHASES[PASSES[1]]).items()
    ]  # fmt: skip
    lines += ["", "### Memory: bytes alive at the peak of every phase", ""]
    lines += [markdown_table(rows, list(rows[0])).rstrip(), "", *_ABOUT_MEMORY, ""]
    return "\n".join(lines)


_ABOUT_FITS = (
    "- Least squares in log-log over the upper half of the points, at least three; the range is given with each. The "
    "standard error is that of the slope.",
)

_ABOUT_MEMORY = (
    "- The peak is the largest phase. The phases of the forward pass are given for forward + backward, in which "
    f"autograd keeps {PHASES[PASSES[1]]['lists'].gaussian - PHASES[PASSES[0]]['lists'].gaussian:g} bytes more per "
    "Gaussian than in a forward pass alone.",
    "- strip: a Gaussian in a row of tiles; entry: a Gaussian in a tile; pixels are those of whole tiles. Chunk: the "
    "one at work; block: its largest. `+` is added for the chunk before, which lives until the next one has replaced "
    "it.",
    "- tensors: measured in a fresh process that maps every larger tensor on its own and so gives it back at once, "
    "less what a rendering of one Gaussian takes (buffers of the libraries). process: as the system's allocator has "
    "it, with what it holds back between tensors and with the libraries.",
)


def growth_figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw times above and memory below, one column per axis, with the fitted lines and the formula.

    Args:
        report: what `study_growth` returns.
        path: the PNG to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    axes = report["axes"]
    figure = Figure(figsize=(4.2 * len(axes), 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(axes), squeeze=False, sharex="col")
    for column, axis in enumerate(axes.values()):
        above, below = panels[:, column]
        above.set_title(axis["title"], fontsize="small")
        for color, name in zip(("C0", "C1"), PASSES, strict=True):
            _curve(above, _times(axis["points"], name), axis["fits"].get(f"{name}, time"), name, color)
            tensors = {x: value / _MIB for x, value in _tensors(axis["points"], name).items()}
            _curve(below, tensors, axis["fits"].get(f"{name}, memory"), name, color, unit=_MIB)
            formula = {p["x"]: p["formula"][name]["bytes"] / _MIB for p in axis["points"] if "skipped" not in p}
            below.plot(formula.keys(), formula.values(), "--", color=color, label=f"{name}, formula")
        below.set_xlabel(axis["unit"])
        for panel in (above, below):
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.grid(alpha=0.3)
            if panel.get_legend_handles_labels()[0]:
                panel.legend(fontsize="x-small")
    panels[0, 0].set_ylabel("seconds")
    panels[1, 0].set_ylabel("peak memory above the inputs, MiB")
    with replacing(path) as place:
        figure.savefig(place, dpi=110, format="png")


def _curve(
    panel: Any, values: Mapping[float, float], fit: Mapping[str, Any] | None, label: str, color: str, *, unit: float = 1
) -> None:
    """Draw measured points, and the fitted line with its exponent where there is one."""
    if not values:
        return
    if fit is not None:
        label = f"{label}: exponent {fit['exponent']:.2f} ± {fit['std_error']:.2f}"
        ends = (fit["start"], fit["end"])
        panel.plot(ends, [Fit(**fit)(x) / unit for x in ends], "-", color=color, linewidth=1)
    panel.plot(values.keys(), values.values(), "o", color=color, label=label, markersize=4)


def _times(points: Sequence[Mapping[str, Any]], name: str) -> dict[float, float]:
    """Return median seconds by x."""
    return {p["x"]: p["medians"][name] for p in points if "skipped" not in p}


def _tensors(points: Sequence[Mapping[str, Any]], name: str) -> dict[float, float]:
    """Return the measured peaks of the tensors by x, bytes, where there is a positive one."""
    measured = {p["x"]: p["memory"]["tensors"] for p in points if "skipped" not in p}
    return {x: peaks[name] for x, peaks in measured.items() if peaks is not None and peaks[name] > 0}


def _exponents(axis: Mapping[str, Any]) -> dict[str, object]:
    """Return the row of an axis."""
    row: dict[str, object] = {"against": axis["title"], "over": None}
    for name in (f"{x}, {what}" for x in PASSES for what in ("time", "memory")):
        fit = axis["fits"].get(name)
        row[name] = None if fit is None else f"{fit['exponent']:.2f} ± {fit['std_error']:.2f}"
        if fit is not None:
            row["over"] = f"{fit['start']:.10g} to {fit['end']:.10g} ({fit['points']})"
    return row


def _row(unit: str, point: Mapping[str, Any]) -> dict[str, object]:
    """Return what a measured point is, and its times."""
    counts = point["counts"]
    row: dict[str, object] = {
        unit: f"{point['x']:.10g}",
        "at a pixel": point["per_pixel"],
        "mean list": counts["entries"] / (counts["pixels"] / PIXELS),
    }
    return row | {f"{name}, ms": point["medians"][name] * 1e3 for name in PASSES}


def _memory_row(unit: str, point: Mapping[str, Any]) -> dict[str, object]:
    """Return the memory of a measured point, MiB: formula, measurement, and which phase is largest."""
    row: dict[str, object] = {unit: f"{point['x']:.10g}"}
    for name in PASSES:
        formula, measured = point["formula"][name], point["memory"]
        row[f"{name}, MiB: formula"] = formula["bytes"] / _MIB
        for kind in ("tensors", "process"):
            row[f"{name}: {kind}"] = None if measured[kind] is None else measured[kind][name] / _MIB
        row[f"{name}: phase"] = formula["phase"]
    return row


def _bytes(phase: Any) -> dict[str, str]:
    """Return the cells of a phase."""
    cells = {name: f"{getattr(phase, name):g}" for name in ("gaussian", "strip", "entry", "pixel")}
    for name, now, before in zip(("chunk entry", "chunk pixel", "block pair"), phase.chunk, phase.earlier, strict=True):
        cells[name] = f"{now:g} + {before:g}" if before else f"{now:g}"
    return cells
