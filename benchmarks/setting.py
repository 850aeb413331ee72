"""The setting for few photographs: candidates by held-out views, the chosen one judged; see benchmarks/choices.md.

    python -m benchmarks.setting measure RUN... --out setting.json    # folders of runs; what is measured is kept
    python -m benchmarks.setting shared REFERENCE RUN... --out setting.json    # of one scene; their rows are there
    python -m benchmarks.setting table setting.json

A row is a training: PSNR of held-out views of training kind, which alone choose, and what `ca-reg train` has measured
at the test views. Plain 3DGS and dropout alone, against which the chosen one is judged, are rows of the paper's grid,
and of further seeds.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal

import torch
import tyro

from benchmarks.guard import held_out_views, quality, shared
from benchmarks.paper.rows import Rows, value
from benchmarks.paper.scenes import SCENES
from benchmarks.start_scenes import FEW_AND_RANDOM, STARTS, from_dense
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.lpips import LPIPS, load_lpips
from reference_trainer.evaluation.metrics import on_white
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.tables import format_mean_std, markdown_table, mean_std
from reference_trainer.json_files import read_json
from reference_trainer.runs.folder import read_run_settings
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.virtual_cameras import unseen_views
from reference_trainer.training.config import TrainConfig

__all__ = [
    "binocular",
    "candidate",
    "choosing",
    "controls",
    "differences",
    "judging",
    "main",
    "measured",
    "references_of",
    "rows_of",
    "second",
    "starts",
    "tables",
]

Row = dict[str, Any]
"""``scene``, ``candidate`` and ``seed``, ``held-out`` PSNR if there are such views, ``shared`` PSNR, of their pixels
that two training photographs show, ``test`` figures, ``gaussians``; of the recipe from the dense start the PSNR
``expected`` of views that nobody took."""

_SECOND: dict[str, tuple[str, Any]] = {
    "until 2,000": ("densify_until", 2_000),
    "from 500": ("densify_from", 500),
    "from 1,000": ("densify_from", 1_000),
    "no reset": ("opacity_reset_every", 0),
    "rate 0.1": ("dropout", 0.1),
    "rate 0.3": ("dropout", 0.3),
    "rate 0.35": ("dropout", 0.35),
    "threshold 2e-4": ("densify_gradient", 2e-4),
    "threshold 3e-4": ("densify_gradient", 3e-4),
    "degree 1": ("sh_degree", 1),
    "random background": ("random_background", "on"),
    "smooth 0.1": ("loss", "smooth_depth(between(0.1,"),
    "smooth 0.5": ("loss", "smooth_depth(between(0.5,"),
    "early": ("loss", "smooth_depth(between(0.1,0))"),
    "extent 0.05": ("loss", "ray_extent(0.01, limit=0.05)"),
    "extent 0.1": ("loss", "ray_extent(0.01, limit=0.1)"),
    "warp": ("loss", "warp("),
    "hidden left out": ("loss", "hidden="),
    "every second step": ("loss", "every=2"),
    "no smoothness": ("loss", "smooth=0.0"),
    "depth of the points": ("loss", "pearson("),
    "flat": ("loss", "flat("),
    "D-SSIM 0.4": ("loss", "photometric(0.4)"),
    "threshold 7e-4": ("densify_gradient", 7e-4),
    "score 3": ("loss", "co_adaptation(between(3.0,"),
    "score 1": ("loss", "co_adaptation(between(1.0,"),
    "needles": ("loss", "Needles(0.02,"),
    "needles, weakly": ("loss", "Needles(0.002,"),
    "absgrad": ("density", "absgrad"),
    "limit 0.2": ("density", "LimitedDensity(0.2)"),
    "limit 0.1": ("density", "LimitedDensity(0.1)"),
    "opaque": ("initial_opacity", 0.5),
    "small": ("initial_scale", 0.5),
    "large": ("initial_scale", 1.5),
    "means x4": ("means_rate", 6.4e-4),
    "means x1/4": ("means_rate", 4e-5),
    "means by pixels": ("means_rate", (2.45e-3, 4.7e-4, 5.2e-4, 2.5e-4, 5e-4, 1.67e-4)),
    "opacities x1/2": ("opacity_rate", 0.025),
    "scales x1/2": ("scales_rate", 2.5e-3),
    "colors x1/2": ("color_rate", 1.25e-3),
    "without dropout": ("dropout", 0.0),
    "without decay": ("opacity_decay", 1.0),
}
"""What a candidate of the later choices changes in the chosen setting: a field and its value or values, of a loss the
term."""
_FIGURES = "psnr", "ssim", "lpips", "ca_exact_half"
CHOSEN = "drawn"
"""What the first choice chose, and the second started from: ``--recipe sparse --densify-from 150``."""
LATER = "from 1,000"
"""What the second choice chose: ``--recipe sparse --random-background off``."""
ANY_COLOR = f"{LATER} + random background"
"""What the twentieth chose: ``--recipe sparse --loss photometric``, but on `SHOWN`."""
TODAY = f"{ANY_COLOR} + smooth 0.1"
"""What the twenty-seventh chose: ``--recipe sparse``, but on `SHOWN`."""
SHOWN = ("dtu-scan65", "dtu-scan24", "lego")
"""The scenes whose photographs show the background, over which the recipe stays."""
DENSE = "from 1,000, dense start"
"""The same as a user has it, with the start that it has by default."""
ONE_EXPOSURE = "one exposure"
"""What the tenth choice adds: photographs made equally bright, ``--one-exposure``."""
MEAN_BACKGROUND, ELSEWHERE, PLANES = "mean background", "smooth 0.5 elsewhere", "planes"
"""What the eighteenth, the twenty-sixth and the twenty-eighth choice tried; their code was not kept."""
DISTILLED = {1: "distilled, alone", 2: "distilled of two", 3: "distilled of three"}
"""What the eleventh choice adds, by the number of models."""
TWICE, HALF, THIRD = "twice the steps", "half the steps", "a third of the steps"
"""What takes as long as the second of these, and what the thirteenth choice distills."""
_STEPS = {6_000: TWICE, 1_500: HALF, 1_000: THIRD, 5_000: "5,000 steps", 2_500: "2,500 steps"}
"""The names by the number of steps."""
BINOCULAR, RELATIVE = "Binocular3DGS, dropout", ", relative shift"
"""A setting of others, and the end of its name where the shift of its warp goes by the distance of the cameras."""
OTHER_KINDS = tuple(
    f"distilled with {kind}"
    for kind in (
        "means x1/4",
        "D-SSIM 0.4 + threshold 7e-4",
        "warp + hidden left out",
        f"{BINOCULAR}{RELATIVE}",
        "means x1/4, warp + hidden left out",
    )
)
"""What the twelfth choice adds, by the kinds of the other models."""
SEEDS = 5
"""So many, from 0 on, judge the chosen one."""
FEWEST = 3
"""From so many seeds on, a setting stands in the table of failures."""
HELD_OUT = tuple(scene for scene in SCENES if scene not in ("lego", "dtu-scan24"))
"""The scenes whose held-out views choose."""
REFERENCES = Path(__file__).with_name("data") / "paper"
"""Folder with the rows of the paper's grid."""
_REFERENCES: dict[str, dict[str, Any]] = {
    "plain": {},
    "dropout": {"regularizer": "dropout(0.2)"},
    "noise": {"regularizer": "noise(0.8)"},
    "expectation": {"regularizer": "dropout(0.2)", "analytic": True},
    BINOCULAR: {"recipe": "binocular", "regularizer": "dropout(0.2)"},
}


