"""The tables of the speed benchmark, and the comparison with an older measurement."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from typing import Any

from benchmarks.calls import PASSES
from benchmarks.stages import STAGES
from benchmarks.training_step import MASKS, PARTS
from reference_trainer.evaluation.tables import markdown_table

__all__ = ["regressions", "speed_tables"]

_MIB = 1 << 20
_ONE_PAIR = 1 / 255  # rounding may move one pair over the cut at this alpha, which is no regression


def regressions(
    new: Mapping[str, Any], old: Mapping[str, Any], *, time_factor: float = 1.5, error_factor: float = 2.0
) -> list[str]:
    """Compare two reports: ratios of times loosely, errors tightly. Only what both have measured is compared.

    Args:
        new: what `measure_speed` returned.
        old: the content of an older ``speed.json``.
        time_factor: a ratio of times may grow by this factor.
        error_factor: an error may grow by this factor; the largest of an image may always be 1/255, because rounding
            decides whether a pair on the edge is rendered.

    Returns:
        One line per number that grew by more.

    Raises:
        ValueError: if the reports are not of the same device and number of threads, or have nothing in common.

    Example:
        >>> settings = {"device": "cpu", "machine": {"threads": 2}, "ratios": {"a": 1.0}, "errors": {"b": 1e-6}}
        >>> regressions(settings | {"errors": {"b": 3e-6}}, settings)
        ['b: error 3e-06, was 1e-06 (3 times as large; allowed 2)']
    """
    setups = [(report["device"], report["machine"]["threads"]) for report in (new, old)]
    if setups[0] != setups[1]:
        raise ValueError(
            "ratios compare only on the same kind of device with the same number of threads, got "
            + " and ".join(f"{device} with {threads}" for device, threads in setups)
            + ": measure the older version again in this setup."
        )
    lines, compared = [], 0
    for group, what, factor in (("ratios", "ratio", time_factor), ("errors", "error", error_factor)):
        for name in new[group].keys() & old[group].keys():
            now, before = (math.nan if x is None else x for x in (new[group][name], old[group][name]))
            compared += 1
            least = _ONE_PAIR if name.endswith("image, max") else 0.0
            if not now <= max(factor * before, least):  # true for nan as well: what is not a number is no success
                times = f" ({now / before:.3g} times as large; allowed {factor:g})" if before else ""
                lines.append(f"{name}: {what} {now:.3g}, was {before:.3g}{times}")
    if not compared:
        raise ValueError("the two reports have no number in common: measure the same workloads.")
    return sorted(lines)


def speed_tables(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown: per workload and engine the times, stages and errors; then the training step."""
    workloads, training, machine = report["workloads"], report["training"], report["machine"]
    tables = {
        "Times": [_times(name, w, x) for name, w in workloads.items() for x in _renderers(w)],
        "Scores and threads": [_ratios(name, w, e) for name, w in workloads.items() for e in w["stages"]],
        "Stages, ms": [_stages(name, w, e) for name, w in workloads.items() for e in w["stages"]],
        "Errors against float64": _errors(workloads),
        f"Training step, ms ({training['scene']})": [_step(training, engine) for engine in training["parts"]],
    }
    lines = [
        f"{report['date']}, {report['device']}, {machine['threads']} threads, {machine['cpu']}, torch "
        f"{machine['torch']}. Medians of {report['repeats']} rounds, float32; on a CPU the time of its processors.",
    ]
    for title, rows in tables.items():
        lines += ["", f"### {title}", "", markdown_table(rows, list(rows[0])).rstrip()]
    return "\n".join([*lines, "", *_NOTES, ""])


_NOTES = (
    "- / baseline: time over that of the frozen simple renderer, taken in turns with it. Pairs: of a pixel and a "
    "Gaussian with an alpha of at least 1/255.",
    "- Peak memory: above the inputs; on a CPU the resident memory of a fresh process, on a GPU that of the tensors.",
    "- Scores: over a plain render of the same engine. Two threads / one: wall-clock time of forward + backward.",
    "- Image error: absolute; gradient errors: norm of the error over the norm, on small workloads only.",
    "- Rest of a step: draws, statistics for densification, squared error, choosing the view.",
)


def _renderers(w: Mapping[str, Any]) -> list[str]:
    """Return what rendered a workload: the engines, gsplat if it was there, and the baseline."""
    return [name.removesuffix(f": {PASSES[1]}") for name in w["seconds"] if name.endswith(PASSES[1])]


def _ms(seconds: Mapping[str, Any], name: str) -> float:
    return 1e3 * float(statistics.median(seconds[name]))


def _times(name: str, w: Mapping[str, Any], by: str) -> dict[str, object]:
    """Return the row of what rendered a workload."""
    row: dict[str, object] = {"workload": f"{name} ({w['gaussians']}, {w['width']}x{w['height']})", "rendered by": by}
    for x in PASSES:
        ms, peak = _ms(w["seconds"], f"{by}: {x}"), w["memory"].get(by)
        row[f"{x}, ms"] = ms
        row[f"{x} / baseline"] = w["ratios"].get(f"{by}: {x} / baseline", 1)
        row[f"{x}, M pairs/s"] = w["pairs"] / ms / 1e3
        row[f"{x}, peak MiB"] = None if peak is None else peak[x] / _MIB
    return row


def _ratios(name: str, w: Mapping[str, Any], engine: str) -> dict[str, object]:
    """Return what scores cost in plain renders, and what a second thread is worth."""
    what = ("exact score / render", f"score, K = {MASKS} / render", "two threads / one")
    return {"workload": name, "engine": engine, **{x: w["ratios"].get(f"{engine}: {x}") for x in what}}


def _stages(name: str, w: Mapping[str, Any], engine: str) -> dict[str, object]:
    """Return where the time of an engine goes."""
    stages = {x: _ms(w["stages"][engine], x) for x in STAGES}
    whole = _ms(w["seconds"], f"{engine}: {PASSES[1]}")
    pairs = 64 * w["entries"][engine] / w["pairs"]
    return {
        "workload": name,
        "engine": engine,
        **stages,
        "sum / whole": sum(stages.values()) / whole,
        "listed / pairs": pairs,
    }


def _step(training: Mapping[str, Any], engine: str) -> dict[str, object]:
    """Return the parts of a training step of an engine."""
    parts = {x: _ms(training["parts"][engine], x) for x in ("step", *PARTS)}
    return {"engine": engine, **parts, "analytic / sampled": training["ratios"][f"{engine}: analytic / sampled"]}


def _errors(workloads: Mapping[str, Any]) -> list[dict[str, object]]:
    """Return one row per kind of error."""
    kinds = dict.fromkeys(kind for w in workloads.values() for kind in w["errors"])
    return [
        {"error": kind, **{name: _scientific(w["errors"].get(kind)) for name, w in workloads.items()}} for kind in kinds
    ]


def _scientific(value: float | None) -> str | None:
    """Return an error to two digits."""
    return None if value is None else f"{value:.1e}"
