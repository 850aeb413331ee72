"""Schemes against a reference, paired by seed, under the protocol of benchmarks/remedy.md.

    python -m benchmarks.remedy choose "dropout=0.2" "dropout=0.2; loss=photometric + co_adaptation" \
        --scenes synthetic fern --seeds 2

The first arm is the reference. An arm is a list of settings of the training, such as "dropout=0.2; iterations=3000".
``choose`` measures held-out views that are like training views, and never a test view; ``final`` the test views. What
is measured is kept: the same command continues, and further arms, scenes and seeds are added. ``table FILE`` prints
those of a file, against the first arm or ``--reference``: benchmarks/data/remedy.json and remedy_final.json have what
benchmarks/remedy.md shows.
"""

from __future__ import annotations

import ast
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from reference_trainer.cli import log_shown
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.tables import format_mean_std, markdown_table, mean_std
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import load_scene, synthetic_scene
from reference_trainer.scenes.exposure import like_training
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.studies.study import Record, Records, Study, run_study
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = ["SCENES", "arm", "held_out", "overview", "remedy_study"]

COMMON = {"iterations": 1_500, "opacity_reset_every": 0}
"""What all trainings share, if an arm does not say otherwise."""

SCENES = {
    "synthetic": SceneOptions(),
    "fern": SceneOptions("fern", images="images_16", points="sparse_3views_dense/0"),
    "lego": SceneOptions("lego", downscale=2.0, points="random"),
    "herz-jesu": SceneOptions("herz-jesu", images="images_2", split="split_near", points="sparse_3near/0"),
    "fountain": SceneOptions("fountain", images="images_2", split="split_near", points="sparse_3near/0"),
    "dtu-scan65": SceneOptions("dtu-scan65", points="sparse_3views_dense/0"),
    "dtu-scan24": SceneOptions("dtu-scan24", points="sparse_3views_dense/0"),
}
"""The scenes of the protocol, below the folder of the data; settings are chosen on the first three alone."""

CHOOSING = tuple(SCENES)[:3]
_Views = Literal["choose", "final"]
_Table = Literal["table"]


def main(
    views: Annotated[_Views | _Table, tyro.conf.Positional],
    arms: Annotated[tuple[str, ...], tyro.conf.Positional],
    scenes: tuple[str, ...] = CHOOSING,
    seeds: int = 3,
    data: str = "../shared/data",
    out: Path = Path("runs/remedy"),
    reference: str = "",
) -> None:
    """Train every arm on every scene with every seed, and compare each with the first arm.

    Args:
        views: what is measured: "choose" for held-out views that are like training views, "final" for the test views;
            "table" for what is in files.
        arms: settings of the training, such as "dropout=0.2; loss=photometric + co_adaptation(3.0)", or the files.
        scenes: of the protocol.
        seeds: number of seeds; of all scenes and arms the first comes first.
        data: folder of the scenes.
        out: folder for the JSON and the table.
        reference: arm that a table compares with, the first of the file by default.
    """
    if views == "table":
        print("\n".join(overview(json.loads(Path(file).read_text("utf-8"))["records"], reference) for file in arms))
        return
    with log_shown():
        run_study(remedy_study(views, arms, scenes=scenes, seeds=seeds, data=data), out)


def arm(text: str) -> dict[str, Any]:
    """Return the settings of an arm.

    Example:
        >>> arm("dropout=0.2; loss=photometric + co_adaptation(3.0, where='arc')")
        {'dropout': 0.2, 'loss': "photometric + co_adaptation(3.0, where='arc')"}
    """
    pairs = (part.split("=", 1) for part in text.split(";") if part.strip())
    return {name.strip(): _value(value.strip()) for name, value in pairs}