def main(
    what: Annotated[Literal["measure", "shared", "table"], tyro.conf.Positional],
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("runs/setting.json"),
    lpips: Path | None = None,
) -> None:
    """Measure runs, or print the tables of what was measured.

    Args:
        what: "measure"; "shared", for the pixels that two training photographs share; or "table".
        paths: folders of runs, for "shared" first the one whose depth tells these pixels; or one file of rows.
        out: the file of rows, which is continued.
        lpips: weights of the perceptual metric, for runs that were trained without.
    """
    torch.set_num_threads(1)
    if what == "measure":
        rows: list[Row] = json.loads(out.read_text("utf-8")) if out.exists() else []
        known = {(row["scene"], row["candidate"], row["seed"]) for row in rows}
        for run in paths:
            options, config = read_run_settings(run / "config.json")
            if (_scene(options), candidate(config, options), config.seed) not in known:
                rows.append(measured(run, load_lpips(lpips)))
                write_json(out, rows)
    elif what == "shared":
        rows = json.loads(out.read_text("utf-8"))
        options, config = read_run_settings(paths[0] / "config.json")
        masks = {x.name: x.mask for x in shared(*load_run_model(paths[0]), held_out_views(options, config.seed))}
        for run in paths[1:]:
            options, config = read_run_settings(run / "config.json")
            own = (view for view in held_out_views(options, config.seed) if view.name in masks)  # of its exposure
            views = [dataclasses.replace(view, mask=masks[view.name]) for view in own]
            row = rows_of(rows, _scene(options), candidate(config, options))[config.seed]
            row["shared"] = fmean(quality(load_run_model(run)[0], view) for view in views)
            write_json(out, rows)
    else:
        rows = json.loads(paths[0].read_text("utf-8"))
    print(*tables(rows), sep="\n\n")


