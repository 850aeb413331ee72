"""Two settings by the median of the views, which no single view decides; see choice 30 in benchmarks/choices.md.

    python -m benchmarks.by_views measure RUN... --lpips lpips_vgg.pth --out by_views.json    # what is measured is kept
    python -m benchmarks.by_views table by_views.json

A row is a training: PSNR and LPIPS of every held-out view and of every test view, Gaussians, processor time. The names
of the settings do not tell how many steps were trained: those of one file are the same.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any, Literal

import torch
import tyro

from benchmarks.guard import held_out_views
from benchmarks.paper.scenes import SCENES
from benchmarks.setting import TODAY, candidate
from reference_trainer.evaluation.lpips import LPIPS, load_lpips
from reference_trainer.evaluation.metrics import on_white, view_psnr
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.json_files import read_json
from reference_trainer.runs.folder import read_run_settings
from reference_trainer.runs.measure import load_run_model

__all__ = ["difference", "main", "measured", "table", "tables"]

Row = dict[str, Any]
"""``scene``, ``candidate`` and ``seed``; ``held-out`` and ``test``, the figures of each view by its name;
``gaussians``, ``seconds`` and ``cpu``."""
_OVER: dict[str, Callable[[Iterable[float]], float]] = {"held-out": median, "test": fmean}
"""What makes the figure of a scene from those of its views: one veiled view of three shall not choose."""
_COLUMNS = {f"{split} {title}": (split, title.lower()) for split in _OVER for title in ("PSNR", "LPIPS")}
_RATIOS = {"Gaussians": "gaussians", "processor time": "seconds"}
_FORMS = {"psnr": "{:+.2f}", "lpips": "{:+.3f}"}


def main(
    what: Annotated[Literal["measure", "table"], tyro.conf.Positional],
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("runs/by_views.json"),
    lpips: Path | None = None,
) -> None:
    """Measure runs, or print the tables of what was measured.

    Args:
        what: "measure" or "table".
        paths: folders of runs, or one file of rows.
        out: the file of rows, which is continued.
        lpips: weights of the perceptual metric, which measuring needs.
    """
    if what == "table":
        print(*tables(json.loads(paths[0].read_text("utf-8"))), sep="\n\n")
        return
    torch.set_num_threads(1)
    perceptual = load_lpips(lpips)
    if perceptual is None:
        raise ValueError("LPIPS is half of what is measured: give its weights, --lpips FILE.")
    rows: list[Row] = json.loads(out.read_text("utf-8")) if out.exists() else []
    known = {(row["scene"], row["candidate"], row["seed"]) for row in rows}
    for run in paths:
        options, config = read_run_settings(run / "config.json")
        if (Path(options.path).name, candidate(config), config.seed) not in known:
            rows.append(measured(run, perceptual))
            write_json(out, rows)
            print(run.name, flush=True)


def measured(run: Path, perceptual: LPIPS) -> Row:
    """Return the row of a finished training."""
    model, scene = load_run_model(run)
    options, config = read_run_settings(run / "config.json")
    row: Row = {"scene": Path(options.path).name, "candidate": candidate(config), "seed": config.seed}
    for split, views in {"held-out": held_out_views(options, config.seed), "test": scene.test}.items():
        row[split] = {"psnr": {}, "lpips": {}}
        for view in views:
            image = model.test_rendering(view).image.clamp(0, 1)
            pair = on_white(image, view.mask), on_white(view.image, view.mask)
            row[split]["psnr"][view.name] = round(view_psnr(image, view), 4)
            row[split]["lpips"][view.name] = round(perceptual(*pair), 5)
    results = read_json(run / "results.json")
    return row | {
        "gaussians": results["gaussians"],
        "seconds": results["processor_seconds"],
        "cpu": results["machine"]["cpu"],
    }


def difference(before: Sequence[Row], after: Sequence[Row], split: str, figure: str) -> float:
    """Return what a figure changes by on a scene: of each view the mean over the seeds, of these what `_OVER` says."""
    views = before[0][split][figure]
    old, new = ([fmean(row[split][figure][name] for row in rows) for name in views] for rows in (before, after))
    return _OVER[split](b - a for a, b in zip(old, new, strict=True))


def tables(rows: Sequence[Row]) -> list[str]:
    """Return a table of what the recipe changes over plain trainings, and one of what each candidate does over it."""
    names = dict.fromkeys(row["candidate"] for row in rows if row["candidate"] != TODAY)
    return [table(rows, name, TODAY) if name == "plain" else table(rows, TODAY, name) for name in names]


def table(rows: Sequence[Row], former: str, latter: str) -> str:
    """Return a table of what the latter of two settings changes on each scene, by the seeds that both have."""
    lines, changes, pairs = [], defaultdict[str, list[float]](list), list[float]()
    for scene in SCENES:
        old, new = (
            {r["seed"]: r for r in rows if (r["scene"], r["candidate"]) == (scene, name)} for name in (former, latter)
        )
        seeds = sorted(old.keys() & new.keys())
        if not seeds:
            continue
        before, after = ([of[seed] for seed in seeds] for of in (old, new))
        pairs += [difference([a], [b], "test", "psnr") for a, b in zip(before, after, strict=True)]
        line = {"scene": scene, "seeds": str(len(seeds))}
        for title, (split, figure) in _COLUMNS.items():
            changes[title].append(difference(before, after, split, figure))
            line[title] = _FORMS[figure].format(changes[title][-1])
        for title, figure in _RATIOS.items():
            line[title] = f"{fmean(r[figure] for r in after) / fmean(r[figure] for r in before):.2f}"
        lines.append(line)
    mean = {title: _FORMS[figure].format(fmean(changes[title])) for title, (_, figure) in _COLUMNS.items()}
    last = dict.fromkeys(lines[0], "-") | {"scene": "mean"} | mean
    titles = [x.removeprefix(f"{TODAY} + ").replace(TODAY, "recipe") for x in (latter, former)]
    return (
        f"{' over '.join(titles)}:\n\n{markdown_table([*lines, last], [*last])}\n"
        f"- test PSNR, {len(pairs)} pairs: {min(pairs):+.2f} to {max(pairs):+.2f} dB, {fmean(pairs):+.2f} in the mean"
    )


if __name__ == "__main__":
    tyro.cli(main)
