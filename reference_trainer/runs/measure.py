"""Measure a trained model on a scene, and render it."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from typing import Any

import torch

from ca_reg.regularizers import parse
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.evaluate import Evaluation, evaluate, expected_error_picture
from reference_trainer.evaluation.lpips import LPIPS
from reference_trainer.evaluation.pictures import PANEL, file_names, is_own_png, save_film, save_png
from reference_trainer.evaluation.results import PARTIAL, machine, write_json
from reference_trainer.evaluation.tables import evaluation_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import has_mark, remove_leftovers, write_text
from reference_trainer.runs.folder import VIEWS, check_output, run_lock
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.scenes.virtual_cameras import interpolate_cameras, measured_views
from reference_trainer.threads import threads_for

__all__ = ["load_run_model", "measure", "render_run"]

EVALUATION = "evaluation.json"
_log = logging.getLogger(__name__)


def load_run_model(
    run: Path, device: str = "cpu", *, regularizer: str | None = None, trust: Collection[str] = ()
) -> tuple[TrainedModel, Scene]:
    """Return a run's model at its last checkpoint, and its scene; logs its step if the training is not finished.

    With ``regularizer``, such as "noise(0.8, scale=True)" for a run with "noise(0.8)", the model is treated as if it
    had been trained with that. ``trust`` is as for `load_run`.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if the expression cannot be parsed, or the run names code that is not trusted.
    """
    trainer = load_run(run, device, trust=trust)
    if trainer.step < (last := trainer.config.iterations):
        _log.info("%s is not trained to its end: this is its model of step %d of %d", run, trainer.step, last)
    model = model_of(trainer)
    if regularizer is not None:
        parse(regularizer)
        model = replace(model, regularizer=regularizer)
    return model, trainer.scene


def measure(
    model: TrainedModel,
    views: Mapping[str, Sequence[Viewpoint]],
    out: Path,
    *,
    about: Mapping[str, object],
    samples: int = 5,
    seed: int = 0,
    perceptual: LPIPS | None = None,
) -> Evaluation:
    """Measure a model at views; write ``evaluation.json``, ``evaluation.md`` and pictures, and print the table.

    After an interruption, the same call continues with the next view. Views, samples, seed and metric are as for
    `evaluate`; ``about`` holds further entries of the JSON file, such as the name of the scene.

    Raises:
        ValueError: if ``out`` holds files of these names that are not from here.
    """
    # A folder with an earlier measurement is ours; in any other, files of these names are somebody else's.
    ours = (out / PARTIAL).exists() or has_mark(out / EVALUATION, b'"ca_settings"')
    check_output(out, None, () if ours else (EVALUATION, "evaluation.md", VIEWS))
    partial = out / PARTIAL
    largest = max(view.camera.width * view.camera.height for of in views.values() for view in of)
    with run_lock(out), threads_for(largest):
        remove_leftovers(out / VIEWS)
        shared: dict[str, Any] = {"samples": samples, "seed": seed}
        result = evaluate(model, views, perceptual=perceptual, pictures=out / VIEWS, partial=partial, **shared)
        data = {
            **about,
            **result.as_dict(),
            "ca_settings": asdict(model.ca_score(**shared).settings),
            "background": model.background.tolist(),
            "regularizer": model.regularizer,
            "machine": machine(model.background.device),
        }
        write_json(out / EVALUATION, data)
        _remove_other_pictures(out / VIEWS, views)
        table = evaluation_table(data)
        write_text(out / "evaluation.md", table + "\n")
        partial.unlink(missing_ok=True)
    _log.info(table)
    _log.info("Scores and pictures are in %s", out)
    return result


def _remove_other_pictures(folder: Path, views: Mapping[str, Sequence[Viewpoint]]) -> None:
    """Remove the pictures of an earlier measurement at other views, which have no scores beside them."""
    named = {split: file_names([view.name for view in group]) for split, group in views.items()}
    shown = {folder / split / f"{name}{end}.png" for split, of in named.items() for name in of for end in ("", PANEL)}
    # Only pictures that this package has written: the folder is the user's.
    for path in {*folder.glob("*/*.png")} - shown:
        if is_own_png(path):
            path.unlink()
    for split in {path for path in folder.iterdir() if path.is_dir() and not any(path.iterdir())}:
        split.rmdir()


@torch.no_grad()
def render_run(
    run: Path,
    what: str = "auto",
    out: Path | None = None,
    *,
    frames: int = 60,
    mask: float | None = None,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> Path:
    """Render a run with its test-time opacities; return the folder of the pictures, ``<run>/render_<what>`` by default.

    ``what`` is ``"test"``, ``"train"``, ``"flight"`` through the training cameras in so many ``frames``, which is also
    written as a film (`save_film`) and takes the place of an earlier flight, or ``"auto"``: the test views, or if there
    is none the training views. ``"error"`` adds a heat map of the expected error to each test view, or if there is
    none, to views between and around the training cameras, and with ``mask`` a third picture, white where the expected
    error is above that. ``trust`` is as for `load_run`.

    Raises:
        ValueError: if there is no test view to render, or a picture of somebody else's would be overwritten.
    """
    model, scene = load_run_model(run, device, trust=trust)
    if what == "auto":
        what = "test" if scene.test else "train"
        if not scene.test:
            _log.info("The scene has no test view: these are the training views; --what flight moves between them.")
    views: Sequence[Viewpoint]
    if what == "flight":
        path = interpolate_cameras([view.camera for view in scene.train], frames)
        views = [Viewpoint(f"{i:04d}", camera) for i, camera in enumerate(path)]
    elif what == "error":
        # Views without a photograph are numbered anew around the cameras: their split tells them apart.
        new = [(split, of) for split, of in measured_views(scene).items() if split != "train"]
        views = scene.test or [replace(view, name=f"{split}_{view.name}") for split, of in new for view in of]
    else:
        views = scene.test if what == "test" else scene.train
    if not views:
        raise ValueError(f"the scene of {run} has no test view: give --what train or --what flight.")
    ends = ["", *["_error"] * (what == "error"), *["_mask"] * (mask is not None)]
    folder, names = out or run / f"render_{what}", file_names([view.name for view in views], ends)
    files = [f"{name}{end}.png" for name in names for end in ends]
    flown = (folder / files[0]).exists()  # the film of an earlier flight is beside its pictures
    films = ["flight.mp4", "flight.webp"] if what == "flight" and not flown else []
    check_output(folder, None, [*(file for file in files if not is_own_png(folder / file)), *films])
    maps = ErrorMaps(model, scene.train) if what == "error" else None
    images = []
    for name, view in zip(names, views, strict=True):
        with threads_for(view.camera.width * view.camera.height):
            image = model.test_rendering(view.to(device)).image.clamp(0, 1).cpu()
        images += [image] * (what == "flight")  # hundreds of large photographs would not fit into memory
        save_png(folder / f"{name}.png", image)
        if maps is not None:
            found = maps(view)
            _log.info("%s: expected %.1f dB, %.1f to %.1f", view.name, found.psnr, *found.interval)
            save_png(folder / f"{name}_error.png", expected_error_picture(found))
            if mask is not None:
                save_png(folder / f"{name}_mask.png", (found.error > mask).float().cpu().expand(3, -1, -1))
    if what == "flight":
        _log.info("The film is %s", save_film(folder, "flight", images))
        for number in count(len(views)):  # of an earlier, longer flight, which would go on where this one ends
            if not (left := folder / f"{number:04d}.png").exists() or not is_own_png(left):
                break
            left.unlink()
    _log.info("%d pictures are in %s", len(files), folder)
    return folder
