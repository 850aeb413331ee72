"""The study of failures, from the rows of `benchmarks.setting`; see benchmarks/failures.md.

python -m benchmarks.failures benchmarks/data/setting.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from statistics import fmean, median

import numpy as np
from scipy.stats import binomtest, spearmanr

from benchmarks.choices import name_on
from benchmarks.paper.rows import value
from benchmarks.setting import (
    BINOCULAR,
    CHOSEN,
    DENSE,
    FEWEST,
    LATER,
    ONE_EXPOSURE,
    REFERENCES,
    RELATIVE,
    TODAY,
    Row,
    references_of,
    rows_of,
)
from benchmarks.start_scenes import from_dense, from_today
from reference_trainer.evaluation.tables import markdown_table, mean_std

__all__ = ["FAILING", "failures", "foreseen", "predicted"]

FAILURE = 1.0
"""A training so many dB below the median of its scene and setting has failed."""
PLAIN_DENSE = "plain, dense start"
"""What a user would have without the recipe."""
FROM_DENSE = {LATER: DENSE, "plain": PLAIN_DENSE} | {
    name: f"{name.removesuffix(RELATIVE)}, dense start"
    for name in ("dropout", "noise", "expectation", f"{BINOCULAR}{RELATIVE}")
}
"""The settings of the study from the start that a user has, by the names of their rows."""
PLAIN_TODAY = "plain, today's start"
FROM_TODAY = {f"{TODAY} + {ONE_EXPOSURE}": "as `ca-reg run` trains", "plain": PLAIN_TODAY}
"""The same as a user has it today."""
FAILING = ("herz-jesu", "fountain", "dtu-scan65", "sceaux")
"""The scenes of the study."""
PREDICTED = (13, 14, 15)
"""The seeds of which the page predicts which is the better one."""


def failures(rows: Sequence[Row], references: Path = REFERENCES) -> str:
    """Return the table of the seeds: median, spread and the worst by scene and setting, and how often one fails."""
    lines, counts, ahead = [], dict[str, list[bool]](), dict[str, list[float]]()
    for scene in FAILING:
        dense, today = from_dense(scene), from_today(scene)
        every = {label: rows_of(rows, today, name_on(scene, name)) for name, label in FROM_TODAY.items()}
        every |= {label: rows_of(rows, dense, name) for name, label in FROM_DENSE.items()}
        every |= {name: rows_of(rows, scene, name) for name in (LATER, CHOSEN)}
        every |= references_of(rows, references, scene)
        figures = {
            name: {seed: value(row, "test psnr") for seed, row in of.items()}
            for name, of in every.items()
            if len(of) >= FEWEST
        }
        for name, of in figures.items():
            middle, worst = median(of.values()), min(of.values())
            failed = [x < middle - FAILURE for x in of.values()]
            counts.setdefault(name, []).extend(failed)
            lines.append({
                "scene": scene, "setting": name, "seeds": str(len(of)), "median": f"{middle:.2f}",
                "standard deviation": f"{mean_std(of.values())[1]:.2f}", "worst": f"{worst:.2f}",
                "to the median": f"{worst - middle:+.2f}", "failures": str(sum(failed)),
            })  # fmt: skip
        begun = (FROM_TODAY, PLAIN_TODAY), (FROM_DENSE, PLAIN_DENSE)
        pairs = [(label, plain) for labels, plain in begun for label in labels.values() if label != plain]
        for name, other in (*pairs, (LATER, "plain"), (CHOSEN, "plain")):
            own, plain = (figures.get(x, {}) for x in (name, other))
            ahead.setdefault(name, []).extend(own[seed] - plain[seed] for seed in own.keys() & plain.keys())
    if not lines:
        return f"No setting has {FEWEST} seeds."
    shares = [f"{name}: {_share(of)} fail" for name, of in counts.items()]
    shares += [
        f"{name} below plain, same seed: {_share([x < 0 for x in of])}; the least gain {min(of):+.2f} dB"
        for name, of in ahead.items()
        if of
    ]
    return "\n".join([markdown_table(lines, list(lines[0])), "", *(f"- {line}" for line in shares)])


def foreseen(rows: Sequence[Row]) -> str:
    """Return the table of what the expected PSNR tells of the recipe's seeds, where it was kept of at least three.

    A training's shortfall is how far its expected PSNR lies below the median of the seeds at the camera, of those that
    nobody took, where it lies lowest.
    """
    lines = []
    for scene in FAILING:
        of = [row for row in rows_of(rows, from_dense(scene), LATER).values() if "expected" in row]
        if len(of) < FEWEST:
            continue
        of.sort(key=lambda row: value(row, "test psnr"))
        figures, expected = [value(row, "test psnr") for row in of], np.array([row["expected"] for row in of])
        shortfalls = (np.median(expected, 0) - expected).max(1)
        lines.append({
            "scene": scene, "seeds": str(len(of)), "test PSNR, rising": ", ".join(f"{x:.2f}" for x in figures),
            "shortfall": ", ".join(f"{x:.1f}" for x in shortfalls),
            "rank correlation": f"{spearmanr(figures, shortfalls).statistic:.2f}",
            "of the mean expected PSNR": f"{spearmanr(figures, expected.mean(1)).statistic:.2f}",
        })  # fmt: skip
    return markdown_table(lines, list(lines[0])) if lines else f"No scene has {FEWEST} seeds with an expected PSNR."


def predicted(rows: Sequence[Row]) -> str:
    """Return in how many pairs of seeds the higher mean expected PSNR has the higher test PSNR."""
    right = list[bool]()
    for scene in FAILING:
        of = rows_of(rows, from_dense(scene), LATER)
        known = [(fmean(of[seed]["expected"]), value(of[seed], "test psnr")) for seed in PREDICTED if seed in of]
        right += [(a[0] > b[0]) == (a[1] > b[1]) for a, b in combinations(known, 2)]
    return f"- the higher mean expected PSNR has the higher test PSNR in {sum(right)} of {len(right)} pairs"


def _share(of: Sequence[bool]) -> str:
    """Return a share with its interval of 95 % (Clopper and Pearson)."""
    if not of:
        return "0 of 0"
    low, high = binomtest(sum(of), len(of)).proportion_ci(method="exact")
    return f"{sum(of)} of {len(of)} ({100 * low:.0f} to {100 * high:.0f} %)"


if __name__ == "__main__":
    kept = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    print(failures(kept), foreseen(kept), predicted(kept), sep="\n\n")
