"""Tables of the kept rows, inserted between marks in pages of the docs."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

from benchmarks.paper.beside import beside_table, origins_table, rates_table, seeds_table, sizes_table
from benchmarks.paper.claims import AT_PAPER_SIZE, CLAIMS, TIMED, Check
from benchmarks.paper.comparison import (
    ERRORS,
    RowStore,
    differences,
    interval,
    judged,
    name_of,
    overall,
    ranked,
    tested,
    verdict,
)
from benchmarks.paper.rows import Row, Rows, label, value
from reference_trainer.evaluation.tables import format_mean_std, markdown_table

__all__ = ["TABLES", "claims_table", "details", "gains", "page", "scenes_table"]

_TITLES = {
    "test psnr": ("PSNR", 1.0), "test ssim": ("SSIM", 1.0), "test lpips": ("LPIPS", 1.0), "test ca": ("CA", 1e-3),
    "train ca": ("CA, training views", 1e-3), "test ca_exact": ("exact CA", 1e-3),
    "train ca_exact": ("exact CA, training views", 1e-3), "test ca_exact_half": ("exact CA at 1/2", 1e-3),
    "train ca_exact_half": ("exact CA at 1/2, training views", 1e-3), "test cv": ("CV", 1.0),
    "train cv": ("CV, training views", 1.0), "gaussians": ("Gaussians, k", 1e3), "seconds": ("processor s", 1.0),
    "pace": ("s/iteration", 1.0),
    "test depth_abs_rel": ("depth AbsRel", 1.0), "test depth_rmse": ("depth RMSE", 1.0),
    "renders one": ("A: one render", 1.0), "renders five": ("B: mean of five", 1.0),
    "renders scaled": ("scaled opacities", 1.0),
    "renders mean": ("D: exact mean", 1.0), "depth abs_rel": ("AbsRel", 1.0), "depth rmse": ("RMSE", 1.0),
    "depth mae": ("MAE", 1.0), "depth log10": ("log10", 1.0),
} | {
    figure.format(sixth): (f"{title} at {sixth}/6", unit)
    for sixth in range(1, 7)
    for figure, title, unit in (
        ("path {}", "CA", 1e-3), ("course ca/train {}", "CA, training views,", 1e-3),
        ("course psnr/test {}", "PSNR", 1.0), ("course psnr/train {}", "PSNR, training views,", 1.0))
}  # fmt: skip
_MARKS = re.compile(r"(<!-- paper (\w+)(?: ([\w-]+))?(?: (\d+))? -->\n).*?(<!-- end -->)", re.DOTALL)


def claims_table(store: RowStore) -> str:
    """Return one row per claim with its verdict, overall and by scene."""
    rows: list[dict[str, object]] = []
    columns = ["", "claim", "the paper", "verdict", "scenes (seeds)"]
    for name, claim in CLAIMS.items():
        if not claim.checks or name in AT_PAPER_SIZE:
            continue
        scenes = judged(claim, store)
        known = [end for seeds, end in scenes.values() if seeds > 1]
        verdicts = {end: [f"{scene} ({seeds})" for scene, (seeds, it) in scenes.items() if it == end]
                    for end in ("holds", "fails", "undecided")}  # fmt: skip
        where = "; ".join(f"{end}: {', '.join(of)}" for end, of in verdicts.items() if of)
        final = overall(known) if known else "one seed" if scenes else "not yet measured"
        cells = name, claim.says, claim.paper or "-", final, where or "-"
        rows.append(dict(zip(columns, cells, strict=True)))
    return markdown_table(rows, columns)


def details(name: str, store: RowStore) -> str:
    """Return the table of a claim's settings and its checks for every scene with more than half of the settings."""
    claim, parts = CLAIMS[name], []
    for scene in tested(claim, store):
        found = {}
        for setting in claim.settings:
            if of := [row for row in store.of(scene, setting).values() if claim.needs <= row.keys()]:
                found[name_of(setting, store)] = of
        if 2 * len(found) > len(claim.settings):
            about = store.scenes[scene].content.get("about", "")
            parts.append(f"**{scene}**: {about}\n\n{_table(found, claim.shows)}")
            lines = [
                _line(check, apart, store) for check in claim.checks if (apart := differences(check, scene, store))
            ]
            parts += ["".join(lines)] if lines else []
    return "\n".join(parts)


def gains(name: str, store: RowStore) -> str:
    """Return the settings of a claim as `ranked`, as a table; "" if nothing is known of them."""
    lines: list[dict[str, object]] = []
    for named, mean, of in ranked(name, store):
        lines.append({"setting": f"`{named}`", "mean": f"{mean:+.2f} dB", **of})
    scenes = sorted({column for line in lines for column in line} - {"setting", "mean"})
    return markdown_table(lines, ["setting", "mean", *scenes]) if lines else ""