def tables(rows: Sequence[Row]) -> list[str]:
    """Return all tables of the page."""
    judged = [judging(rows), judging(rows, chosen=LATER)]
    return [
        choosing(rows),
        second(rows),
        second(rows, (0, 1)),
        *judged,
        binocular(rows),
        controls(rows),
        starts(rows),
    ]


def candidate(config: TrainConfig, options: SceneOptions | None = None) -> str:
    """Return the name of a candidate, or of what it is compared with.

    Example:
        >>> candidate(TrainConfig(dropout=0.2, analytic=True, opacity_decay=0.998))
        'expectation, decay 0.998'
    """
    if options is not None and options.one_exposure:
        return f"{candidate(config)} + {ONE_EXPOSURE}"
    if config.random_background == "auto":
        shown = options is not None and Path(options.path).name in SHOWN
        config = dataclasses.replace(config, random_background="off" if shown else "on")
    if "distillation(" in config.loss:
        smooth = " + smooth 0.1" * ("smooth_depth(" in _members(config.loss)[0].loss)
        learner = (LATER if config.random_background == "off" else ANY_COLOR) + smooth if config.dropout else "plain"
        return f"{learner} + {_distilled(config.loss)}" + ", smoothly" * ("smooth_depth(" in config.loss)
    begins = 10 * round(300 * config.densify_from / config.iterations)  # of 3,000 steps
    if config.analytic:
        return "expectation" + (f", decay {config.opacity_decay}" if config.opacity_decay < 1 else "")
    if config.guard:  # which is the recipe's alone
        config = dataclasses.replace(config, densify_from=begins)
        values = {name: (getattr(config, field), value) for name, (field, value) in _SECOND.items()}
        changes = [
            name
            for name, (x, value) in values.items()
            if (value in x if isinstance(x, str) else x in value if isinstance(value, tuple) else x == value)
        ]
        return " + ".join([*changes, *(name for steps, name in _STEPS.items() if steps == config.iterations)]) or CHOSEN
    if "warp" in config.loss:
        return "Binocular3DGS" + ", dropout" * bool(config.dropout) + RELATIVE * ("relative" in config.loss)
    name = "dropout" if config.dropout else "noise" if config.noise else "plain"
    return name + (f", {LATER}" if begins == 1_000 else "")


def _members(loss: str) -> list[TrainConfig]:
    """Return the settings of the models that a loss distills."""
    return [read_run_settings(Path(ply).parent / "config.json")[1] for ply in re.findall(r"'([^']*\.ply)'", loss)]


def _distilled(loss: str) -> str:
    """Return which models a loss distills: how many, or if they are of several kinds, which the others are."""
    members = _members(loss)
    first, *others = (candidate(dataclasses.replace(member, random_background="off")) for member in members)
    kinds = [other.removeprefix(f"{first} + ").removeprefix(f"{LATER} + ") for other in others if other != first]
    steps = [f", {part}" for part in first.split(" + ") if part in _STEPS.values()]
    return f"distilled with {', '.join(kinds)}" if kinds else "".join([DISTILLED[len(members)], *steps])


