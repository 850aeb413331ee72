"""The report page: the `Findings` of every run and the files of its folder as one HTML file."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import shlex
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch

import ca_reg
from ca_reg.monitor import read_dynamics
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE, ERROR_PICTURE_RANGE
from reference_trainer.evaluation.pictures import heat_map, logs_exact
from reference_trainer.evaluation.shares import PER_WEIGHT_SCALE
from reference_trainer.evaluation.tables import evaluation_table, markdown_table
from reference_trainer.files import write_text
from reference_trainer.report.findings import Findings, find, pictures_of
from reference_trainer.report.packing import image_uri
from reference_trainer.report.verdict import (
    FEWEST_SEEDS,
    Rows,
    differences,
    natural_order,
    run_colors,
    score_columns,
    unique_names,
    verdict,
)
from reference_trainer.runs.folder import (
    CONFIG,
    PLY,
    RESULTS,
    check_run,
    read_results,
    read_run_settings,
    report_file,
    runs_of,
)
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.poses import left_out
from reference_trainer.scenes.scene import Scene, View, Viewpoint
from reference_trainer.scenes.virtual_cameras import interpolate_cameras
from reference_trainer.training.config import TrainConfig

__all__ = ["compare_two", "labels", "view_name", "write_report"]

_log = logging.getLogger(__name__)

VIEWS = 8
"""Of each split, unless another number is asked for."""
EACH = 3
"""Views that nobody took, at most, between the training cameras, and as many beyond them."""


@dataclass(frozen=True)
class _Run:
    """A run as its folder holds it, and how the page shows it."""

    label: str
    folder: Path
    path: str  # below the folder common to all runs
    whole: bool  # whether it stands for all seeds of its strategy
    options: SceneOptions
    config: TrainConfig
    results: dict[str, Any] | None  # None before the end of the training
    color: str


def write_report(
    runs: Sequence[Path],
    out: Path | None = None,
    *,
    views: int = VIEWS,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> Path:
    """Write a page about runs on one scene that opens without a server or a network.

    It begins with a verdict and its evidence; docs/report.md says what else it shows. Runs come in the order baseline,
    dropout, noise, both, under natural names. The heat is the share of the exact score at drop rate 1/2 per blend
    weight, over the views of the page, on one logarithmic scale for all runs around the mean of the first run that has
    one. What a run lacks is left out, and the page says so.

    Args:
        runs: their folders, finished or not; the folder of a comparison stands for the first seed of each strategy, and
            its scores are those of all seeds.
        out: the file; by default and in the result that of `report_file`.
        views: how many views of each split are shown and measured, evenly spaced.
        device: where to render.
        trust: as for `load_run`.

    Raises:
        ValueError: if there is no run, one is given twice, their scenes differ, a file is damaged, ``out`` is a folder
            or somebody else's file, or a run names code that is not trusted.
        FileNotFoundError: if a folder holds no run.
    """
    if views < 1:
        raise ValueError(f"expected at least 1 view of each split, got {views}.")
    folders, runs = runs, [run for folder in runs for run in runs_of(folder) or [folder]]
    paths = dict(zip(runs, labels(runs), strict=True))
    file = report_file(folders, out)
    for folder in runs:
        check_run(folder)
    shown, found = _read(paths, whole=set(runs) - set(folders)), list[Findings]()
    for run in shown:
        _log.info("[%d/%d] %s", len(found) + 1, len(runs), run.folder)
        found.append(find(run.folder, run.label, views=views, device=device, trust=trust))
        if not _of_one_place(found[0].scene, found[-1].scene):
            raise ValueError(
                f"a report is about one scene, whose models turn together, but {shown[0].folder} was trained on "
                f"{found[0].scene.name} and {run.folder} on {found[-1].scene.name}, or with other cameras: write a "
                "report for each."
            )
    data = _data(shown, found)
    # The page names the command that makes it again, without what is usual.
    command = ["ca-reg", "report", *map(str, folders)]
    command += ["--views", str(views)] * (views != VIEWS) + ["--trust", *sorted(trust)] * bool(trust)
    command += ["--out", str(out)] * (out is not None)
    data["made"] = f"{shlex.join(command)} · ca_reg {ca_reg.__version__} · {datetime.now():%Y-%m-%d %H:%M}"
    page = Template(_part("page.html")).substitute(
        title=escape(f"{found[0].scene.name}: {', '.join(run.label for run in shown)}", quote=False),
        style=_part("page.css"),
        data=json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c"),  # nothing ends the script
        script=_part("models.js") + _part("curves.js") + _part("page.js"),
    )
    write_text(file, page)
    _log.info("The report is %s (%.1f MB): open it in a browser", file, file.stat().st_size / 1e6)
    return file


def compare_two(first: Path, second: Path) -> tuple[list[dict[str, object]], list[str]]:
    """Return the rows of `differences` between two trainings on one scene, and notes on what they rest on.

    Each is the folder of a run, or that of its seeds.

    Raises:
        FileNotFoundError: if a folder holds no run.
        ValueError: if one has not been trained to its end, its seeds differ in more than the seed, or the two were not
            measured at the same views of one scene.
    """
    both, viewed, configs = [], [], {}
    for folder in (first, second):
        seeds = [] if (folder / CONFIG).is_file() else sorted(path.parent for path in folder.glob(f"seed_*/{CONFIG}"))
        if not seeds:
            check_run(folder)
        runs = [run for run in seeds or [folder] if (run / RESULTS).exists()]
        if not runs:
            raise ValueError(f"{folder} has not been trained to its end: there are no scores yet.")
        settings = [read_run_settings(run / CONFIG) for run in runs]
        if len({(scene, dataclasses.replace(config, seed=0)) for scene, config in settings}) > 1:
            raise ValueError(f"the runs of {folder} differ in more than the seed: give one of them.")
        configs[str(folder)] = settings[0]
        both.append([read_results(run) for run in runs])
        seen = [{(of["scene"], view["split"], view["name"]) for view in of["views"]} for of in both[-1]]
        if any(each != seen[0] for each in seen):
            raise ValueError(f"the runs of {folder} were not measured at the same views: give one of them.")
        viewed.append(seen[0])
    if len(configs) < 2:
        raise ValueError(f"expected two different runs, got {first} twice.")
    # A split whose views differ is left out as a whole: a mean over other views is another quantity. Cameras between
    # and around the training views have numbers alone, and stand elsewhere if those differ.
    other = {split for _, split, _ in viewed[0] ^ viewed[1]}
    other |= {split for _, split, _ in viewed[0] if split != "test"} if "train" in other else set()
    shared = {split for _, split, _ in viewed[0] & viewed[1]} - other
    if not shared:
        raise ValueError(f"{first} and {second} were not measured at the same views of one scene.")
    names = unique_names([config for _, config in configs.values()], list(configs))
    rows = [
        Rows(name, False, [run | {"mean": {split: run["mean"][split] for split in shared}} for run in runs])
        for name, runs in zip(names, both, strict=True)
    ]
    counts = [len(of.results) for of in rows]
    rule = f"too few to tell anything apart: it takes {FEWEST_SEEDS} of each"
    if min(counts) >= FEWEST_SEEDS:
        rule = "told apart is what differs by more than two standard errors of the difference, which ± stands for"
    notes = [f"Seeds: {counts[0]} and {counts[1]}; {rule}."]
    notes += [f"Not compared, because the views differ: {', '.join(sorted(other))}."] * bool(other)
    differing = _settings(dict(zip(names, configs.values(), strict=True)))[1]
    paths = list(dict.fromkeys(scene.path for scene, _ in configs.values()))
    notes += [f"Trained on {' and '.join(paths)}, which should be copies of one scene."] * (len(paths) > 1)
    notes += [f"Next to the regularizers, the runs differ in {', '.join(differing)}."] * bool(differing)
    return differences(*rows), notes


def _of_one_place(first: Scene, second: Scene) -> bool:
    """Whether two scenes have one name and, at the views that both train on, the same cameras."""
    poses = [{view.name: view.camera.world_to_camera for view in scene.train} for scene in (first, second)]
    shared = poses[0].keys() & poses[1].keys()
    return first.name == second.name and all(poses[0][name].allclose(poses[1][name], atol=1e-4) for name in shared)


def labels(runs: Sequence[Path]) -> list[str]:
    """Return a label for each run: its path below the folder common to all, the name of a single one.

    Raises ValueError if there is no run, or one is given twice.

    Example:
        >>> labels([Path("runs/fern/baseline/seed_0"), Path("runs/fern/dropout/seed_0")])
        ['baseline/seed_0', 'dropout/seed_0']
    """
    folders = [run.resolve() for run in runs]
    if not runs or len(set(folders)) < len(runs):
        raise ValueError(f"expected the folders of at least 1 run, each once, got {[str(run) for run in runs]}.")
    common = folders[0].parent if len(runs) == 1 else Path(os.path.commonpath(folders))
    return [folder.relative_to(common).as_posix() for folder in folders]


def _part(name: str) -> str:
    """Return the text of one of the page's template files."""
    return (files(__package__) / name).read_text("utf-8")


