"""Checkpoints: writing and reading them, and checking their content before anything is made of it."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from reference_trainer.files import replacing
from reference_trainer.json_files import settings_from
from reference_trainer.model.gaussians import PARAMETERS, Gaussians
from reference_trainer.scenes.scene import Scene
from reference_trainer.tensor_files import load_tensors, moved
from reference_trainer.training.assembly import make_density, make_regularizer
from reference_trainer.training.config import TrainConfig

__all__ = ["fingerprints", "load_checkpoint", "read_state", "save_checkpoint"]

_FORMAT = "ca_reg-checkpoint-1"


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write nested tensors, numbers, strings and None; an interrupted write leaves the file that was there before.

    Tensors are written from the CPU, so that any machine can read them. Raises OSError, which names the file, if it
    cannot be written, as on a full disk.
    """
    content = io.BytesIO()  # torch.save to a file hides the error of a full disk behind one of its own
    torch.save({"format": _FORMAT, **moved(state, "cpu")}, content)
    # The view ends here: one that a traceback keeps alive crashes Python 3.12.1 when its garbage is collected.
    with replacing(path) as place, place.open("wb") as file, content.getbuffer() as view:
        file.write(view)


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read what `save_checkpoint` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a checkpoint of this program, or damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint at {path}: train first, or give the path of a checkpoint.pt.")
    state = load_tensors(path, device, what="a readable checkpoint")
    if not isinstance(state, dict) or state.get("format") != _FORMAT:
        raise ValueError(f"{path} is not a checkpoint of this program (expected format {_FORMAT!r}).")
    return state


_SLACK = {"cameras": 1e-5, "photographs": 2e-3}  # beside 1e-4 of a number: decoders of JPEGs differ in the last bits


def fingerprints(scene: Scene) -> dict[str, Tensor]:
    """Return what tells the training views from others of their names: cameras (V, 18) and thumbnails (V, 192)."""
    cameras = [view.camera for view in scene.train]
    poses = torch.stack([camera.world_to_camera[:3].flatten() for camera in cameras])
    lenses = poses.new_tensor([[c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in cameras])
    thumbnails = torch.stack([adaptive_avg_pool2d(view.image, 8).flatten() for view in scene.train])
    return {"cameras": torch.cat([poses, lenses], 1), "photographs": thumbnails.nan_to_num()}


_TIMES = ("seconds", "processor_seconds")
_ENTRIES = ("format", "config", "scene", "train_views", "fingerprints", "step", *_TIMES)
_OF_A_MODEL = ("statistics", "regularizer", "gaussians", "moments")
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def read_state(
    state: dict[str, Any], scene: Scene, where: Path, refuse: Callable[[TrainConfig], None]
) -> tuple[TrainConfig, list[dict[str, Any]]]:
    """Check that what `Trainer.save` wrote is complete and consistent, and belongs to the scene to continue on.

    ``where`` is the file, for errors; ``refuse`` is called with the settings before anything that they name is made,
    and raises to refuse them. Returns the settings, and the `ModelState.state_dict` of each model.

    Raises:
        ValueError: if something is missing, unknown, or of another type or shape, a number is not finite or out of
            its range, or the checkpoint belongs to another scene or other training views.
    """
    try:
        return _read(state, scene, where, refuse)
    except (TypeError, AttributeError, LookupError) as error:
        raise ValueError(f"{where} is a damaged checkpoint: {error}") from error


def _read(
    state: dict[str, Any], scene: Scene, where: Path, refuse: Callable[[TrainConfig], None]
) -> tuple[TrainConfig, list[dict[str, Any]]]:
    """Read a state; wrong types that are not checked for raise TypeError, AttributeError or LookupError."""
    others = ("others",) if "others" in state else ()  # there is none beside a single model
    _refuse_other_entries(state, (*_ENTRIES, *_OF_A_MODEL, *others), f"{where}")
    names = [view.name for view in scene.train]
    if state["scene"] != scene.name:
        raise ValueError(f"{where} was trained on the scene {state['scene']!r:.80}, this one is {scene.name!r}.")
    if state["train_views"] != names:
        raise ValueError(f"{where} was trained on the views {state['train_views']!r:.400}, the scene has {names}.")
    _refuse_other_views(state["fingerprints"], scene, where)
    config = _config(state["config"], where)
    refuse(config)
    step, times = state["step"], tuple(state[name] for name in _TIMES)
    if type(step) is not int or not 0 <= step <= config.iterations:
        raise ValueError(f"{where}: step must be a whole number from 0 to {config.iterations}, got {step!r:.80}.")
    if not all(type(x) is float and 0 <= x < math.inf for x in times):
        raise ValueError(f"{where}: {' and '.join(_TIMES)} must be positive numbers, got {times!r:.80}.")
    models = [{name: state[name] for name in _OF_A_MODEL}, *state.get("others", ())]
    if len(models) != config.models:
        raise ValueError(f"{where}: expected {config.models} models, got {len(models)}; the checkpoint is damaged.")
    return config, [
        _read_model(model, config, scene, step, number, f"{where}{f', model {number}' if number else ''}")
        for number, model in enumerate(models)
    ]


def _refuse_other_views(found: Any, scene: Scene, where: Path) -> None:
    """Refuse cameras or photographs that have changed under their names."""
    expected = fingerprints(scene)
    _refuse_other_entries(found, expected, f"{where}, fingerprints")
    for what, x in expected.items():
        _check(found[what], tuple(x.shape), f"{where}, fingerprints of {what}")
        same = torch.isclose(found[what].to(x), x, rtol=1e-4, atol=_SLACK[what]).all(1).tolist()
        if changed := [view.name for view, unchanged in zip(scene.train, same, strict=True) if not unchanged]:
            raise ValueError(
                f"{where} was trained with other {what} of the same names, see {changed}: put those back, or train in "
                "another folder. The PLY can be measured on a changed scene: ca-reg evaluate PLY --scene FOLDER."
            )


def _read_model(
    state: dict[str, Any], config: TrainConfig, scene: Scene, step: int, number: int, where: str
) -> dict[str, Any]:
    _refuse_other_entries(state, _OF_A_MODEL, where)
    tensors, moments = state["gaussians"], state["moments"]
    parameters = [*PARAMETERS, *make_regularizer(config).learns]
    _refuse_other_entries(tensors, parameters, f"{where}, gaussians")
    _refuse_other_entries(moments, parameters, f"{where}, moments")
    try:
        gaussians = Gaussians.from_named(tensors)
    except ValueError as error:
        raise ValueError(f"{where}, gaussians: {error}") from error
    if len(gaussians) == 0:
        raise ValueError(f"{where}, gaussians: there is none to train.")
    if gaussians.sh_degree != config.sh_degree:
        raise ValueError(f"{where}, gaussians: expected sh_degree {config.sh_degree}, got {gaussians.sh_degree}.")
    for name, x in tensors.items():
        _check(x, tuple(x.shape), f"{where}, {name}")
        if moments[name] != {}:  # as before the first step
            _check_moments(moments[name], tuple(x.shape), step, f"{where}, moments of {name}")
    counts = make_density(config, number)
    counts.begin(config, scene, gaussians.means.device, len(gaussians))
    expected = counts.state_dict()
    _refuse_other_entries(state["statistics"], expected, f"{where}, statistics")
    for name, x in state["statistics"].items():
        _check(x, tuple(expected[name].shape), f"{where}, {name}")
    # They are updated in place, which a file can prevent: by requiring a gradient, or by sharing memory.
    statistics = {name: x.detach().clone() for name, x in state["statistics"].items()}
    found = state["regularizer"]
    if type(found) is not dict or not all(isinstance(x, Tensor) and bool(x.isfinite().all()) for x in found.values()):
        raise ValueError(f"{where}, regularizer: expected finite tensors by name; the checkpoint is damaged.")
    return state | {"statistics": statistics}


def _config(text: Any, where: Path) -> TrainConfig:
    if type(text) is not str:
        raise ValueError(f"{where} is a damaged checkpoint: config must be JSON, got {type(text).__name__}.")
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where} is a damaged checkpoint: config is not JSON: {error}") from error
    return settings_from(TrainConfig, values, f"{where}, config")