def measured(run: Path, perceptual: LPIPS | None = None) -> Row:
    """Return the row of a finished training, with the perceptual metric if it has not been measured."""
    model, scene = load_run_model(run, trust=["benchmarks.needles", "benchmarks.limited"])
    options, config = read_run_settings(run / "config.json")
    results = read_json(run / "results.json")
    name = Path(options.path).name
    row: Row = {"scene": _scene(options), "candidate": candidate(config, options), "seed": config.seed}
    compared = row["candidate"].removesuffix(f", {LATER}").removesuffix(RELATIVE) in _REFERENCES
    if (name in HELD_OUT or name.endswith("-many")) and not compared:
        row["held-out"] = fmean(quality(model, view) for view in held_out_views(options, config.seed))
    test, metric = results["mean"]["test"], results.get("perceptual_metric")
    if metric is None and perceptual is not None:
        shown = [
            (on_white(model.test_rendering(v).image.clamp(0, 1), v.mask), on_white(v.image, v.mask)) for v in scene.test
        ]
        test["lpips"], metric = fmean(perceptual(*pair) for pair in shown), perceptual.name
    if (row["scene"], row["candidate"]) == (from_dense(name), LATER):  # of the study of failures
        row["expected"] = [round(of.psnr, 3) for of in map(ErrorMaps(model, scene.train), unseen_views(scene))]
    row |= {"test": {x: test[x] for x in _FIGURES if x in test}, "gaussians": results["gaussians"],
            "seconds": results["processor_seconds"], "lpips": metric,
            "cpu": results["machine"]["cpu"]}  # fmt: skip
    print(scene.name, row["candidate"], row["seed"], row.get("held-out"), row["test"], flush=True)
    return row


def choosing(rows: Sequence[Row]) -> str:
    """Return the table of the candidates: held-out PSNR of seed 0 by scene, and their mean over the scenes of all."""
    of: dict[str, dict[str, Row]] = defaultdict(dict)
    for row in rows:
        if row["seed"] == 0 and "held-out" in row and not _is_second(row["candidate"]):
            of[row["candidate"]][row["scene"]] = row
    shared = [scene for scene in SCENES if sum(scene in found for found in of.values()) == len(of)]
    lines = []
    for name, found in of.items():
        line = {"candidate": name} | {scene: f"{row['held-out']:.2f}" for scene, row in found.items()}
        line["mean"] = f"{fmean(found[s]['held-out'] for s in shared):.2f}" if shared else "-"
        lines.append(line)
    columns = ["candidate", *(s for s in SCENES if sum(s in found for found in of.values()) > 1), "mean"]
    return f"Held-out PSNR in dB, seed 0; mean over {', '.join(shared)}\n\n" + markdown_table(
        [dict.fromkeys(columns, "-") | line for line in lines], columns
    )


def second(rows: Sequence[Row], seeds: Sequence[int] = (0,)) -> str:
    """Return the table of the second choice: gains at held-out views over the mean of the chosen one's seeds."""
    lines = []
    every = dict.fromkeys((*_SECOND, *(row["candidate"] for row in rows if _is_second(row["candidate"]))))
    for name in (x for x in every if not x.startswith(f"{LATER} + ")):  # which is of the choices after it
        line, gains = {"candidate": name}, list[float]()
        for scene in HELD_OUT:
            own, found = (
                {seed: row["held-out"] for seed, row in rows_of(rows, scene, x).items() if "held-out" in row}
                for x in (CHOSEN, name)
            )
            if own and all(seed in found for seed in seeds):
                reference = fmean(x for seed, x in own.items() if seed < SEEDS)
                gains.append(fmean(found[seed] for seed in seeds) - reference)
                line[scene] = f"{gains[-1]:+.2f}"
        if gains:
            lines.append(line | {"mean": f"{fmean(gains):+.2f}", "scenes": str(len(gains))})
    columns = ["candidate", *(s for s in HELD_OUT if any(s in line for line in lines)), "mean", "scenes"]
    return markdown_table([dict.fromkeys(columns, "-") | line for line in lines], columns)