def _read(paths: Mapping[Path, str], whole: Collection[Path]) -> list[_Run]:
    """Return the runs of a page, whose folders these are, in its order; those in ``whole`` stand for all seeds."""
    settings = {run: read_run_settings(run / CONFIG) for run in paths}
    runs = sorted(paths, key=lambda run: natural_order(settings[run][1]))
    configs = [settings[run][1] for run in runs]
    names, colors = unique_names(configs, [paths[run] for run in runs]), run_colors(configs)
    results = [read_results(run) if (run / RESULTS).exists() else None for run in runs]
    return [
        _Run(name, run, paths[run], run in whole, settings[run][0], config, of, color)
        for name, run, config, of, color in zip(names, runs, configs, results, colors, strict=True)
    ]


def _data(runs: Sequence[_Run], found: Sequence[Findings]) -> dict[str, Any]:
    """Return all that the page shows, as plain data."""
    strategies = _strategies(runs)
    table, differing = _settings({run.label: (run.options, run.config) for run in runs})
    said, evidence = verdict(strategies, differing)
    notes = [note for scene in dict.fromkeys(run.options.path for run in runs) for note in left_out(Path(scene))]
    notes += [note for each in found for note in each.notes]
    notes += [f"{run.label}: no scores, it has not been trained to its end." for run in runs if run.results is None]
    curves, missing = _curves(runs)
    logged = {curve["run"] for curve in curves}
    middle = next((each.heat.mean for each in found if each.heat is not None), 1.0)
    low, high = (end * middle for end in PER_WEIGHT_SCALE)
    attribution = [row for each in found if (row := each.attribution())]
    return {
        "about": [str(found[0].scene), *map(_trained, found)],
        "notes": notes + missing,
        "scene": found[0].scene.name,
        "verdict": said,
        "evidence": evidence + [line for run, each in zip(runs, found, strict=True) for line in _hanging(each, run)],
        "strategies": [{"name": of.name, "seeds": len(of.results), "color": of.color} for of in strategies],
        "scores": score_columns(strategies),
        "settings": table,
        "curves": curves,
        "exact": all(logs_exact(run.folder) for run in runs if run.label in logged),
        "perView": {run.label: evaluation_table(_renamed(run.results)) for run in runs if run.results is not None},
        "attribution": markdown_table(attribution, list(attribution[0])) if attribution else "",
        "legend": image_uri(heat_map(torch.linspace(0, 1, 256)[None].expand(8, -1), 1.0)),
        "ends": {"heat": [f"{low:.2g}", f"{high:.2g}"], "error": ERROR_PICTURE_RANGE, "ca": CA_PICTURE_RANGE},
        "views": _views(found),
        "unseen": _unseen(found),
        "veils": [
            {"caption": f"{each.label}: {what}", "src": uri} for each in found for what, uri in each.veils.items()
        ],
        "flight": _flight(found[0]),
        "runs": [each.packed(low, high) | {"color": run.color} for run, each in zip(runs, found, strict=True)],
    }