def _value(text: str) -> Any:
    """Return a number, or the text."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return text


def held_out(options: SceneOptions, seed: int) -> Scene:
    """Return a scene whose test views are held-out views that are like its training views, and no test views.

    They are the photographs that a split uses neither to train nor to test; in the built-in scene the views at a third
    of the way from each training view to the next. Where there are none, such as in lego, two of the training views are
    held out, others for every seed.
    """
    scene = load_scene(options, seed=seed)
    if options.path == "synthetic":
        return replace(scene, test=synthetic_scene(test_views=5, points=1).test[:-1])
    used = {view.name for view in (*scene.train, *scene.test)}
    everything = load_scene(replace(options, split="auto", test="none", one_exposure=False), trains=False).train
    if others := tuple(view for view in everything if view.name not in used):
        return replace(scene, test=like_training(others, scene.train))
    half = len(scene.train) // 2
    out = {seed % half, seed % half + half}
    split: dict[bool, list[View]] = {True: [], False: []}
    for i, view in enumerate(scene.train):
        split[i in out].append(view)
    return replace(scene, train=tuple(split[False]), test=tuple(split[True]))


def remedy_study(
    views: _Views, arms: Sequence[str], *, scenes: Sequence[str], seeds: int, data: str = "../shared/data"
) -> Study:
    """Declare the study.

    Raises:
        ValueError: if there are less than two arms, a scene is unknown, or settings are to be chosen on one that only
            judges them.
    """
    if len(arms) < 2:
        raise ValueError(f"expected a reference and at least one more arm, got {list(arms)}.")
    if unknown := set(scenes) - set(SCENES if views == "final" else CHOOSING):
        raise ValueError(f"{views} knows the scenes {', '.join(SCENES if views == 'final' else CHOOSING)}: {unknown}.")
    for text in arms:
        check(TrainConfig(**COMMON | arm(text)))
    found = {
        name: options if options.path == "synthetic" else replace(options, path=f"{data}/{options.path}")
        for name, options in SCENES.items()
    }
    cases = {
        f"{scene}, seed {seed}: {text}": {
            "views": views, "scene": scene, "options": vars(found[scene]), "seed": seed, "settings": text
        }
        for seed in range(seeds) for scene in scenes for text in arms
    }  # fmt: skip
    return Study(f"remedy_{views}", _measure, cases, _report)


def _measure(views: _Views, scene: str, options: dict[str, Any], seed: int, settings: str) -> Record:
    """Train, and measure every view."""
    chosen = SceneOptions(**options)
    loaded = held_out(chosen, seed) if views == "choose" else load_scene(chosen, seed=seed)
    trainer = Trainer(loaded, TrainConfig(**COMMON | arm(settings), seed=seed))
    trainer.train()
    model = model_of(trainer)
    with torch.no_grad():
        exact, opacities = model.exact_ca_score(drop_rate=0.5), model.gaussians.opacities
        quality = {v.name: psnr(model.test_rendering(v).image.clamp(0, 1), v.image) for v in loaded.test}
        scores = [exact(opacities, view).value for view in loaded.test]
    return {
        "scene": scene, "seed": seed, "arm": settings, "views": quality, "psnr": mean_std(quality.values())[0],
        "ca_exact": mean_std(scores)[0], "gaussians": len(trainer.gaussians),
        "processor_seconds": trainer.processor_seconds,
    }  # fmt: skip


def _report(records: Records) -> str:
    """Return a table per scene: every arm, and its difference to the first in every seed that has both."""
    parts = []
    for scene in dict.fromkeys(record["scene"] for record in records.values()):
        of: dict[str, dict[int, Record]] = {}
        for record in records.values():
            if record["scene"] == scene:
                of.setdefault(record["arm"], {})[record["seed"]] = record
        reference, rows = next(iter(of.values())), []
        for text, by_seed in of.items():
            both = [(x, reference[seed]) for seed, x in by_seed.items() if seed in reference]
            gains = [x["psnr"] - y["psnr"] for x, y in both]
            times = [x["processor_seconds"] / y["processor_seconds"] for x, y in both]
            means = {
                title: format_mean_std([x[name] for x in by_seed.values()], unit=unit)
                for name, (title, unit) in _COLUMNS.items()
            }
            rows.append(
                {"arm": f"`{text}`", "seeds": str(len(by_seed))} | means
                | {"difference": ", ".join(f"{gain:+.3f}" for gain in gains), "mean ± s. e.": _mean_and_error(gains)}
                | {"time": f"{mean_std(times)[0]:.2f}"}
            )  # fmt: skip
        parts += [f"**{scene}**", markdown_table(rows, list(rows[0])).rstrip()]
    return "\n\n".join(parts) + "\n"


def overview(records: Sequence[Record], reference: str = "") -> str:
    """Return one table: what every arm gains on each scene over one (the first), and its ratios to it, best first."""
    of = {(record["arm"], record["scene"], record["seed"]): record for record in records}
    scenes, reference = list(dict.fromkeys(record["scene"] for record in records)), reference or records[0]["arm"]
    rows = []
    for text in dict.fromkeys(record["arm"] for record in records if record["arm"] != reference):
        row, means = {"setting": f"`{text}`"}, []
        pairs = {scene: [(x, y) for (a, s, seed), x in of.items() if (a, s) == (text, scene)
                         and (y := of.get((reference, scene, seed)))] for scene in scenes}  # fmt: skip
        for scene, both in pairs.items():
            gains = [x["psnr"] - y["psnr"] for x, y in both]
            row[scene] = f"{_mean_and_error(gains)} ({len(gains)})" if gains else "-"
            means += [mean_std(gains)[0]] if gains else []
        row["mean"] = f"{mean_std(means)[0]:+.3f}" if len(means) == len(scenes) else "-"
        for name, title in (("ca_exact", "CA"), ("gaussians", "Gaussians"), ("processor_seconds", "time")):
            ratios = [mean_std(x[name] / y[name] for x, y in both)[0] for both in pairs.values() if both]
            row[title] = f"{mean_std(ratios)[0]:.2f}"
        rows.append((mean_std(means)[0], row))
    rows.sort(key=lambda each: (each[1]["mean"] != "-", each[0]), reverse=True)
    return markdown_table([row for _, row in rows], ["setting", *scenes, "mean", "CA", "Gaussians", "time"])


_COLUMNS = {
    "psnr": ("PSNR", 1.0),
    "ca_exact": ("exact CA x1e-3", 1e-3),
    "gaussians": ("Gaussians, k", 1e3),
    "processor_seconds": ("processor s", 1.0),
}


def _mean_and_error(differences: Sequence[float]) -> str:
    """Return the mean of paired differences and its standard error."""
    mean, std = mean_std(differences)
    return f"{mean:+.3f} ± {std / math.sqrt(len(differences)):.3f}" if len(differences) > 1 else f"{mean:+.3f}"


if __name__ == "__main__":
    tyro.cli(main)
