"""Judge a case: finite or not, how far off, and from which magnitude on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from reference_trainer.studies.stability.case import Case

__all__ = ["GRADIENT_TOLERANCE", "VALUE_TOLERANCE", "Point", "Status", "Verdict", "judge", "relative_error"]

Status = Literal["ok", "inexact", "not finite", "refused", "crash"]

VALUE_TOLERANCE = 1e-3
"""Largest error of an image, a moment or a score that counts as right: a quarter of an 8-bit step."""

GRADIENT_TOLERANCE = 1e-2
"""Largest error of a gradient that counts as right: a hundredth of a training step."""

_HALVINGS = 5  # of the decade in which a case starts to fail: the onset is then known to 7 %
_ALLOWED: dict[str, set[Status]] = {
    "refused": {"ok", "refused"},
    "limit": {"ok", "refused", "inexact"},
    "overflow": {"ok", "refused", "inexact", "not finite"},
}


@dataclass(frozen=True)
class Point:
    """A case at one magnitude.

    Args:
        magnitude: of the case.
        status: what happened.
        errors: relative error of every quantity; infinite where it is not finite although it should be.
        message: of the exception, if there was one.
    """

    magnitude: float
    status: Status
    errors: Mapping[str, float] = field(default_factory=dict)
    message: str = ""

    @property
    def failing(self) -> list[str]:
        """The quantities that are not right."""
        return [name for name, error in self.errors.items() if not error <= _tolerance(name)]


@dataclass(frozen=True)
class Verdict:
    """How a case ends.

    Args:
        case: what was judged.
        points: at the magnitudes of the case, and at those of the search for the onset, increasing.
        onset: the smallest magnitude that failed; None if none did.
        ending: "ok"; "refused" or "limit" as the case foresees it; "defect" for everything else.
    """

    case: Case
    points: list[Point]
    onset: float | None
    ending: Literal["ok", "refused", "limit", "defect"]

    @property
    def failure(self) -> Point | None:
        """The first point that failed."""
        return next((point for point in self.points if point.status != "ok"), None)


def judge(case: Case) -> Verdict:
    """Run a case at all its magnitudes, and search for the one at which it starts to fail.

    Args:
        case: what to judge.
    """
    points = [_point(case, magnitude) for magnitude in case.magnitudes]
    failed = next((i for i, point in enumerate(points) if point.status != "ok"), None)
    if failed is None:
        return Verdict(case, points, None, "ok")
    onset = points[failed].magnitude
    if failed > 0:
        good = points[failed - 1].magnitude
        for _ in range(_HALVINGS):
            middle = math.sqrt(good * onset)
            point = _point(case, middle)
            points.append(point)
            good, onset = (middle, onset) if point.status == "ok" else (good, middle)
        points.sort(key=lambda point: point.magnitude)
    if onset <= case.until or any(point.status not in _ALLOWED[case.beyond] for point in points):
        return Verdict(case, points, onset, "defect")
    return Verdict(case, points, onset, "refused" if case.beyond == "refused" else "limit")


def relative_error(measured: Tensor, reference: Tensor) -> float:
    """Return the norm of the difference over that of the reference, absolute if the latter is 0.

    Both may be undefined (nan) in the same places. Infinite if anything else is not finite in what was measured.

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


def _tolerance(quantity: str) -> float:
    """Return the largest error of a quantity that counts as right."""
    return GRADIENT_TOLERANCE if quantity.startswith("d ") else VALUE_TOLERANCE


def _point(case: Case, magnitude: float) -> Point:
    """Run a case at a magnitude."""
    probe = case.probe(magnitude)
    try:
        measured = probe.measured()
    except (ValueError, TypeError) as error:
        return Point(magnitude, "refused", message=f"{type(error).__name__}: {error}")
    except (RuntimeError, ArithmeticError, LookupError, AssertionError, MemoryError) as error:
        return Point(magnitude, "crash", message=f"{type(error).__name__}: {error}")
    reference = probe.reference()
    errors = {name: relative_error(x, reference[name]) for name, x in measured.items()}
    wrong = [error for name, error in errors.items() if not error <= _tolerance(name)]
    return Point(magnitude, "ok" if not wrong else "not finite" if math.inf in wrong else "inexact", errors)