def _renamed(results: dict[str, Any]) -> dict[str, Any]:
    """Return results whose views are named for people: no "test test_0"."""
    views = [view | {"name": view["name"].removeprefix(f"{view['split']}_")} for view in results["views"]]
    return results | {"views": views}


def _trained(each: Findings) -> str:
    """Return a line about what a run was trained with."""
    steps, regularizer = f"{each.model.step:,} steps", each.model.regularizer or "no regularizer"
    return f"{each.label}: {steps} with {regularizer}; {len(each.model.gaussians):,} Gaussians"


def _strategies(runs: Sequence[_Run]) -> list[Rows]:
    """Return the rows of every strategy: runs that differ in nothing but the seed are one, as in a comparison."""
    found: dict[object, tuple[list[_Run], dict[int, dict[str, Any]]]] = {}
    for run in runs:
        of = {} if run.results is None else {run.config.seed: run.results}
        if run.whole:
            for other in map(read_results, sorted(path.parent for path in run.folder.parent.glob(f"seed_*/{RESULTS}"))):
                of.setdefault(other["config"]["seed"], other)
        key: object = run.label if run.whole else (run.options, dataclasses.replace(run.config, seed=0))
        # The same settings and seed again, perhaps from another machine: kept apart, or one would hide the other.
        if key in found and run.config.seed in found[key][1]:
            key = run.label
        if of:
            same, seeds = found.setdefault(key, ([], {}))
            same.append(run)
            seeds |= of
    paths = [", ".join(run.path for run in same) for same, _ in found.values()]
    names = unique_names([same[0].config for same, _ in found.values()], paths)
    return [
        Rows(
            name if len(same) > 1 else same[0].label,
            not natural_order(same[0].config)[0],
            list(seeds.values()),
            same[0].color,
        )
        for name, (same, seeds) in zip(names, found.values(), strict=True)
    ]


