"""What a training makes of photographs with an alpha channel, under the protocol of benchmarks/setting.md.

    python -m benchmarks.alpha train ../shared/data/lego --out alpha.json    # choosing; with --whole judging
    python -m benchmarks.alpha table alpha.json

A row is a training of the recipe from the dense start, without two of the photographs, at which its PSNR chooses; or
of all photographs, with the PSNR of the test views.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal

import torch
import tyro

from benchmarks.guard import quality
from benchmarks.paper.scenes import SCENES
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.tables import format_mean_std, markdown_table
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.dense import dense_start
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.scene import PointCloud, Scene
from reference_trainer.training.recipes import with_recipe
from reference_trainer.training.trainer import Trainer

__all__ = ["CANDIDATES", "main", "table", "without"]

CANDIDATES: dict[str, dict[str, Any]] = {
    "recipe": {},
    "alpha": {"loss": "photometric + alpha(optional=True)"},
    "alpha, a tenth": {"loss": "photometric + alpha(0.1, optional=True)"},
    "random background": {"random_background": True},
}
"""What is added to the recipe; first nothing."""
FOLDS = 4
"""So often two photographs are left out, other ones each time."""
SEEDS = 3
"""Of the judgement."""
Row = dict[str, Any]
"""``candidate``, ``fold`` (None: all photographs train), ``seed``, ``psnr`` and ``gaussians``."""


def without(scene: Scene, fold: int) -> Scene:
    """Return a scene whose test views are two of its training views, with a dense start from the others.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> left = without(synthetic_scene(width=64, height=48, train_views=8), 1)
        >>> [view.name for view in left.test]
        ['train_1', 'train_5']
    """
    half = len(scene.train) // 2
    out = {fold, fold + half}
    train = tuple(view for i, view in enumerate(scene.train) if i not in out)
    nothing = PointCloud(torch.empty(0, 3), torch.empty(0, 3), "none", frozenset())
    points, _ = dense_start(train, nothing)
    return replace(scene, train=train, test=tuple(scene.train[i] for i in sorted(out)), points=points)


def main(
    what: Annotated[Literal["train", "table"], tyro.conf.Positional],
    path: Annotated[Path, tyro.conf.Positional],
    whole: bool = False,
    candidates: tuple[str, ...] = tuple(CANDIDATES),
    out: Path = Path("runs/alpha.json"),
) -> None:
    """Train, or print the tables.

    Args:
        what: "train" or "table".
        path: the folder of lego, or a file of rows.
        whole: train on all photographs.
        candidates: those to train.
        out: the file of rows, which is continued.
    """
    torch.set_num_threads(1)
    if what == "table":
        print(table(json.loads(path.read_text("utf-8"))))
        return
    scene = load_scene(replace(SCENES["lego"].options, path=str(path), points="dense"))
    for number in range(SEEDS if whole else FOLDS):
        trained_on = scene if whole else without(scene, number)
        for name in candidates:
            row: Row = {"candidate": name, "fold": None if whole else number, "seed": number}
            known = json.loads(out.read_text("utf-8")) if out.exists() else []
            if any(row.items() <= other.items() for other in known):
                continue
            trainer = Trainer(trained_on, with_recipe("sparse", seed=number, **CANDIDATES[name]))
            trainer.train()
            model = model_of(trainer)
            row |= {"psnr": fmean(quality(model, view) for view in trained_on.test), "gaussians": len(model.gaussians)}
            print(row, flush=True)
            write_json(out, [*known, row])


def table(rows: Sequence[Row]) -> str:
    """Return PSNR and gain over the recipe, without two photographs at these and with all at the test views."""
    lines = []
    for name in CANDIDATES:
        line = {"candidate": name}
        for title, whole in (("held-out", False), ("test views", True)):
            own, recipe = (
                {row["seed"]: row for row in rows if row["candidate"] == x and (row["fold"] is None) == whole}
                for x in (name, "recipe")
            )
            line |= dict.fromkeys((title, f"{title}: gain", f"{title}: Gaussians"), "-")
            if own:
                gains = ", ".join(f"{row['psnr'] - recipe[seed]['psnr']:+.2f}" for seed, row in own.items())
                line[title] = format_mean_std((row["psnr"] for row in own.values()), decimals=2)
                line[f"{title}: gain"] = gains if name != "recipe" else ""
                line[f"{title}: Gaussians"] = f"{fmean(row['gaussians'] for row in own.values()):,.0f}"
        lines.append(line)
    return markdown_table(lines, [*lines[0]])


if __name__ == "__main__":
    tyro.cli(main)
