"""The folder of a run: what its files are called, and which run it belongs to."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import Any

from reference_trainer.json_files import read_json
from reference_trainer.runs.settings import read_run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import Plan

__all__ = [
    "BAKED_PLY",
    "CHECKPOINT",
    "CONFIG",
    "PLAN",
    "PLY",
    "RESULTS",
    "VIEWS",
    "begun_with",
    "claim",
    "read_results",
]

CONFIG = "config.json"
PLAN = "plan.json"
CHECKPOINT = "checkpoint.pt"
PLY = "point_cloud.ply"
BAKED_PLY = "point_cloud_for_viewers.ply"
VIEWS = "views"  # here and in the folder of an evaluation
RESULTS = "results.json"


def claim(options: SceneOptions, config: TrainConfig) -> dict[str, Any]:
    """Return the content of ``config.json``: the run that a folder belongs to."""
    return {"scene": dataclasses.asdict(options.absolute()), "config": dataclasses.asdict(config)}


def begun_with(
    out: Path, options: SceneOptions, config: TrainConfig, *, auto: bool, given: Collection[str]
) -> TrainConfig | None:
    """Return the settings that a run in a folder began with, None if none has begun.

    Args:
        out: the folder.
        options: the scene.
        config: what is asked for.
        auto: whether the plan that the run began with, if any, belongs to what is asked for.
        given: the settings that no plan changes.

    Raises:
        ValueError: if the folder holds another run, or a damaged file.
    """
    if not (out / CONFIG).exists():
        return None
    if auto and (out / PLAN).exists():
        config = _read_plan(out / PLAN).applied(config, given=given)
    _refuse_other_run(out, claim(options, config))
    return config


def read_results(out: Path) -> dict[str, Any]:
    """Read the results of a complete run.

    Raises:
        ValueError: if the file is damaged.
        OSError: if it cannot be read.
    """
    results = read_json(out / RESULTS)
    if not isinstance(results, dict) or "mean" not in results:
        raise ValueError(f"{out / RESULTS} does not hold the results of a run: delete it to measure again.")
    return results


def _read_plan(path: Path) -> Plan:
    """Read the plan of a run."""
    try:
        return Plan.from_dict(read_json(path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _refuse_other_run(out: Path, settings: dict[str, Any]) -> None:
    """Refuse a folder that holds a run with other settings."""
    found = claim(*read_run_settings(out / CONFIG))
    changed = [
        f"{key}: {found[part][key]} -> {value}"
        for part, values in settings.items()
        for key, value in values.items()
        if found[part][key] != value
    ]
    if changed:
        raise ValueError(
            f"{out} holds a run with other settings ({'; '.join(changed)}): give another folder, or delete this one."
        )