def judging(rows: Sequence[Row], references: Path = REFERENCES, *, chosen: str = CHOSEN) -> str:
    """Return the table of a setting against plain 3DGS and dropout alone at the test views, and the goals."""
    lines, perceptual, counts, spreads = [], list[float](), list[float](), list[float]()
    gains = differences(rows, references, chosen=chosen)
    for scene, pairs in gains.items():
        known = references_of(rows, references, scene) | {name: rows_of(rows, scene, name) for name in (CHOSEN, chosen)}
        compared = {
            name: {seed: row for seed, row in known[name].items() if seed < SEEDS}
            for name in dict.fromkeys(("plain", "dropout", CHOSEN, chosen))
        }
        dropout, own = compared["dropout"], compared[chosen]
        perceptual.append(_mean(own, "test lpips") - _mean(dropout, "test lpips"))
        counts.append(_mean(own, "gaussians") / _mean(dropout, "gaussians"))
        spreads.append(mean_std(value(row, "test psnr") for row in own.values())[1])
        line = {"scene": scene, "seeds": str(len(own))}
        for name, of in compared.items():
            line[f"{name} PSNR"] = format_mean_std((value(row, "test psnr") for row in of.values()), decimals=2)
        line["gain over plain, by seed"] = ", ".join(f"{x:+.2f}" for x in pairs)
        line["LPIPS"] = " / ".join(f"{_mean(of, 'test lpips'):.3f}".lstrip("0") for of in compared.values())
        scores = (1e3 * _mean(of, "test ca_exact_half") for of in compared.values())
        line["exact CA at 1/2, 1e-3"] = " / ".join(f"{score:.2f}" for score in scores)
        line["Gaussians over dropout's"] = f"{counts[-1]:.2f}"
        lines.append(line)
    if not lines:
        return f"Nothing of {chosen!r} was measured."
    every = [gain for pairs in gains.values() for gain in pairs]
    goals = [
        f"mean gain over plain: {fmean(every):+.2f} dB over {len(every)} pairs of {len(lines)} scenes",
        f"worst pair: {min(every):+.2f} dB",
        f"standard deviation of seeds, mean over scenes: {mean_std(spreads)[0]:.2f} dB",
        f"LPIPS against dropout alone, mean over scenes: {fmean(perceptual):+.4f}",
        f"Gaussians against dropout alone, mean over scenes: {fmean(counts):.2f}",
    ]
    if chosen != CHOSEN:
        goals.append(_against_first(rows, chosen, list(gains)))
    return "\n".join([markdown_table(lines, list(lines[0])), "", *(f"- {goal}" for goal in goals)])


def _against_first(rows: Sequence[Row], chosen: str, scenes: Sequence[str]) -> str:
    """Return how a setting compares with the first choice, trained with the same seeds, in the mean over scenes."""
    found = dict[str, tuple[float, float, float]]()
    for scene in scenes:
        own, first = rows_of(rows, scene, chosen), rows_of(rows, scene, CHOSEN)
        pairs = [(own[seed], first[seed]) for seed in sorted(own.keys() & first.keys())]
        ratios = (fmean(a[name] / b[name] for a, b in pairs) for name in ("seconds", "gaussians"))
        found[scene] = fmean(value(a, "test psnr") - value(b, "test psnr") for a, b in pairs), *ratios
    gain, seconds, gaussians = (fmean(of) for of in zip(*found.values(), strict=True))
    measured_points = fmean(of[0] for scene, of in found.items() if scene != "lego")
    return (
        f"against {CHOSEN}, same seeds, mean over scenes: PSNR {gain:+.2f} dB (without lego {measured_points:+.2f}), "
        f"processor time {seconds:.2f}, Gaussians {gaussians:.2f}"
    )


def differences(rows: Sequence[Row], references: Path = REFERENCES, *, chosen: str = CHOSEN) -> dict[str, list[float]]:
    """Return by how much a setting is ahead of the plain training of the same seed, test PSNR, by scene."""
    found: dict[str, list[float]] = {}
    for scene in SCENES:
        own, plain = rows_of(rows, scene, chosen), references_of(rows, references, scene)["plain"]
        if shared := sorted(own.keys() & plain.keys() & set(range(SEEDS))):
            found[scene] = [value(own[seed], "test psnr") - value(plain[seed], "test psnr") for seed in shared]
    return found


