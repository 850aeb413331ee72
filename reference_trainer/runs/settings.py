"""Reading the settings of a run back."""

from __future__ import annotations

from pathlib import Path

from reference_trainer.json_files import read_json, settings_from
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["read_run_settings"]


def read_run_settings(path: str | Path) -> tuple[SceneOptions, TrainConfig]:
    """Return the scene and the training of a run from its ``config.json``.

    A setting that the file lacks is at its default: the version that wrote it did not have it yet.

    Raises:
        ValueError: if the file is not such a file, or holds a setting that there is not or that is out of range.
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
    return scene, settings_from(TrainConfig, content["config"], f"{path}, config")