def _refuse_other_entries(values: Any, names: Collection[str], what: str) -> None:
    """Refuse anything but a dict with exactly these names."""
    if type(values) is not dict:
        raise ValueError(f"{what}: expected entries by name, got {type(values).__name__}; the checkpoint is damaged.")
    if missing := [name for name in names if name not in values]:
        raise ValueError(f"{what}: it lacks {missing[0]!r}; the checkpoint is damaged, train anew, or take a copy.")
    if unknown := [f"{name!r:.40}" for name in values if name not in names]:
        raise ValueError(f"{what}: unknown entry {unknown[0]}; it is damaged, or another version wrote it.")


def _check_moments(moments: Any, shape: tuple[int, ...], step: int, what: str) -> None:
    """Refuse what Adam cannot continue from: a negative second moment would give nan at the next step."""
    _refuse_other_entries(moments, _MOMENTS, what)
    for key, x in moments.items():
        _check(x, () if key == "step" else shape, f"{what}, {key}", least=None if key == "exp_avg" else 0)
    taken = moments["step"].item()
    if taken > step or taken != int(taken):
        raise ValueError(f"{what}, step: expected a whole number up to {step}, got {taken:g}.")


def _check(x: Any, shape: tuple[int, ...], what: str, *, least: float | None = None) -> None:
    """Refuse anything but a finite float32 tensor of a shape, without values below ``least``."""
    if not isinstance(x, Tensor) or x.dtype != torch.float32 or tuple(x.shape) != shape:
        got = f"{x.dtype}, {tuple(x.shape)}" if isinstance(x, Tensor) else type(x).__name__
        raise ValueError(f"{what}: expected float32 of shape {shape}, got {got}.")
    if not bool(x.isfinite().all()):
        raise ValueError(f"{what}: holds nan or infinity.")
    if least is not None and not bool((x >= least).all()):
        raise ValueError(f"{what}: must not be below {least:g}, got {x.min().item():g}.")
