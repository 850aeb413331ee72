"""The rule by which a claim holds, on one scene and over several."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Literal

__all__ = ["Verdict", "interval", "overall", "verdict"]

Verdict = Literal["holds", "fails", "undecided", "depends on the scene"]
ERRORS = 2.0
"""Half the width of the interval, in standard errors of the mean over the seeds."""


def interval(differences: Sequence[float]) -> tuple[float, float]:
    """Return the mean of differences over seeds and two standard errors of it, infinite for a single seed.

    Example:
        >>> interval([1.0, 2.0, 3.0])
        (2.0, 1.1547005383792517)
    """
    n = len(differences)
    return statistics.fmean(differences), ERRORS * statistics.stdev(differences) / math.sqrt(n) if n > 1 else math.inf


def verdict(differences: Sequence[float], low: float, high: float) -> Verdict:
    """Judge a claimed interval: "holds" if mean ± two standard errors lies inside (low, high), "fails" if outside.

    If the true mean is at an end of the claimed interval, "holds" is a false positive: with three seeds in 9 of 100
    cases (Student's t with two degrees of freedom, beyond 2), with twenty in 3.

    Example:
        >>> verdict([0.9, 1.0, 1.2], 0, math.inf), verdict([0.9, 1.0, 1.2], 2, math.inf), verdict([1.0], 0, math.inf)
        ('holds', 'fails', 'undecided')
    """
    if not differences:
        return "undecided"
    mean, spread = interval(differences)
    if low < mean - spread and mean + spread < high:
        return "holds"
    return "fails" if mean + spread <= low or mean - spread >= high else "undecided"


def overall(verdicts: Iterable[Verdict], *, needs_all: bool = False) -> Verdict:
    """Combine verdicts: "holds" if more than half hold and none fails, "fails" if more than half fail and none holds.

    Where some hold and others fail, the claim "depends on the scene". With ``needs_all``, for the checks of one claim,
    all must hold, and a single failure makes it "fails".

    Example:
        >>> overall(["holds", "holds", "undecided"]), overall(["holds", "holds", "fails"]), overall(["fails"])
        ('holds', 'depends on the scene', 'fails')
    """
    found = list(verdicts)
    holds, fails = found.count("holds"), found.count("fails")
    if needs_all:
        return "fails" if fails else "holds" if found and holds == len(found) else "undecided"
    if holds and fails:
        return "depends on the scene"
    return "holds" if holds > len(found) / 2 else "fails" if fails > len(found) / 2 else "undecided"