def scenes_table(store: RowStore) -> str:
    """Return one row per scene: its trainings, their processor hours, and how far the PSNR of seeds differs; then all.

    Standard deviations are of settings with three seeds or more, pooled: of the trainings of one setting, and of the
    differences of two settings, seed by seed. With the number of seeds in the last column, two standard errors of such
    a difference are 0.1 dB.
    """
    columns = ["scene", "trainings", "hours", "one training", "difference of two", "seeds for ± 0.1 dB"]
    lines, trainings, seconds = [], 0, 0.0
    for scene, rows in store.scenes.items():
        of = [row for row in rows.rows if row["setting"]["iterations"] == store.iterations]
        if not of:
            continue
        found: dict[str, dict[int, float]] = {}
        for row in of:
            found.setdefault(label(row["setting"]), {})[row["seed"]] = value(row, "test psnr")
        several = [seeds for seeds in found.values() if len(seeds) > 2]
        apart = [[a[seed] - b[seed] for seed in a.keys() & b.keys()] for a, b in combinations(several, 2)]
        spent = sum(value(row, "seconds") for row in of)
        trainings, seconds = trainings + len(of), seconds + spent
        cells: list[object] = [scene, len(of), f"{spent / 3600:.1f}"]
        if variances := [statistics.variance(each) for each in apart if len(each) > 1]:
            one = math.sqrt(statistics.fmean(statistics.variance(seeds.values()) for seeds in several))
            two = math.sqrt(statistics.fmean(variances))
            cells += [f"{one:.2f} dB", f"{two:.2f} dB", math.ceil((ERRORS * two / 0.1) ** 2)]
        lines.append(dict(zip(columns, cells, strict=False)))
    if len(lines) > 1:
        lines.append({"scene": "all", "trainings": trainings, "hours": f"{seconds / 3600:.1f}"})
    return markdown_table(lines, columns)


TABLES: Mapping[str, Callable[[RowStore], str]] = {
    "claims": claims_table,
    "scenes": scenes_table,
    "beside": beside_table,
    "sizes": sizes_table,
    "seeds": seeds_table,
    "rates": rates_table,
    "origins": origins_table,
}
"""Tables of all rows, by the word in their mark."""


def page(text: str, store: RowStore) -> str:
    """Return the text of a page with everything between its marks regenerated.

    The marks are ``<!-- paper WHAT NAME ITERATIONS -->`` and ``<!-- end -->``. WHAT is a key of `TABLES`, which have
    no NAME, ``details`` or ``gains`` for the claim NAME, ``details`` without a name for all claims, or ``rows`` for all
    rows of ``NAME.json`` beside the folder, whose entry ``usual`` holds the parts of a setting that labels omit.
    ITERATIONS are by default those of ``store``.
    """

    def made(match: re.Match[str]) -> str:
        what, name = match[2], match[3]
        steps = match[4] or (name if what in TABLES else None)
        of = RowStore(store.folder, store.recipe, int(steps)) if steps else store
        if what in TABLES:
            body = TABLES[what](of) or "Not yet measured.\n"
        elif what == "rows":
            body = _rows(Rows(store.folder.parent / f"{name}.json"))
        elif name:
            body = (gains if what == "gains" else details)(name, of) or "Not yet measured.\n"
        else:
            found = {key: details(key, of) for key in CLAIMS if key not in AT_PAPER_SIZE}
            headed = [f"## {_heading(key)}\n\n{text}" for key, text in found.items() if text]
            missing = ", ".join(key for key, text in found.items() if not text)
            body = "\n".join(
                [*headed, f"Not yet measured after {of.iterations:,} steps: {missing}.\n"] if missing else headed
            )
        return f"{match[1]}{body}{match[5]}"

    return _MARKS.sub(made, text)


def _heading(name: str) -> str:
    """Return the heading of a claim, with its number, or of another comparison, without its name."""
    says = CLAIMS[name].says
    return f"{name}. {says}" if name.isdigit() else says[0].upper() + says[1:]


def _rows(rows: Rows) -> str:
    """Return one row per setting, labeled by how it differs from the file's ``usual``."""
    found: dict[str, list[Row]] = {}
    for row in rows.rows:
        found.setdefault(label(row["setting"], rows.content["usual"]), []).append(row)
    return _table(found, TIMED)


def _table(rows: Mapping[str, Sequence[Row]], figures: Sequence[str]) -> str:
    """Return one row per setting: means and sample standard deviations over seeds, of figures that any setting has."""
    lines: list[dict[str, object]] = []
    titles: dict[str, None] = {}
    for name, of in rows.items():
        lines.append({"setting": f"`{name}`" if name != "plain" else name, "seeds": len(of)})
        for figure in figures:
            title, unit = _TITLES[figure]
            values = [value(row, figure) for row in of]
            if any(map(math.isfinite, values)):
                titles[title] = None
                lines[-1][title] = format_mean_std(values, unit=unit)
    order = [title for title, _ in map(_TITLES.__getitem__, figures) if title in titles]
    return markdown_table(lines, ["setting", "seeds", *order])


def _line(check: Check, of: Sequence[float], store: RowStore) -> str:
    """Return a check in words: what is compared, mean and two standard errors, what is claimed, and the verdict."""
    title, unit = _TITLES[check.of]
    unit, sign = (0.01, " %") if check.relative else (unit, "")
    mean, spread = (x / unit for x in interval(of))
    measured = f"{mean:+.3g}{'' if math.isinf(spread) else f' ± {spread:.2g}'}{sign}"
    ends = [
        f"{word} {end / unit:g}{sign}"
        for word, end in (("above", check.low), ("below", check.high))
        if math.isfinite(end)
    ]
    than = _TITLES[check.to or check.of][0]
    pair = f"{name_of(check.a, store)} - {name_of(check.b, store)}" if check.a != check.b else name_of(check.a, store)
    what = title if than == title else f"{title} - {than}"
    return f"- `{pair}`, {what}: {measured} (claimed: {' and '.join(ends)}), {verdict(of, check.low, check.high)}\n"
