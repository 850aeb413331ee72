"""The stability study: runs every case with every engine; the command fails if one ends other than declared."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.evaluation.results import machine
from reference_trainer.evaluation.style import WIDTH
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.render.engine import engines_on, using_engine
from reference_trainer.studies.stability.cases import Case, Probe, all_cases
from reference_trainer.studies.stability.quantities import SCENE_QUANTITIES
from reference_trainer.studies.study import Record, Records, Study, run_study

__all__ = [
    "GRADIENT_TOLERANCE", "VALUE_TOLERANCE", "judge", "judge_with", "relative_error", "stability_study",
    "study_stability",
]  # fmt: skip

VALUE_TOLERANCE = 1e-3
"""Largest error of an image, a moment or a score that counts as right: a quarter of an 8-bit step."""

GRADIENT_TOLERANCE = 1e-2
"""Largest error of a gradient that counts as right: a hundredth of a training step."""

_HALVINGS = 5  # bisections of the interval in which a case starts to fail; of a decade, they leave 7 %
_ALLOWED = {
    "refused": {"ok", "refused"},
    "limit": {"ok", "refused", "inexact"},
    "overflow": {"ok", "refused", "inexact", "not finite"},
}


def judge(case: Case) -> Record:
    """Run a case at all its magnitudes, and search for the one at which it starts to fail.

    Returns the description of the case; under "ending" how it ends: "ok"; "refused" or "limit" as declared; "defect"
    for anything else; under "onset" the smallest magnitude that failed, None if none did; under "points" for every
    magnitude, including those of the search, the "status" ("ok", "inexact", "not finite", "refused" or "crash"), the
    relative "errors" of the quantities, which of them are "wrong", and the "message" of an exception.
    """
    points = [_point(case, magnitude) for magnitude in case.magnitudes]
    failed = next((i for i, point in enumerate(points) if point["status"] != "ok"), None)
    onset, ending = None, "ok"
    if failed is not None:
        onset = points[failed]["magnitude"]
        if failed > 0:
            good = points[failed - 1]["magnitude"]
            for _ in range(_HALVINGS):
                # The geometric mean, as magnitudes go by powers of ten.
                points.append(_point(case, math.sqrt(good * onset)))
                middle = points[-1]["magnitude"]
                good, onset = (middle, onset) if points[-1]["status"] == "ok" else (good, middle)
            points.sort(key=lambda point: point["magnitude"])
        foreseen = onset > case.until and all(point["status"] in _ALLOWED[case.beyond] for point in points)
        ending = ("refused" if case.beyond == "refused" else "limit") if foreseen else "defect"
    return {
        "family": case.family,
        "name": case.name,
        "magnitudes": [case.magnitudes[0], case.magnitudes[-1]] if len(case.magnitudes) > 1 else None,
        "ending": ending,
        "onset": onset,
        "must_hold_until": case.until if math.isfinite(case.until) else None,
        "note": case.note,
        "points": points,
    }


def relative_error(measured: Tensor, reference: Tensor) -> float:
    """Return the norm of the difference divided by that of the reference; undivided if the reference is 0.

    Positions where both are nan are ignored; any other value of ``measured`` that is not finite gives infinity.

    Raises:
        ValueError: if the shapes differ.

    Example:
        >>> relative_error(torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.0]))
        2.0
        >>> relative_error(torch.tensor([torch.nan]), torch.tensor([1.0]))
        inf
    """
    if measured.shape != reference.shape:
        raise ValueError(f"shapes differ: {tuple(measured.shape)} and {tuple(reference.shape)}.")
    measured, reference = measured.detach().double(), reference.detach().double()
    # nan in both is agreement: a scene in which nothing is visible has no score.
    defined = ~(measured.isnan() & reference.isnan())
    measured, reference = measured[defined], reference[defined]
    if not bool(measured.isfinite().all()):
        return math.inf
    size = torch.linalg.vector_norm(reference).item()
    return float(torch.linalg.vector_norm(measured - reference).item() / (size or 1.0))


def _point(case: Case, magnitude: float) -> Record:
    probe, status, errors, wrong, message = case.probe(magnitude), "ok", {}, [], ""
    try:
        measured = probe.measured()
    except (ValueError, TypeError) as error:
        # What the package raises on purpose; all other errors come from somewhere below and name no mistake.
        status, message = "refused", f"{type(error).__name__}: {error}"
    except (RuntimeError, ArithmeticError, LookupError, AssertionError, MemoryError) as error:
        status, message = "crash", f"{type(error).__name__}: {error}"
    else:
        reference = probe.reference()
        errors = {name: relative_error(x, reference[name]) for name, x in measured.items()}
        allowed = {name: GRADIENT_TOLERANCE if name.startswith("d ") else VALUE_TOLERANCE for name in errors}
        # Not `error > allowed`, which is false for nan.
        wrong = [name for name, error in errors.items() if not error <= allowed[name]]
        if wrong:
            status = "not finite" if math.inf in map(errors.get, wrong) else "inexact"
    return {"magnitude": magnitude, "status": status, "errors": errors, "wrong": wrong, "message": message}


_FLOOR = 1e-9  # lower end of the figure's color scale


def study_stability(out: Path) -> Records:
    """Push the CPU's engines and the functions of `ca_reg` to extremes, and report where and how they fail.

    Raises a RuntimeError that lists the cases which end other than declared, after everything is written.
    """
    records = run_study(stability_study(), out)
    if defects := [name for name, record in records.items() if record["ending"] == "defect"]:
        raise RuntimeError("\n  ".join([f"{len(defects)} cases do not end as they should:", *defects]))
    return records


def stability_study() -> Study:
    """Declare the study: every case once per available engine, or once in total if it renders nothing.

    Records are not kept once the study is finished: the next call checks the program as it is then.
    """
    cases = {}
    for number, case in enumerate(all_cases()):
        for engine in engines_on(torch.device("cpu")) if case.renders else [None]:
            name = f"{case.family}: {case.name}" + (f" ({engine})" if engine else "")
            cases[name] = {"number": number, "engine": engine}
    return Study("stability", judge_with, cases, _report, _plot, check=True)


def judge_with(number: int, engine: str | None) -> Record:
    """Judge a case, by its index in `all_cases`, with an engine; None for a case that renders nothing."""
    start, case = perf_counter(), _with_one_reference(all_cases()[number])
    if engine is None:
        record = judge(case)
    else:
        with using_engine(engine):
            record = judge(case)
    return {"engine": engine, "seconds": perf_counter() - start, **record}


# One case at a time is enough: its engines come one after the other.
@lru_cache(maxsize=1)
def _with_one_reference(case: Case) -> Case:
    """Return the case with cached references: these are in float64 and do not depend on the engine."""

    @cache
    def probe(magnitude: float) -> Probe:
        fresh = case.probe(magnitude)
        return Probe(fresh.measured, cache(fresh.reference))

    return replace(case, probe=probe)


def _worst_errors(record: Record) -> dict[str, float]:
    """Return the largest error of every quantity over the magnitudes at which all quantities are right."""
    worst: dict[str, float] = {}
    for point in record["points"]:
        if point["status"] == "ok":
            for name, error in point["errors"].items():
                worst[name] = max(error, worst.get(name, 0.0))
    return worst


def _report(records: Records) -> str:
    """Return the counts, the errors by case and quantity, and the cases that end."""
    cases, about = [*records.values()], machine()
    endings = {
        engine: Counter(case["ending"] for case in cases if case["engine"] in (engine, None))
        for engine in dict.fromkeys(case["engine"] for case in cases if case["engine"])
    }
    columns = ["engine", "cases", "ok", "refused", "limit", "defect"]
    rows = [
        {**dict.fromkeys(columns, 0), "engine": engine, "cases": counts.total(), **counts}
        for engine, counts in endings.items()
    ]
    lines = [
        f"{about['cpu']}, torch {about['torch']}: {sum(len(case['points']) for case in cases)} magnitudes in "
        f"{sum(case['seconds'] for case in cases):.0f} s. Right is an error of at most {VALUE_TOLERANCE:g}, of "
        f"gradients (d) {GRADIENT_TOLERANCE:g}: the norm of the difference over that of the reference. What renders "
        "nothing in float32 is judged once and counted for every engine.",
        "",
        markdown_table(rows, columns),
        "### Largest error over the magnitudes at which everything is right",
    ]
    for family in dict.fromkeys(case["family"] for case in cases):
        measured = [case for case in cases if case["family"] == family and _worst_errors(case)]
        if measured:
            used = [name for name in SCENE_QUANTITIES if any(name in _worst_errors(case) for case in measured)]
            rows = [_error_row(case) for case in measured]
            lines += ["", f"**{family}**", "", markdown_table(rows, ["case", "engine", "up to", *used]).rstrip()]
    rows = [_ending_row(case) for case in cases if case["ending"] != "ok"]
    columns = ["case", "engine", "ends as", "from", "how", "what it says"]
    lines += ["", "### Where and how the others end", "", markdown_table(rows, columns).rstrip()]
    return "\n".join(lines) + "\n"


def _error_row(case: Record) -> dict[str, object]:
    """Return the row of a case, with errors to one digit."""
    right = [point["magnitude"] for point in case["points"] if point["status"] == "ok"]
    up_to = f"{max(right):.2g}" if case["magnitudes"] else "one"
    row: dict[str, object] = {"case": case["name"], "engine": case["engine"] or "", "up to": up_to}
    return row | {name: f"{error:.0e}" if error else "0" for name, error in _worst_errors(case).items()}


def _ending_row(case: Record) -> dict[str, object]:
    """Return the row of a case that ends: from which magnitude on, what goes wrong first, and the message or note."""
    first = next(point for point in case["points"] if point["status"] != "ok")
    wrong = ", ".join(first["wrong"])
    return {
        "case": f"{case['family']}: {case['name']}",
        "engine": case["engine"] or "",
        "ends as": case["ending"],
        "from": f"{case['onset']:.2g}" if case["magnitudes"] else "always",
        "how": first["status"] + (f": {wrong}" if wrong else ""),
        "what it says": first["message"].partition("\n")[0] or case["note"],
    }


def _plot(records: Records, figure: Any) -> None:
    """Plot the errors of every case and quantity as a heat map, of the worst engine; the tables have all engines."""
    cases: dict[tuple[str, str], list[Record]] = {}
    for record in records.values():
        if _worst_errors(record):
            cases.setdefault((record["family"], record["name"]), []).append(record)
    table = np.full((len(cases), len(SCENE_QUANTITIES)), math.nan)
    for i, of in enumerate(cases.values()):
        for name, error in (pair for record in of for pair in _worst_errors(record).items()):
            # fmax ignores nan, which stands for what has not been measured.
            table[i, SCENE_QUANTITIES.index(name)] = np.fmax(table[i, SCENE_QUANTITIES.index(name)], max(error, _FLOOR))
    figure.set_size_inches(WIDTH, max(4.0, 0.19 * len(cases) + 1.8))
    axes = figure.subplots()
    axes.set_facecolor("0.9")
    axes.grid(False)
    heat = axes.imshow(table, cmap="viridis", norm="log", aspect="auto")
    heat.set_clim(_FLOOR, GRADIENT_TOLERANCE)
    axes.set_xticks(range(len(SCENE_QUANTITIES)), map(_quantity, SCENE_QUANTITIES), rotation=50, ha="right")
    axes.set_yticks(range(len(cases)), [_label(of) for of in cases.values()], fontsize=8.5)
    axes.tick_params(length=0)
    families = [family for family, _ in cases]
    for i in range(1, len(cases)):
        if families[i] != families[i - 1]:
            axes.axhline(i - 0.5, color="white", linewidth=4)
    bar = figure.colorbar(heat, ax=axes, location="top", aspect=50, pad=0.01)
    bar.set_label("largest relative error where all is right (gray: not part)")


def _quantity(name: str) -> str:
    """Return people's name of a quantity of `SCENE_QUANTITIES`: "d means" is a gradient."""
    return f"gradient of {name[2:]}" if name.startswith("d ") else name


def _label(of: Sequence[Record]) -> str:
    """Return the name of a case with the magnitude up to which it was pushed, or the least from which on it fails."""
    name, magnitudes = of[0]["name"], of[0]["magnitudes"]
    if not magnitudes:
        return str(name)
    onsets = [record["onset"] for record in of if record["onset"] is not None]
    last = min(onsets) if onsets else magnitudes[1]
    mantissa, exponent = f"{last:.1e}".split("e")
    number = ("" if mantissa == "1.0" else rf"{mantissa} \times ") + f"10^{{{int(exponent)}}}"
    if 0 <= int(exponent) < 3:  # shorter in full
        number = f"{last:.3g}"
    return f"{name}{'; ends at' if onsets else ', to'} ${number}$"
