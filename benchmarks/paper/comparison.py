"""Comparisons of the kept rows: settings seed by seed, the rule by which a claim holds, and settings ranked."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from benchmarks.paper.claims import CLAIMS, Check, Claim, Setting
from benchmarks.paper.rows import Row, Rows, label, resolved, value
from benchmarks.paper.scenes import PAPER_SIZE, SCENES

__all__ = [
    "ERRORS",
    "FEW_SEEDS",
    "Gain",
    "RowStore",
    "Verdict",
    "differences",
    "interval",
    "judged",
    "name_of",
    "overall",
    "ranked",
    "tested",
    "undecided",
    "verdict",
]

Verdict = Literal["holds", "fails", "undecided", "depends on the scene"]
ERRORS = 2.0
"""Half the width of the interval, in standard errors of the mean over the seeds."""
FEW_SEEDS = 3
"""How many seeds are looked at before more are trained for what they do not decide."""


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


class RowStore:
    """The kept rows of all scenes in a folder, looked up for one recipe, number of iterations, and the first seeds.

    Args:
        folder: with ``NAME.json`` for each scene.
        recipe: of settings that do not name another.
        iterations: of every training.
        seeds: only seeds below this number; None for all.
    """

    def __init__(self, folder: Path, recipe: str = "3dgs", iterations: int = 3_000, seeds: int | None = None) -> None:
        self.folder, self.recipe, self.iterations, self.seeds = folder, recipe, iterations, seeds
        self.scenes = {file.stem: Rows(file) for file in sorted(folder.glob("*.json"))}

    def of(self, scene: str, setting: Mapping[str, object]) -> dict[int, Row]:
        """Return the rows of a setting on a scene by seed."""
        kept = self.scenes.get(scene)
        found = kept.of(resolved(setting, self.recipe, self.iterations)) if kept else {}
        return {seed: row for seed, row in found.items() if self.seeds is None or seed < self.seeds}


def tested(claim: Claim, store: RowStore) -> list[str]:
    """Return the kept scenes that a claim is tested on: those it names, and a user's own."""
    return [scene for scene in store.scenes if scene in claim.scenes or scene not in SCENES | PAPER_SIZE]


def differences(check: Check, scene: str, store: RowStore) -> list[float]:
    """Return the finite differences that a check is about, one per seed that has both figures."""
    a, b = store.of(scene, check.a), store.of(scene, check.b)
    pairs = [(value(a[seed], check.of), value(b[seed], check.to or check.of)) for seed in sorted(a.keys() & b.keys())]
    found = [(x - y) / (y if check.relative else 1.0) for x, y in pairs]
    return [difference for difference in found if math.isfinite(difference)]


def judged(claim: Claim, store: RowStore) -> dict[str, tuple[int, Verdict]]:
    """Return, for every scene with measurements for all checks of a claim, the number of seeds and the verdict."""
    found = {}
    for scene in tested(claim, store):
        of = [(check, differences(check, scene, store)) for check in claim.checks]
        if of and all(seeds for _, seeds in of):
            verdicts = [verdict(seeds, check.low, check.high) for check, seeds in of]
            found[scene] = min(len(seeds) for _, seeds in of), overall(verdicts, needs_all=True)
    return found


def undecided(claim: Claim, scene: str, store: RowStore) -> list[Setting]:
    """Return the settings of the checks of a claim that the rows of a scene do not decide, none if it fails there."""
    open_ends = list[Setting]()
    for check in claim.checks:
        end = verdict(differences(check, scene, store), check.low, check.high)
        if end == "fails":
            return []
        open_ends += [check.a, check.b] if end == "undecided" else []
    return open_ends


class Gain(NamedTuple):
    """How a setting differs from the plain training on one scene.

    Attributes:
        psnr: mean difference in PSNR over the seeds, dB.
        error: two standard errors of it.
        score: mean relative difference in the exact score at 1/2; nan if it was not measured.
    """

    psnr: float
    error: float
    score: float

    def __str__(self) -> str:
        less = "" if math.isnan(self.score) else f", {100 * self.score:+.0f} %"
        return f"{self.psnr:+.2f} ± {self.error:.2f} dB{less}"


def ranked(name: str, store: RowStore) -> list[tuple[str, float, dict[str, Gain]]]:
    """Return the settings of a claim, each compared with the plain training of the same views and recipe, best first.

    They are compared on every scene with at least two kept seeds of most settings, and sorted by the mean over scenes
    of the difference in PSNR; those that lack a scene come last.

    Returns:
        For every setting its label, that mean, and its gain by scene.
    """
    claim, found = CLAIMS[name], dict[str, dict[str, Gain]]()
    for setting in claim.settings:
        plain = {key: x for key, x in setting.items() if key in ("recipe", "views")}
        for scene in tested(claim, store) if setting != plain else ():
            of = differences(Check("test psnr", setting, plain), scene, store)
            score = differences(Check("test ca_exact_half", setting, plain, relative=True), scene, store)
            if len(of) > 1:
                gain = Gain(*interval(of), statistics.fmean(score or [math.nan]))
                found.setdefault(name_of(setting, store), {})[scene] = gain
    counts = Counter(scene for of in found.values() for scene in of)
    common = sorted(scene for scene, count in counts.items() if 2 * count >= len(found))
    shown = {named: {scene: of[scene] for scene in common if scene in of} for named, of in found.items()}
    rows = [(named, statistics.fmean(gain.psnr for gain in of.values()), of) for named, of in shown.items() if of]
    return sorted(rows, key=lambda row: (len(row[2]), row[1]), reverse=True)


def name_of(setting: Mapping[str, object], store: RowStore) -> str:
    """Return the label of a setting among those of the same recipe."""
    return label(setting, {"recipe": store.recipe})
