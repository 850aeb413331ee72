"""The tables of the speed study, and the comparison with an older measurement."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from typing import Any

from reference_trainer.evaluation.report import markdown_table
from reference_trainer.studies.speed.measure import PASSES
from reference_trainer.studies.speed.steps import MASKS

__all__ = ["regressions", "speed_tables"]

_MIB = 1 << 20
_ONE_PAIR = 1 / 255  # rounding may move one pair over the cut at this alpha, which is no regression


def regressions(
    new: Mapping[str, Any], old: Mapping[str, Any], *, time_factor: float = 1.5, error_factor: float = 2.0
) -> list[str]:
    """Compare two reports: ratios of times loosely, errors tightly. Only what both have measured is compared.

    Args:
        new: what `study_speed` returned.
        old: the content of an older ``speed.json``.
        time_factor: a ratio of times may grow by this factor.
        error_factor: an error may grow by this factor; the largest of an image may always be 1/255, because rounding
            decides whether a pair on the edge is drawn.

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
    """Return a report as Markdown: per workload the times, stages and errors; then the training step and the rest."""
    workloads: Mapping[str, Any] = report["workloads"]
    limits, machine = report["limits"], report["machine"]
    exp, exp2, copy = (limits[name] / 1e9 for name in ("exp", "exp2", "copy"))
    lines = [
        f"{report['date']}, {report['device']}, {machine['threads']} threads, {machine['cpu']}, torch "
        f"{machine['torch']}. Medians of {report['repeats']} rounds, float32. The machine's limits: "
        f"{exp:.3g} G exp/s, {exp2:.3g} G exp2/s, copy {copy:.3g} GB/s.",
    ]
    tables = {
        "Times": _times(workloads),
        "Stages, ms": [_stages(name, w) for name, w in workloads.items()],
        "Errors against float64": _errors(workloads),
        "Beyond a rendering": _others(report),
    }
    for title, rows in tables.items():
        lines += ["", f"### {title}", "", markdown_table(rows, list(rows[0])).rstrip()]
    return "\n".join([*lines, "", *_NOTES, ""])


_NOTES = (
    "- vs baseline: time over that of the frozen simple renderer, taken in turns with it. "
    "vs exp: over one exponential per pair of a pixel and a Gaussian with alpha of at least 1/255. "
    "vs copy: over reading all parameters and writing all pixels once.",
    "- Peak memory: above the inputs; on a CPU the resident memory of a fresh process, on a GPU that of the tensors.",
    "- Image error: absolute; gradient errors: norm of the error over the norm, on small workloads only.",
)


def _times(workloads: Mapping[str, Any]) -> list[dict[str, object]]:
    """Return two rows per workload."""
    rows: list[dict[str, object]] = []
    for name, w in workloads.items():
        for x in PASSES:
            rows.append(
                {
                    "workload": f"{name} ({w['gaussians']}, {w['width']}x{w['height']}), {x}",
                    "ms": w["medians"][x] * 1e3,
                    "baseline ms": w["medians"][f"baseline {x}"] * 1e3,
                    "vs baseline": w["ratios"][f"{x} / baseline"],
                    **_gsplat(w, x),
                    "vs exp": w["ratios_to_limits"][f"{x} / exp bound"],
                    "vs copy": w["ratios_to_limits"][f"{x} / copy bound"],
                    "M pairs/s": w["pairs_per_second"][x] / 1e6,
                    "peak MiB": None if w["memory"] is None else w["memory"][x] / _MIB,
                }
            )
    return rows


def _gsplat(w: Mapping[str, Any], x: str) -> dict[str, object]:
    """Return the columns of gsplat, if it was there."""
    if f"{x} / gsplat" not in w["ratios"]:
        return {}
    return {"gsplat ms": w["medians"][f"gsplat {x}"] * 1e3, "vs gsplat": w["ratios"][f"{x} / gsplat"]}


def _stages(name: str, w: Mapping[str, Any]) -> dict[str, object]:
    """Return the row of a workload."""
    milliseconds = {stage: seconds * 1e3 for stage, seconds in w["stage_medians"].items()}
    return {
        "workload": name,
        **milliseconds,
        "sum / forward+backward": w["stages_over_whole"],
        "pairs evaluated per pair": w["evaluated"] / w["pairs"],
    }


def _errors(workloads: Mapping[str, Any]) -> list[dict[str, object]]:
    """Return one row per kind of error."""
    kinds = dict.fromkeys(kind for w in workloads.values() for kind in w["errors"])
    return [
        {"error": kind, **{name: _scientific(w["errors"].get(kind)) for name, w in workloads.items()}} for kind in kinds
    ]


def _scientific(value: float | None) -> str | None:
    """Return an error to two digits."""
    return None if value is None else f"{value:.1e}"


def _others(report: Mapping[str, Any]) -> list[dict[str, object]]:
    """Return the rows of the masked renders, the similarity and the training step."""
    rows: list[dict[str, object]] = [
        {
            "what": f"{name}: score of {MASKS} masked renders, unit: {MASKS} plain renders",
            "ms": w["medians"][f"score of {MASKS}"] * 1e3,
            "ratio": w["ratios"][f"score of {MASKS} / {MASKS} renders"],
        }
        for name, w in report["workloads"].items()
    ]
    similarity = {name: statistics.median(seconds) for name, seconds in report["similarity"].items()}
    rows.append(
        {
            "what": "ssim_map and its gradient, 252x189, unit: kornia.metrics.ssim",
            "ms": similarity["ssim_map"] * 1e3,
            "ratio": report["ratios"]["ssim_map / kornia"],
        }
    )
    step = report["training_step"]
    medians = {name: statistics.median(seconds) for name, seconds in step["seconds"].items()}
    where = f"{step['scene']}, {step['width']}x{step['height']}, {step['gaussians']} Gaussians"
    for part, seconds in medians.items():
        what = f"training step ({where})" if part == "step" else f"its {part}, unit: the step"
        rows.append({"what": what, "ms": seconds * 1e3, "ratio": seconds / medians["step"]})
    return rows
