"""Measure a trained model on a scene, and render it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from ca_reg.regularizers import parse
from reference_trainer.evaluation.evaluate import Evaluation, evaluate
from reference_trainer.evaluation.kept import PARTIAL
from reference_trainer.evaluation.lpips import LPIPS
from reference_trainer.evaluation.pictures import file_names, save_gif, save_png
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.tables import evaluation_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.evaluation.trajectory import interpolate_cameras
from reference_trainer.files import remove_leftovers, write_text
from reference_trainer.runs.folder import VIEWS
from reference_trainer.runs.lock import run_lock
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.threads import threads_for

__all__ = ["measure", "of_run", "render_run"]

Say = Callable[[str], None]


def of_run(run: Path, device: str = "cpu", *, regularizer: str | None = None) -> tuple[TrainedModel, Scene]:
    """Return a run's model at its last checkpoint, and its scene.

    Args:
        run: folder of the run.
        device: where to render.
        regularizer: treat the model as if it had been trained with these, such as "noise(0.8, scale=True)" for a run
            with "noise(0.8)"; by default with those of the run.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if the expression cannot be parsed.
    """
    trainer = load_run(run, device)
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
    say: Say = print,
) -> Evaluation:
    """Measure a model at views; write ``evaluation.json``, ``evaluation.md`` and pictures, and print the table.

    After an interruption, the same call continues with the next view.

    Args:
        model: what to measure.
        views: by split, see `evaluate`.
        out: folder for the results.
        about: further entries of the JSON file, such as the name of the scene.
        samples: K of the CA score.
        seed: of its masks.
        perceptual: a perceptual metric.
        say: receives the table and the progress.
    """
    keep, largest = out / PARTIAL, max(view.camera.width * view.camera.height for of in views.values() for view in of)
    with run_lock(out), threads_for(largest):
        remove_leftovers(out / VIEWS)
        result = evaluate(
            model, views, samples=samples, seed=seed, perceptual=perceptual, pictures=out / VIEWS, keep=keep, say=say
        )
        data = {
            **about,
            **result.as_dict(),
            "ca_settings": asdict(model.ca_score(samples=samples, seed=seed).settings),
            "background": model.background.tolist(),
            "regularizer": model.regularizer,
            "machine": machine(),
        }
        write_json(out / "evaluation.json", data)
        table = evaluation_table(data)
        write_text(out / "evaluation.md", table + "\n")
        keep.unlink(missing_ok=True)
    say(table)
    say(f"Scores and pictures are in {out}")
    return result


@torch.no_grad()
def render_run(
    run: Path, what: str, out: Path | None = None, *, frames: int = 60, device: str = "cpu", say: Say = print
) -> Path:
    """Render a run with its test-time opacities.

    Args:
        run: folder of the run.
        what: ``"test"``, ``"train"``, or ``"flight"`` through the training cameras.
        out: folder for PNG files, and for a flight also a GIF; ``<run>/render_<what>`` by default.
        frames: number of pictures of a flight.
        device: where to render.
        say: receives where the pictures are.

    Returns:
        The folder.

    Raises:
        ValueError: if there is no test view to render.
    """
    model, scene = of_run(run, device)
    folder = out or run / f"render_{what}"
    views: Sequence[Viewpoint]
    if what == "flight":
        path = interpolate_cameras([view.camera for view in scene.train], frames)
        views = [Viewpoint(f"{i:04d}", camera) for i, camera in enumerate(path)]
    else:
        views = scene.test if what == "test" else scene.train
    if not views:
        raise ValueError(f"the scene of {run} has no test view: give --what train or --what flight.")
    images = []
    for name, view in zip(file_names([view.name for view in views]), views, strict=True):
        with threads_for(view.camera.width * view.camera.height):
            image = model.test_rendering(view.to(device)).image
        images.append(image.clamp(0, 1).cpu())
        save_png(folder / f"{name}.png", images[-1])
    if what == "flight":
        save_gif(folder / "flight.gif", images)
    say(f"{len(images)} pictures are in {folder}")
    return folder
