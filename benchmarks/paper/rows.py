"""What is kept of a training: one row in a small JSON file per scene, which can be committed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock

from benchmarks.paper.claims import Setting
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import with_recipe, with_steps

__all__ = ["Row", "Rows", "config_of", "label", "resolved", "value"]

Row = dict[str, Any]
"""``setting`` and ``seed``, ``commit``, ``version``, ``cpu``, ``device`` unless that is it, the kind of ``lpips``, and
figures: ``test`` and ``train`` from `evaluate`, as means over views, ``gaussians``, ``seconds`` of processor time, and
``path`` with ``course`` (CA of test views and the rest at every sixth of the steps), ``renders`` and ``depth`` where
measured."""


def resolved(setting: Setting, recipe: str, iterations: int) -> dict[str, Any]:
    """Return a setting with recipe and iterations, its steps scaled to these: what identifies a training.

    Example:
        >>> resolved({"regularizer": "d2gs(ramp(0.05, 0.3, 0, 10_000))"}, "3dgs", 3_000)
        {'recipe': '3dgs', 'iterations': 3000, 'regularizer': 'd2gs(ramp(0.05, 0.3, 0, 3000))'}
    """
    scaled = {k: with_steps(x, iterations / 10_000) if isinstance(x, str) else x for k, x in setting.items()}
    return {"recipe": recipe, "iterations": iterations} | scaled


def config_of(setting: Setting, seed: int) -> TrainConfig:
    """Return the training settings of a resolved setting."""
    changes = {name: x for name, x in setting.items() if name not in ("recipe", "views")}
    return with_recipe(setting["recipe"], seed=seed, **changes)


def label(setting: Setting, hidden: Mapping[str, Any] | None = None) -> str:
    """Return a setting in words, without entries that equal those of ``hidden``.

    Example:
        >>> label({"recipe": "3dgs", "regularizer": "density", "views": 6}, {"recipe": "3dgs"})
        'density, views=6'
    """
    shown = {k: x for k, x in setting.items() if k not in (hidden or {}) or x != (hidden or {})[k]}
    words = [str(x) if k in ("regularizer", "recipe") else f"{k}={x}" for k, x in shown.items()]
    return ", ".join(words) or "plain"


def value(row: Row, figure: str) -> float:
    """Return a figure of a row, such as "test psnr" or "gaussians"; nan if it was not measured."""
    found: Any = row
    for key in figure.split():
        found = (found or {}).get(key)
    return math.nan if found is None else float(found)


class Rows:
    """The rows of one scene, in a file with one line each; several processes may add to it.

    Args:
        file: the JSON file, which need not exist.
        about: further entries of a new file.
        lock: a file on the same machine to lock while it is written.

    Raises:
        ValueError: if the file is of the scene with other ``options`` than those of ``about``.
    """

    def __init__(self, file: Path, about: Mapping[str, Any] | None = None, lock: Path | None = None) -> None:
        self.file, self.lock = file, lock or file.with_suffix(".lock")
        self.content: dict[str, Any] = read_json(file) if file.is_file() else {**(about or {}), "rows": []}
        found, asked = (of.get("options") for of in (self.content, about or {}))
        if None not in (found, asked) and found != asked:
            raise ValueError(f"{file} holds trainings with the options {found}, not {asked}: give another --out.")

    @property
    def rows(self) -> Sequence[Row]:
        """All rows, in the order in which they were added."""
        rows: list[Row] = self.content["rows"]
        return rows

    def of(self, setting: Setting) -> dict[int, Row]:
        """Return the rows of a resolved setting by seed."""
        return {row["seed"]: row for row in self.rows if row["setting"] == setting}

    def add(self, row: Row) -> None:
        """Add a row, replacing that of the same training if there is one, and write the file."""
        self.lock.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(self.lock):
            if self.file.is_file():
                self.content = read_json(self.file)
            same = ("setting", "seed")
            others = [old for old in self.rows if any(old[name] != row[name] for name in same)]
            self.content["rows"] = [*others, row]
            about = [f"{json.dumps(name)}: {json.dumps(x)}, " for name, x in self.content.items() if name != "rows"]
            lines = ",\n".join(json.dumps(each, allow_nan=False) for each in self.rows)
            write_text(self.file, f'{{{"".join(about)}"rows": [\n{lines}\n]}}\n')