def binocular(rows: Sequence[Row], references: Path = REFERENCES) -> str:
    """Return the table of both chosen ones against Binocular3DGS with dropout, over the seeds that all have."""
    lines, ahead = [], dict[str, list[float]]()
    for scene in SCENES:
        every = {BINOCULAR: references_of(rows, references, scene)[BINOCULAR]}
        every |= {name: rows_of(rows, scene, name) for name in (CHOSEN, LATER)}
        if not (shared := sorted(set.intersection(*(set(of) for of in every.values())))):
            continue
        figures = {name: [value(of[seed], "test psnr") for seed in shared] for name, of in every.items()}
        line = {"scene": scene, "seeds": str(len(shared))}
        for name, found in figures.items():
            line[f"{name} PSNR"] = format_mean_std(found, decimals=2)
        lines.append(line)
        for name in (CHOSEN, LATER):
            ahead.setdefault(name, []).append(fmean(figures[name]) - fmean(figures[BINOCULAR]))
    if not lines:
        return f"Nothing of {BINOCULAR!r} was measured."
    won = [
        f"{name}: ahead on {sum(x > 0 for x in of)} of {len(of)} scenes, by {fmean(of):+.2f} dB in the mean"
        for name, of in ahead.items()
    ]
    return "\n".join([markdown_table(lines, list(lines[0])), "", *(f"- {line}" for line in won)])


def starts(rows: Sequence[Row]) -> str:
    """Return the table of trainings from other points: both chosen ones, PSNR of held-out and of test views, seed 0."""
    lines = []
    for start in ("random points", FEW_AND_RANDOM):
        for scene in SCENES:
            own, later = (rows_of(rows, f"{scene}, {start}", name).get(0) for name in (CHOSEN, LATER))
            if own and later:
                before, after = ((row["held-out"], value(row, "test psnr")) for row in (own, later))
                lines.append({
                    "points": start, "scene": scene, CHOSEN: "{:.2f} / {:.2f}".format(*before),
                    LATER: "{:.2f} / {:.2f}".format(*after),
                    "difference": f"{after[0] - before[0]:+.2f} / {after[1] - before[1]:+.2f}",
                })  # fmt: skip
    return markdown_table(lines, ["points", "scene", CHOSEN, LATER, "difference"])


def controls(rows: Sequence[Row], references: Path = REFERENCES) -> str:
    """Return the table of the later beginning without dropout, and without decay and guard: test PSNR, seed 0."""
    lines = []
    for scene in SCENES:
        kept = references_of(rows, references, scene)
        every = {name: kept[name] for name in ("plain", "dropout")} | {CHOSEN: rows_of(rows, scene, CHOSEN)}
        later = {name: rows_of(rows, scene, f"{name}, {LATER}") for name in ("plain", "dropout")}
        later[CHOSEN] = rows_of(rows, scene, LATER)
        pairs = {name: (of.get(0), later[name].get(0)) for name, of in every.items()}
        if all(before and after for before, after in pairs.values()):
            line = {"scene": scene}
            for name, pair in pairs.items():
                before, after = (value(row, "test psnr") for row in pair if row)
                line[name] = f"{before:.2f}"
                line[f"{name}, {LATER}"] = f"{after:.2f} ({after - before:+.2f})"
            lines.append(line)
    return markdown_table(lines, [*lines[0]]) if lines else "No control was trained."


def _scene(options: SceneOptions) -> str:
    """Return the name of a scene, with its points where these are others than the scene's own."""
    if options.init is not None:  # one of the models that are distilled
        options, _ = read_run_settings(Path(options.init).with_name("config.json"))
    start = STARTS.get(options.points)
    return Path(options.path).name + (f", {start}" if start else "")


def _is_second(candidate: str) -> bool:
    names = set(candidate.split(" + "))
    return (
        names <= _SECOND.keys()
        or "distilled" in candidate
        or bool(names & {ONE_EXPOSURE, MEAN_BACKGROUND, ELSEWHERE, PLANES, *_STEPS.values()})
    )


def rows_of(rows: Sequence[Row], scene: str, name: str) -> dict[int, Row]:
    """Return the rows of a scene and a candidate by seed."""
    return {row["seed"]: row for row in rows if (row["scene"], row["candidate"]) == (scene, name)}


def references_of(rows: Sequence[Row], references: Path, scene: str) -> dict[str, dict[int, Row]]:
    """Return what the chosen one is compared with, by name and seed: the grid's rows, and own ones of further seeds."""
    kept = Rows(references / f"{scene}.json")
    return {
        name: rows_of(rows, scene, name) | kept.of({"recipe": "3dgs", "iterations": 3_000, **own})
        for name, own in _REFERENCES.items()
    }


def _mean(of: dict[int, Row], figure: str) -> float:
    """Return the mean over the seeds for which it was measured."""
    return fmean([x for row in of.values() if math.isfinite(x := value(row, figure))] or [math.nan])


if __name__ == "__main__":
    tyro.cli(main)
