"""The stability study: judge every case, write, and fail if one ends as nobody foresaw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any

import torch

from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.files import write_text
from reference_trainer.studies.engines import drawn_by, engines_on
from reference_trainer.studies.stability.blends import blend_cases
from reference_trainer.studies.stability.case import Case, Probe
from reference_trainer.studies.stability.figure import stability_figure
from reference_trainer.studies.stability.geometry import geometry_cases
from reference_trainer.studies.stability.inputs import input_cases
from reference_trainer.studies.stability.judge import judge
from reference_trainer.studies.stability.report import stability_tables, verdict_record

__all__ = ["all_cases", "judged", "study_stability"]

REPORT, TABLE, FIGURE = "stability.json", "stability.md", "stability.png"

Say = Callable[[str], None]


def all_cases() -> list[Case]:
    """Return all cases: shape, place and camera; opacities, masks, colours and precision; bad input."""
    return [*geometry_cases(), *blend_cases(), *input_cases()]


def study_stability(out: Path, *, cases: Sequence[Case] | None = None, say: Say = print) -> dict[str, Any]:
    """Push both engines of the renderer and the functions of `ca_reg` to extremes, and say where they end and how.

    Writes ``stability.json``, ``stability.md`` and ``stability.png``. It takes two minutes of one core. The loops are
    left out where numba is missing.

    Args:
        out: folder for the results.
        cases: what to judge; `all_cases` by default.
        say: receives the progress and the tables.

    Returns:
        The content of ``stability.json``; "cases" has one record for each engine, or one without an engine.

    Raises:
        ValueError: if there is no case.
        RuntimeError: if a case ends in another way than it should; lists them, after everything is written.
    """
    cases = all_cases() if cases is None else cases
    if not cases:
        raise ValueError("expected at least 1 case, got none.")
    start, engines = perf_counter(), engines_on(torch.device("cpu"))
    records: list[dict[str, Any]] = []
    for i, case in enumerate(cases):
        if i == 0 or case.family != cases[i - 1].family:
            say(case.family)
        records += judged(case, engines)
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "seconds": perf_counter() - start,
        "engines": list(engines),
        "points": sum(len(record["points"]) for record in records),
        "cases": records,
    }
    write_json(out / REPORT, report)
    text = stability_tables(report)
    write_text(out / TABLE, text)
    stability_figure(report, out / FIGURE)
    say(text)
    say(f"numbers, tables and picture: {out / REPORT}, {out / TABLE}, {out / FIGURE}")
    if defects := [x for x in records if x["ending"] == "defect"]:
        names = "\n".join(
            f"  {x['family']}: {x['name']}" + (f" ({x['engine']})" if x["engine"] else "") for x in defects
        )
        raise RuntimeError(f"{len(defects)} cases do not end as they should:\n{names}")
    return report


def judged(case: Case, engines: Sequence[str]) -> list[dict[str, Any]]:
    """Judge a case with every engine, or once if none draws in it; one record each, with the name of the engine."""
    if not case.draws:
        return [{"engine": None, **verdict_record(judge(case))}]

    @cache
    def probe(magnitude: float) -> Probe:
        fresh = case.probe(magnitude)
        return Probe(fresh.measured, cache(fresh.reference))  # in float64, whatever the engine

    records = []
    for engine in engines:
        with drawn_by(engine):
            records.append({"engine": engine, **verdict_record(judge(replace(case, probe=probe)))})
    return records
