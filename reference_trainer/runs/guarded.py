"""What hangs where nobody took a photograph, or hung there until the guard removed it: said, kept, and shown."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from torch import Tensor

from reference_trainer.evaluation.pictures import is_own_png, save_png, side_by_side
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import Guard, guard, where_it_shows
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.json_files import read_json
from reference_trainer.runs.folder import GUARD, GUARD_PICTURE
from reference_trainer.scenes.scene import Scene
from reference_trainer.threads import threads_for

__all__ = ["HANGING", "hanging_picture", "keep_removed", "log_what_hangs", "removed_from"]

HANGING = "hanging.png"
"""What hangs in a model that is measured, beside its scores."""
_log = logging.getLogger(__name__)


def hanging_picture(model: TrainedModel, scene: Scene, found: Guard) -> Tensor:
    """Return the view that nobody took where what hangs shows most, with it and without, side by side (3, H, W)."""
    view, hung, freed = where_it_shows(model, scene, found)
    return side_by_side([hung, freed], [view.name, "without what hangs there"])


def log_what_hangs(model: TrainedModel, scene: Scene | None, out: Path) -> None:
    """Log what hangs where nobody took a photograph and show it in ``hanging.png``, where that can be told.

    It can for a model that was trained with a regularizer, of a scene with two training cameras or more.
    """
    if scene is None or len(scene.train) < 2 or not len(model.chain):
        return
    with threads_for(scene.pixels):
        found = guard(model, scene)
        image = hanging_picture(model, scene, found) if found.where else None
    _log.info("%s%s", found, " To remove them: ca-reg clean PLY --hanging --scene FOLDER." if found.where else "")
    if not is_own_png(path := out / HANGING):
        _log.info("%s is not from here, and is kept: there is no picture of what hangs.", path)
    elif image is not None:
        save_png(path, image)
        _log.info("How that looks is in %s", path)
    else:  # of an earlier model
        path.unlink(missing_ok=True)


def keep_removed(folder: Path, step: int, model: TrainedModel, scene: Scene, found: Guard) -> None:
    """Keep in the folder of a run what the guard removed after a step, and a picture of it.

    ``model`` is as it was before. An entry of the same step or a later one is of a training that was interrupted and
    takes that step again.
    """
    with threads_for(scene.pixels):
        save_png(folder / GUARD_PICTURE, hanging_picture(model, scene, found))
    before = [entry for entry in _entries(folder) if entry["step"] < step]
    write_json(folder / GUARD, [*before, {"step": step, "found": str(found)}])


def removed_from(folder: Path) -> list[str]:
    """Return a sentence for every time that the guard removed something from the model of a run.

    Raises:
        ValueError: if the file about it is damaged.
    """
    return [f"Removed after step {entry['step']:,}: {entry['found']}" for entry in _entries(folder)]


def _entries(folder: Path) -> list[dict[str, Any]]:
    """Return what the guard removed, by step."""
    path = folder / GUARD
    entries = read_json(path) if path.exists() else []
    if not (isinstance(entries, list) and all(isinstance(x, dict) and {"step", "found"} <= x.keys() for x in entries)):
        raise ValueError(f"{path} is not a list of what the guard removed, with step and found: delete it.")
    return entries
