"""Judge a stability case: whether it is finite, how large its errors are, and from which magnitude on it fails."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from reference_trainer.studies.stability.case import Case
from reference_trainer.studies.study import Record

__all__ = ["GRADIENT_TOLERANCE", "VALUE_TOLERANCE", "judge", "relative_error"]

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

    Args:
        case: what to judge.

    Returns:
        The description of the case; under "ending" how it ends: "ok"; "refused" or "limit" as declared; "defect" for
        anything else; under "onset" the smallest magnitude that failed, None if none did; under "points" for every
        magnitude, including those of the search, the "status" ("ok", "inexact", "not finite", "refused" or "crash"),
        the relative "errors" of the quantities, which of them are "wrong", and the "message" of an exception.
    """
    points = [_point(case, magnitude) for magnitude in case.magnitudes]
    failed = next((i for i, point in enumerate(points) if point["status"] != "ok"), None)
    onset, ending = None, "ok"
    if failed is not None:
        onset = points[failed]["magnitude"]
        if failed > 0:
            good = points[failed - 1]["magnitude"]
            for _ in range(_HALVINGS):
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
    defined = ~(measured.isnan() & reference.isnan())
    measured, reference = measured[defined], reference[defined]
    if not bool(measured.isfinite().all()):
        return math.inf
    size = torch.linalg.vector_norm(reference).item()
    return float(torch.linalg.vector_norm(measured - reference).item() / (size or 1.0))


def _point(case: Case, magnitude: float) -> Record:
    """Run a case at a magnitude."""
    probe, status, errors, wrong, message = case.probe(magnitude), "ok", {}, [], ""
    try:
        measured = probe.measured()
    except (ValueError, TypeError) as error:
        status, message = "refused", f"{type(error).__name__}: {error}"
    except (RuntimeError, ArithmeticError, LookupError, AssertionError, MemoryError) as error:
        status, message = "crash", f"{type(error).__name__}: {error}"
    else:
        reference = probe.reference()
        errors = {name: relative_error(x, reference[name]) for name, x in measured.items()}
        allowed = {name: GRADIENT_TOLERANCE if name.startswith("d ") else VALUE_TOLERANCE for name in errors}
        wrong = [name for name, error in errors.items() if not error <= allowed[name]]
        if wrong:
            status = "not finite" if math.inf in map(errors.get, wrong) else "inexact"
    return {"magnitude": magnitude, "status": status, "errors": errors, "wrong": wrong, "message": message}