def _settings(configs: dict[str, tuple[SceneOptions, TrainConfig]]) -> tuple[str, list[str]]:
    """Return a table of the settings that differ between runs or from the defaults, and those a verdict must name."""
    flat = {label: {k: x for of in both for k, x in dataclasses.asdict(of).items()} for label, both in configs.items()}
    rows: list[dict[str, object]] = []
    for name, usual in (dataclasses.asdict(SceneOptions()) | dataclasses.asdict(TrainConfig())).items():
        values = {label: config[name] for label, config in flat.items()}
        if name != "path" and set(values.values()) != {usual}:
            rows.append({"setting": name, **{label: str(value) for label, value in values.items()}})
    differing = [str(row["setting"]) for row in rows if len({row[label] for label in configs}) > 1]
    named = {"seed", "dropout", "noise", "regularizer", "analytic", "loss", "density"}  # in the names of the runs
    return markdown_table(rows, ["setting", *configs]) if rows else "", [x for x in differing if x not in named]


def _curves(runs: Sequence[_Run]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return CA in 1e-3 and PSNR against the step of every run and group of views, and notes on what is missing."""
    curves, missing = list[dict[str, Any]](), []
    for run in runs:
        gap = f"{run.label}: no CA and PSNR against the step"
        try:
            columns = read_dynamics(run.folder)
        except FileNotFoundError:
            missing.append(f"{gap}, because nothing was measured while it trained.")
        except ValueError as error:
            missing.append(f"{gap}: {error}")
        else:
            for group in (key[3:] for key in columns if key.startswith("ca/")):
                curve: dict[str, Any] = {"run": run.label, "group": group, "step": columns["step"].tolist()}
                for name, unit in (("ca", 1e-3), ("psnr", 1.0)):
                    values = columns.get(f"{name}/{group}", np.full(len(columns["step"]), np.nan)) / unit
                    # None, as JSON has no nan.
                    curve[name] = [round(x, 4) if np.isfinite(x) else None for x in values.tolist()]
                curves.append(curve)
    return curves, missing


def view_name(split: str, name: str) -> str:
    """Return what people call a view.

    Example:
        >>> view_name("test", "test_0"), view_name("train", "IMG_4026")
        ('test 0', 'train IMG_4026')
    """
    return f"{split} {name.removeprefix(split + '_')}"


def _flight(each: Findings) -> list[list[float]]:
    """Return the poses of a flight along the training views of a page, empty with a single one."""
    cameras = [view.camera for view in each.views["train"]]
    frames = interpolate_cameras(cameras, 30 * (len(cameras) - 1) + 1) if len(cameras) > 1 else []
    return [[round(x, 5) for x in camera.world_to_camera[:3].flatten().tolist()] for camera in frames]


def _views(found: Sequence[Findings]) -> list[dict[str, Any]]:
    """Return every view with its camera, its photograph, and the pictures of every run that was rendered there."""
    views: dict[tuple[str, str, str], dict[str, Any]] = {}
    for number, each in enumerate(found):
        pictures = iter(each.pictures)
        for split, group in each.views.items():
            for view in group:
                entry = _entry(view, view_name(split, view.name), len(found))
                # By pose as well: views between and around the cameras only have numbers, and another split moves them.
                entry = views.setdefault((split, view.name, str(entry["pose"])), entry)
                entry["pictures"][number] = next(pictures)
    return list(views.values())


def _entry(view: Viewpoint, name: str, runs: int) -> dict[str, Any]:
    """Return a view with its camera, its photograph, and room for the pictures of every run."""
    camera = view.camera
    return {
        "name": name,
        "photograph": image_uri(view.image) if isinstance(view, View) else "",
        "pose": camera.world_to_camera[:3].flatten().tolist(),
        "focal": [camera.fx, camera.fy],
        "center": [camera.cx, camera.cy],
        "size": [camera.width, camera.height],
        "pictures": [{}] * runs,
    }


def _unseen(found: Sequence[Findings]) -> list[dict[str, Any]]:
    """Return the views that nobody took with the lowest expected PSNR in any run, the worst first.

    Cameras between the same two, or beyond the same one, look alike: only the worst of them is kept.
    """
    least: dict[str, tuple[float, Viewpoint]] = {}
    for view, expected in (one for each in found for one in each.unseen):
        if expected.psnr < least.get(view.name, (math.inf,))[0]:
            least[view.name] = expected.psnr, view
    chosen, kinds = list[Viewpoint](), Counter[str]()
    for _, view in sorted(least.values(), key=lambda one: one[0]):
        kinds[kind := view.name.partition(" ")[0]] += 1
        chosen += [view] * (kinds[kind] <= EACH)
    entries = []
    for view in chosen:
        entries.append(_entry(view, view.name, len(found)))
        for number, each in enumerate(found):
            for other, expected in each.unseen:
                # By pose, as runs that were trained on different photographs may have
                # other cameras under the same name.
                if torch.equal(other.camera.world_to_camera, view.camera.world_to_camera):
                    entries[-1]["pictures"][number] = pictures_of(each.model, other, expected)
    return entries


def _hanging(each: Findings, run: _Run) -> list[str]:
    """Return lines on what hung where nobody took a photograph, what still hangs there, and how to remove it."""
    lines = [f"{each.label}: {line}" for line in each.removed]
    if each.hangs is None:
        return lines
    if not (run.folder / PLY).exists():
        return [*lines, f"{each.label}: {each.hangs} They can be removed once it has been trained to its end."]
    command = ["ca-reg", "clean", str(run.folder / PLY), "--scene", run.options.path, "--hanging"]
    for name, usual in dataclasses.asdict(SceneOptions()).items():
        if (x := getattr(run.options, name)) != usual and name not in ("path", "init"):  # a PLY is its own beginning
            flag = name.replace("_", "-")
            command += [f"--{flag}" if x else f"--no-{flag}"] if isinstance(x, bool) else [f"--{flag}", str(x)]
    return [*lines, f"{each.label}: {each.hangs} To remove them: {shlex.join(command)}"]
