"""Measure a model on a scene, and draw what has been trained before."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import torch

from reference_trainer.evaluation.evaluate import Evaluation, PerceptualMetric, evaluate
from reference_trainer.evaluation.kept import PARTIAL
from reference_trainer.evaluation.pictures import file_names, save_gif, save_png
from reference_trainer.evaluation.results import machine, markdown_table, write_json
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.evaluation.trajectory import interpolate_cameras
from reference_trainer.files import remove_leftovers, write_text
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.runs.folder import VIEWS
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.scene import Scene
from reference_trainer.threads import threads_for

__all__ = ["evaluation_table", "measure", "of_run", "render_run"]

Say = Callable[[str], None]


def of_run(run: Path, device: str = "cpu", *, scale_noise: bool = False) -> tuple[TrainedModel, Scene, Path]:
    """Return a run's model at its last checkpoint, its scene, and the folder for its evaluation.

    Args:
        run: folder of the run.
        device: where to render.
        scale_noise: scale by the mean of the noise at test time, also if the run does not; the training would have
            been the same.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if ``scale_noise`` is asked of a run without noise, or with inverted dropout.
    """
    trainer = load_run(run, device)
    if not scale_noise:
        return model_of(trainer), trainer.scene, run / "evaluation"
    if trainer.config.noise == 0:
        raise ValueError(f"{run} was trained without noise, there is nothing to scale by: leave out --scale-noise.")
    trainer.config = replace(trainer.config, scale_noise=True)
    return model_of(trainer), trainer.scene, run / "evaluation_scale_noise"


def measure(
    model: TrainedModel,
    scene: Scene,
    out: Path,
    *,
    samples: int = 5,
    seed: int = 0,
    perceptual: PerceptualMetric | None = None,
    about: Mapping[str, object] | None = None,
    say: Say = print,
) -> Evaluation:
    """Measure a model on a scene; write ``evaluation.json``, ``evaluation.md`` and pictures, and print the table.

    If it is interrupted, the same call continues with the next view.

    Args:
        model: what to measure.
        scene: its views.
        out: folder for the results.
        samples: K of the CA score.
        seed: of its masks.
        perceptual: a perceptual metric.
        about: what a PLY says of itself, for the JSON file; None for a run, which has a file of its own.
        say: receives the table and the progress.
    """
    keep = out / PARTIAL
    remove_leftovers(out / VIEWS)
    with threads_for(scene.pixels):
        result = evaluate(
            model,
            scene,
            samples=samples,
            seed=seed,
            perceptual=perceptual,
            pictures=out / VIEWS,
            keep=keep,
            progress=say,
        )
        computed_on = machine()
    settings = model.ca_score(samples=samples, seed=seed).settings
    data = {
        "scene": scene.name,
        **({} if about is None else {"ply": dict(about)}),
        **result.as_dict(),
        "ca_settings": asdict(settings),
        "background": model.background.tolist(),
        "expected_noise": model.expected_noise,
        "machine": computed_on,
    }
    write_json(out / "evaluation.json", data)
    table = evaluation_table(result)
    write_text(out / "evaluation.md", table + "\n")
    keep.unlink(missing_ok=True)
    say(table)
    say(f"Scores and pictures are in {out}")
    return result


def evaluation_table(result: Evaluation) -> str:
    """Return one row per view and the means, in Markdown; CA in units of 1e-3."""
    quantities = ("psnr", "ssim", "lpips", "ca", "ca_std_error", "ca_exact", "visible", "cv")
    unit = {"ca": 1e-3, "ca_std_error": 1e-3, "ca_exact": 1e-3}
    title = {name: f"{name} x1e-3" if name in unit else name for name in quantities}
    rows: list[dict[str, object]] = [
        {"view": f"{view.split} {view.name}"} | {title[q]: getattr(view, q) / unit.get(q, 1) for q in quantities}
        for view in result.views
    ]
    for split in sorted({view.split for view in result.views}):
        rows.append({"view": f"mean {split}"} | {title[q]: result.mean(split, q) / unit.get(q, 1) for q in quantities})
    shown = [title[q] for q in quantities if q != "lpips" or result.perceptual_metric is not None]
    return markdown_table(rows, ["view", *shown])


@torch.no_grad()
def render_run(
    run: Path, what: str, out: Path | None = None, *, frames: int = 60, device: str = "cpu", say: Say = print
) -> Path:
    """Render a run with its test-time opacities.

    Args:
        run: folder of the run.
        what: ``"test"``, ``"train"``, or ``"flight"`` through the training cameras.
        out: folder for PNG files, and a GIF of a flight; ``<run>/render_<what>`` by default.
        frames: pictures of a flight.
        device: where to render.
        say: receives where the pictures are.

    Returns:
        The folder.
    """
    trainer = load_run(run, device)
    model = model_of(trainer)
    folder = out or run / f"render_{what}"
    if what == "flight":
        path = interpolate_cameras([view.camera for view in trainer.scene.train], frames)
        cameras = {f"{i:04d}": camera for i, camera in enumerate(path)}
    else:
        views = trainer.scene.test if what == "test" else trainer.scene.train
        names = file_names([view.name for view in views])
        cameras = {name: view.camera for name, view in zip(names, views, strict=True)}
    opacities = model.test_opacities
    images = []
    for name, camera in cameras.items():
        with threads_for(camera.width * camera.height):
            rendering = render_gaussians(
                model.gaussians, camera, model.background, opacities=opacities, sh_degree=model.sh_degree
            )
        images.append(rendering.image.clamp(0, 1).cpu())
        save_png(folder / f"{name}.png", images[-1])
    if what == "flight":
        save_gif(folder / "flight.gif", images)
    say(f"{len(images)} pictures are in {folder}")
    return folder
