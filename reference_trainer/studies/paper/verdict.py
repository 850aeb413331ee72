"""When a claim holds: the rule, for differences of one scene and over scenes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Literal

__all__ = ["Verdict", "interval", "overall", "verdict"]

Verdict = Literal["holds", "fails", "undecided"]
ERRORS = 2.0
"""Half the width of the interval, in standard errors of the mean over the seeds."""


def interval(differences: Sequence[float]) -> tuple[float, float]:
    """Return the mean of differences over the seeds and two standard errors of it, infinite for a single seed.

    Example:
        >>> interval([1.0, 2.0, 3.0])
        (2.0, 1.1547005383792517)
    """
    n = len(differences)
    return statistics.fmean(differences), ERRORS * statistics.stdev(differences) / math.sqrt(n) if n > 1 else math.inf


def verdict(differences: Sequence[float], low: float, high: float) -> Verdict:
    """Return whether the mean lies in (low, high): if two standard errors to both sides do, or all of them outside.

    Where the truth is at an end of the claimed interval, "holds" is a false alarm: 9 of 100 with three seeds (Student's
    t with two degrees of freedom beyond 2), 2.7 with twenty.

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
    """Return the verdict of several: "holds" if most hold and none fails, "fails" if most fail and none holds.

    With ``needs_all``, for the checks of one claim, all must hold, and one that fails is enough.

    Example:
        >>> overall(["holds", "holds", "undecided"]), overall(["holds", "holds", "fails"]), overall(["fails"])
        ('holds', 'undecided', 'fails')
    """
    found = list(verdicts)
    holds, fails = found.count("holds"), found.count("fails")
    if needs_all:
        return "fails" if fails else "holds" if found and holds == len(found) else "undecided"
    if holds > len(found) / 2 and not fails:
        return "holds"
    return "fails" if fails > len(found) / 2 and not holds else "undecided"
