"""The folder of a run: the names of its files, and the settings that claim it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from reference_trainer.json_files import read_json, settings_from
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig, saved_config
from reference_trainer.training.plan import Plan

__all__ = [
    "BAKED_PLY", "CHECKPOINT", "CONFIG", "PLAN", "PLY", "RESULTS", "VIEWS",
    "begun_with", "folder_name", "read_results", "read_run_settings", "run_settings",
]  # fmt: skip

CONFIG = "config.json"
PLAN = "plan.json"
CHECKPOINT = "checkpoint.pt"
PLY = "point_cloud.ply"
BAKED_PLY = "point_cloud_for_viewers.ply"
VIEWS = "views"  # here and in the folder of an evaluation
RESULTS = "results.json"


def folder_name(text: str) -> str:
    """Return a folder name for an expression, such as that of a regularizer.

    Example:
        >>> folder_name("dropout(0.1) + noise(0.4)"), folder_name("")
        ('dropout_0.1_noise_0.4', 'plain')
    """
    return re.sub(r"[^\w.=-]+", "_", text).strip("_") or "plain"


def run_settings(options: SceneOptions, config: TrainConfig) -> dict[str, Any]:
    """Return the content of ``config.json``, which claims a folder for one run."""
    return {"scene": dataclasses.asdict(options.absolute()), "config": dataclasses.asdict(config)}


def read_run_settings(path: str | Path) -> tuple[SceneOptions, TrainConfig]:
    """Return the scene and the training of a run from its ``config.json``.

    Settings that the file lacks, because an older version wrote it, take their defaults.

    Raises:
        ValueError: if the file is not a run's ``config.json``, or holds an unknown or invalid setting.
        OSError: if it cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "config.json").write_text('{"scene": {"views": 3}, "config": {"dropout": 0.2}}')
        ...     scene, config = read_run_settings(f"{folder}/config.json")
        >>> scene.path, scene.views, config.dropout
        ('synthetic', 3, 0.2)
    """
    content = read_json(path)
    if not isinstance(content, dict) or not {"scene", "config"} <= content.keys():
        raise ValueError(f"{path} is not the config.json of a run: it must hold the objects 'scene' and 'config'.")
    scene = settings_from(SceneOptions, content["scene"], f"{path}, scene")
    return scene, saved_config(content["config"], f"{path}, config")


def begun_with(
    out: Path, options: SceneOptions, config: TrainConfig, *, auto: bool, given: Collection[str]
) -> TrainConfig | None:
    """Return the settings that the run in a folder began with, None if none has begun.

    Args:
        out: the folder.
        options: the requested scene.
        config: the requested training.
        auto: whether to apply the plan that the run began with, if any, to ``config``.
        given: the settings that no plan changes.

    Raises:
        ValueError: if the folder holds a run with other settings, a checkpoint without settings, or a damaged file.
    """
    trained = (out / CHECKPOINT).exists()  # looked for first: another process writes it last
    if not (out / CONFIG).exists():
        if trained:
            raise ValueError(f"{out} holds a {CHECKPOINT} but no {CONFIG}: give another folder, or delete this one.")
        return None
    if auto and (out / PLAN).exists():
        try:
            config = Plan.from_dict(read_json(out / PLAN)).applied(config, given=given)
        except (ValueError, TypeError, AttributeError) as error:  # whatever a damaged file, or another version's, holds
            raise ValueError(f"{out / PLAN}: {error}") from error
    found = run_settings(*read_run_settings(out / CONFIG))
    changed = [
        f"{key}: {found[part][key]} -> {value}"
        for part, values in run_settings(options, config).items()
        for key, value in values.items()
        if found[part][key] != value
    ]
    if changed:
        raise ValueError(
            f"{out} holds a run with other settings ({'; '.join(changed)}): give another folder, or delete this one."
        )
    return config


def read_results(out: Path) -> dict[str, Any]:
    """Read the results of a complete run; scores that an older version did not measure may be missing.

    Raises:
        ValueError: if the file is damaged.
        OSError: if it cannot be read.
    """
    results: dict[str, Any] = read_json(out / RESULTS)
    match results:
        case {
            "config": {"seed": int()},
            "gaussians": int() as count,
            "seconds": float(),
            "mean": {"train": _} as means,
            "views": [_, *_] as views,
        }:
            named = all(isinstance(view, dict) and {"name", "split"} <= view.keys() for view in views)
            if named and all(map(_is_row, (*means.values(), *views))) and count.bit_length() < 64:
                return results
    raise ValueError(f"{out / RESULTS} does not hold the results of a run: delete it to measure again.")


def _is_row(row: Any) -> bool:
    """Whether these are the scores of a view or their means: text where it belongs, else a number or None."""
    return isinstance(row, dict) and all(
        isinstance(x, str if name in ("name", "split", "ca_reason") else float | None) for name, x in row.items()
    )
