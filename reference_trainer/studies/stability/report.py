"""The stability study as data and as Markdown."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from reference_trainer.evaluation.results import markdown_table
from reference_trainer.studies.stability.judge import GRADIENT_TOLERANCE, VALUE_TOLERANCE, Verdict
from reference_trainer.studies.stability.quantities import SCENE_QUANTITIES

__all__ = ["of_engine", "stability_tables", "verdict_record", "worst_errors"]


def verdict_record(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict as plain data; errors that are not finite become null in JSON."""
    case, failure = verdict.case, verdict.failure
    return {
        "family": case.family,
        "name": case.name,
        "magnitudes": [case.magnitudes[0], case.magnitudes[-1]] if len(case.magnitudes) > 1 else None,
        "ending": verdict.ending,
        "onset": verdict.onset,
        "must_hold_until": case.until if math.isfinite(case.until) else None,
        "note": case.note,
        "failure": None if failure is None else {"status": failure.status, "quantities": failure.failing},
        "points": [
            {"magnitude": p.magnitude, "status": p.status, "errors": dict(p.errors), "message": p.message}
            for p in verdict.points
        ],
    }


def worst_errors(record: Mapping[str, Any]) -> dict[str, float]:
    """Return the largest error of every quantity over the magnitudes at which all were right."""
    worst: dict[str, float] = {}
    for point in record["points"]:
        if point["status"] == "ok":
            for name, error in point["errors"].items():
                worst[name] = max(error, worst.get(name, 0.0))
    return worst


def stability_tables(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown: counts, errors by case and quantity, and how what ends does so.

    Args:
        report: what `study_stability` returns.
    """
    cases: Sequence[Mapping[str, Any]] = report["cases"]
    machine = report["machine"]
    rows = [_count_row(engine, of_engine(cases, engine)) for engine in report["engines"]]
    lines = [
        f"{report['date']}, {machine['cpu']}, torch {machine['torch']}: {report['points']} magnitudes in "
        f"{report['seconds']:.0f} s. Right is an error of at most {VALUE_TOLERANCE:g}, of gradients (d) "
        f"{GRADIENT_TOLERANCE:g}: the norm of the difference over that of the reference. What draws nothing in float32 "
        "is judged once and counted for every engine.",
        "",
        markdown_table(rows, list(rows[0])),
        "### Largest error over the magnitudes at which everything is right",
    ]
    for family in dict.fromkeys(case["family"] for case in cases):
        measured = [case for case in cases if case["family"] == family and worst_errors(case)]
        if measured:
            used = [name for name in SCENE_QUANTITIES if any(name in worst_errors(case) for case in measured)]
            rows = [_error_row(case) for case in measured]
            lines += ["", f"**{family}**", "", markdown_table(rows, ["case", "engine", "up to", *used]).rstrip()]
    rows = [_ending_row(case) for case in cases if case["ending"] != "ok"]
    columns = ["case", "engine", "ends as", "from", "how", "what it says"]
    lines += ["", "### Where and how the others end", "", markdown_table(rows, columns).rstrip()]
    return "\n".join(lines) + "\n"


def of_engine(cases: Sequence[Mapping[str, Any]], engine: str) -> list[Mapping[str, Any]]:
    """Return the records of an engine, and those that are of no engine."""
    return [case for case in cases if case["engine"] in (engine, None)]


def _count_row(engine: str, cases: Sequence[Mapping[str, Any]]) -> dict[str, object]:
    """Return how many cases end in which way."""
    counts = Counter(case["ending"] for case in cases)
    endings = {name: counts[name] for name in ("ok", "refused", "limit", "defect")}
    return {"engine": engine, "cases": len(cases), **endings}


def _error_row(case: Mapping[str, Any]) -> dict[str, object]:
    """Return the row of a case, its errors with one digit."""
    right = [point["magnitude"] for point in case["points"] if point["status"] == "ok"]
    up_to = f"{max(right):.2g}" if case["magnitudes"] else "one"
    row: dict[str, object] = {"case": case["name"], "engine": case["engine"] or "", "up to": up_to}
    return row | {name: f"{error:.0e}" if error else "0" for name, error in worst_errors(case).items()}


def _ending_row(case: Mapping[str, Any]) -> dict[str, object]:
    """Return the row of a case that does not stay right: from where on, what goes wrong first, and what it says."""
    first = next(point for point in case["points"] if point["status"] != "ok")
    wrong = ", ".join(case["failure"]["quantities"])
    return {
        "case": f"{case['family']}: {case['name']}",
        "engine": case["engine"] or "",
        "ends as": case["ending"],
        "from": f"{case['onset']:.2g}" if case["magnitudes"] else "always",
        "how": first["status"] + (f": {wrong}" if wrong else ""),
        "what it says": first["message"].partition("\n")[0] or case["note"],
    }
