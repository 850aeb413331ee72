"""Trainings that start from other points, or with cameras of the training photographs alone: benchmarks/dense_start.md.

    python -m benchmarks.starts benchmarks/data/setting.json    # where `benchmarks.setting measure` keeps the rows

Their scenes are made by `benchmarks.start_scenes`.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np

from benchmarks.choices import Choice, gains_of
from benchmarks.paper.rows import value
from benchmarks.paper.scenes import SCENES
from benchmarks.setting import BINOCULAR, CHOSEN, LATER, RELATIVE, Row, rows_of
from benchmarks.start_scenes import FEW_AND_RANDOM, MANY, OTHER, SIFT, from_dense
from reference_trainer.evaluation.tables import format_mean_std, markdown_table, mean_std

__all__ = ["changed", "choice", "judgement", "many", "own_cameras", "tables"]

CHOOSING = ("fern", "herz-jesu", "fountain", "sceaux", "cape", "dtu-scan65")
"""The scenes whose held-out views choose a start."""
FINER = Choice(("finer",), seeds=range(20), tried=(0, 1, 2), starts=True)
"""The start that is measured on finer photographs than those that train."""
FROM = {CHOSEN: "from 150", LATER: "from 1,000"}


def choice(rows: Sequence[Row], starts: Sequence[str], seed: int = 0) -> str:
    """Return the table of starts: PSNR of held-out and of test views, and the gain over the first in the mean."""
    lines: list[dict[str, str]] = []
    base = {scene: row for scene in CHOOSING if (row := _rows(rows, scene, starts[0], CHOSEN).get(seed))}
    for start in starts:
        for begun in (CHOSEN, LATER):
            found = {scene: row for scene in base if (row := _rows(rows, scene, start, begun).get(seed))}
            if not found:
                continue
            line = {"points": start, "density control": FROM[begun]}
            line |= {scene: "{:.2f} / {:.2f}".format(*_figures(row)) for scene, row in found.items()}
            gains = [np.subtract(_figures(row), _figures(base[scene])) for scene, row in found.items()]
            line |= {"gain": "{:+.2f} / {:+.2f}".format(*np.mean(gains, 0)), "scenes": str(len(gains))}
            lines.append(line)
    columns = ["points", "density control", *base, "gain", "scenes"]
    return markdown_table([dict.fromkeys(columns, "-") | line for line in lines], columns)


def judgement(rows: Sequence[Row], start: str) -> str:
    """Return the table of the chosen start against the one before, test views, with the seeds that both have."""
    lines, every, spreads = [], list[float](), list[float]()
    for scene in SCENES:
        before, after = _rows(rows, scene, FEW_AND_RANDOM, CHOSEN), _rows(rows, scene, start, LATER)
        if shared := sorted(before.keys() & after.keys()):
            pairs = [[value(of[seed], "test psnr") for seed in shared] for of in (before, after)]
            gains = [b - a for a, b in zip(*pairs, strict=True)]
            every.append(fmean(gains))
            if len(after) > 1:
                spreads.append(mean_std(value(row, "test psnr") for row in after.values())[1])
            lines.append({
                "scene": scene, "seeds": str(len(shared)), "before": format_mean_std(pairs[0], decimals=2),
                "now": format_mean_std(pairs[1], decimals=2), "gain, by seed": ", ".join(f"{x:+.2f}" for x in gains),
            })  # fmt: skip
    if not lines:
        return f"Nothing of {start!r} was judged."
    total = [f"- mean gain over {len(every)} scenes: {fmean(every):+.1f} dB; the least: {min(every):+.1f} dB"]
    if spreads:
        total.append(f"- standard deviation of seeds now, mean over {len(spreads)} scenes: {fmean(spreads):.2f} dB")
    return "\n".join([markdown_table(lines, [*lines[0]]), "", *total])


def changed(rows: Sequence[Row], start: str) -> str:
    """Return the table of a changed dense start: what trainings from it gain over those from the one before."""
    lines, settings = [], {"recipe": LATER, "plain 3DGS": "plain", BINOCULAR: f"{BINOCULAR}{RELATIVE}"}
    for scene, (title, name) in itertools.product([*SCENES][::-1], settings.items()):
        before, after = (rows_of(rows, of, name) for of in (from_dense(scene), f"{scene}, {start}"))
        if not (shared := sorted(before.keys() & after.keys())):
            continue
        pairs = [[value(of[seed], "test psnr") for seed in shared] for of in (before, after)]
        lines.append({
            "scene": scene, "setting": title, "seeds": str(len(shared)),
            "as it was": format_mean_std(pairs[0], decimals=2), start: format_mean_std(pairs[1], decimals=2),
            "gain, by seed": ", ".join(f"{b - a:+.2f}" for a, b in zip(*pairs, strict=True)),
            "at held-out views": ", ".join(
                f"{after[seed][key] - before[seed][key]:+.2f}" for seed in shared if (key := "held-out") in after[seed]
            ) or "-",
        })  # fmt: skip
    return markdown_table(lines, [*lines[0]]) if lines else f"Nothing was trained from the points {start!r}."


def own_cameras(rows: Sequence[Row]) -> str:
    """Return the table of trainings with cameras of three photographs alone: PSNR of the others, and Gaussians."""
    lines = []
    for scene in SCENES:
        before = rows_of(rows, f"{scene}-own", CHOSEN).get(0)
        after = rows_of(rows, f"{scene}-own, dense and few", LATER).get(0)
        if before and after:
            figures = [value(row, "test psnr") for row in (before, after)]
            lines.append({
                "scene": scene, "few and random, from 150": f"{figures[0]:.2f}",
                "dense and few, from 1,000": f"{figures[1]:.2f}", "gain": f"{figures[1] - figures[0]:+.2f}",
                "Gaussians": f"{before['gaussians']:,} / {after['gaussians']:,}",
            })  # fmt: skip
    return markdown_table(lines, [*lines[0]]) if lines else "Nothing was trained with cameras of its own."


def many(rows: Sequence[Row]) -> str:
    """Return the table of trainings with 14 and 16 photographs: PSNR of held-out and test views, and the gains."""
    lines, every = [], list[tuple[float, float]]()
    for scene in MANY:
        names = ("measured" if scene in SIFT else "random points", "dense and measured")
        before, after = (rows_of(rows, f"{scene}-many, {name}", LATER) for name in names)
        if shared := sorted(before.keys() & after.keys()):
            pairs = [[np.mean([_figures(of[seed]) for seed in shared], 0) for of in (before, after)]]
            gains = [np.subtract(_figures(after[seed]), _figures(before[seed])) for seed in shared]
            every.append(tuple(np.mean(gains, 0)))
            line = {"scene": scene, "photographs": str(MANY[scene]), "points": names[0]}
            line |= {
                title: "{:.2f} / {:.2f}".format(*x) for title, x in zip(("as now", "dense start"), *pairs, strict=True)
            }
            line["gain, by seed"] = ", ".join("{:+.2f} / {:+.2f}".format(*gain) for gain in gains)
            line["Gaussians"] = " / ".join(
                f"{np.mean([of[seed]['gaussians'] for seed in shared]):,.0f}" for of in (before, after)
            )
            lines.append(line)
    if not lines:
        return "Nothing was trained with more than ten photographs."
    mean = "- mean gain at held-out / test views: {:+.2f} / {:+.2f} dB".format(*np.mean(every, 0))
    return "\n".join([markdown_table(lines, [*lines[0]]), "", mean])


def tables(rows: Sequence[Row]) -> list[str]:
    """Return all tables of the page that come from trainings."""
    few = [FEW_AND_RANDOM, "dense", "dense and few", "dense, few and random"]
    return [
        choice(rows, few),
        choice(rows, ["SIFT", "dense and SIFT"]),
        choice(rows, ["other", "dense and other"]),
        judgement(rows, "dense and few"),
        own_cameras(rows),
        many(rows),
        gains_of(rows, FINER),
        *(changed(rows, start) for start in ("farther", "as now")),
    ]


def _figures(row: Row) -> tuple[float, float]:
    return row["held-out"], value(row, "test psnr")


def _rows(rows: Sequence[Row], scene: str, start: str, candidate: str) -> dict[int, Row]:
    """Return the rows of a start by seed, which at some scenes has another name."""
    if scene not in SIFT:  # no measured point
        start = {FEW_AND_RANDOM: "random points", "dense and few": "dense"}.get(start, start)
    declared = {"lego": "random points", "fountain": "SIFT", "herz-jesu": "SIFT"} | dict.fromkeys(OTHER, "other")
    return rows_of(rows, scene if start == declared.get(scene) else f"{scene}, {start}", candidate)


if __name__ == "__main__":
    print(*tables(json.loads(Path(sys.argv[1]).read_text("utf-8"))), sep="\n\n")
