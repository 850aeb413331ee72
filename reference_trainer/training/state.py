"""What the checkpoint of a trainer holds, checked before anything is made of it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from reference_trainer.json_files import settings_from
from reference_trainer.model.density import DensityStatistics
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig

__all__ = ["TrainingState", "read_state"]


class TrainingState(NamedTuple):
    """A trainer between two steps.

    Args:
        config: all settings.
        step: number of steps taken.
        seconds: time that they took.
        statistics: of density control.
        optimizer: what `GaussianOptimizer.state_dict` returned.
    """

    config: TrainConfig
    step: int
    seconds: float
    statistics: DensityStatistics
    optimizer: dict[str, Any]


def read_state(state: dict[str, Any], scene: Scene, where: Path) -> TrainingState:
    """Check what `Trainer.save` wrote: nothing is missing, and everything fits together and the scene.

    Args:
        state: content of the checkpoint.
        scene: the scene to continue on.
        where: the file, for errors.

    Raises:
        ValueError: if something is missing or of another type or shape, a number is not finite, or the checkpoint
            belongs to another scene or other training views.
    """
    try:
        return _read(state, scene, where)
    except KeyError as error:
        raise ValueError(f"{where} is a damaged checkpoint: it lacks {error}; train anew, or take a copy.") from error
    except (TypeError, AttributeError, RecursionError, json.JSONDecodeError) as error:
        raise ValueError(f"{where} is a damaged checkpoint: {error}") from error


def _read(state: dict[str, Any], scene: Scene, where: Path) -> TrainingState:
    """Read a state; whatever it lacks is a KeyError, whatever is of another type a TypeError."""
    names = [view.name for view in scene.train]
    if state["scene"] != scene.name:
        raise ValueError(f"{where} was trained on the scene {state['scene']!r}, this one is {scene.name!r}.")
    if state["train_views"] != names:
        raise ValueError(f"{where} was trained on the views {state['train_views']}, the scene has {names}.")
    config = settings_from(TrainConfig, json.loads(state["config"]), f"{where}, config")
    step, seconds = state["step"], state["seconds"]
    if type(step) is not int or not 0 <= step <= config.iterations:
        raise ValueError(f"{where}: step must be a whole number from 0 to {config.iterations}, got {step!r}.")
    if type(seconds) is not float or not 0 <= seconds < math.inf:
        raise ValueError(f"{where}: seconds must be a positive number, got {seconds!r}.")
    tensors = state["gaussians"]
    try:
        gaussians = Gaussians(**tensors)
    except ValueError as error:
        raise ValueError(f"{where}, gaussians: {error}") from error
    if gaussians.sh_degree != config.sh_degree:
        raise ValueError(f"{where}, gaussians: expected sh_degree {config.sh_degree}, got {gaussians.sh_degree}.")
    for name, x in tensors.items():
        _check(x, tuple(x.shape), f"{where}, {name}")
        moments = state["moments"][name]
        for key in ("step", "exp_avg", "exp_avg_sq") if moments else ():
            _check(moments[key], () if key == "step" else tuple(x.shape), f"{where}, {key} of {name}")
    statistics = DensityStatistics(**state["statistics"])
    for name, x in vars(statistics).items():
        _check(x, (len(gaussians),), f"{where}, {name}")
    return TrainingState(config, step, seconds, statistics, {"gaussians": tensors, "moments": state["moments"]})


def _check(x: Any, shape: tuple[int, ...], what: str) -> None:
    """Refuse anything but finite float32 of a shape."""
    if not isinstance(x, Tensor) or x.dtype != torch.float32 or tuple(x.shape) != shape:
        got = f"{x.dtype}, {tuple(x.shape)}" if isinstance(x, Tensor) else type(x).__name__
        raise ValueError(f"{what}: expected float32 of shape {shape}, got {got}.")
    if not bool(x.isfinite().all()):
        raise ValueError(f"{what}: holds nan or infinity.")
