"""Score anyone's 3DGS PLY, on the views of a scene or from cameras around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from reference_trainer.evaluation.cameras import CameraEvaluation, evaluate_cameras
from reference_trainer.evaluation.evaluate import Evaluation, PerceptualMetric
from reference_trainer.evaluation.kept import PARTIAL
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.results import machine, markdown_table, write_json
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import remove_leftovers, write_text
from reference_trainer.model.gaussians import Gaussians, inverse_sigmoid
from reference_trainer.model.ply import load_ply
from reference_trainer.runs.folder import VIEWS
from reference_trainer.runs.frame_check import check_frame
from reference_trainer.runs.measure import measure
from reference_trainer.scenes.load import BACKGROUNDS
from reference_trainer.scenes.options import OrbitOptions, SceneOptions
from reference_trainer.scenes.orbit import bounding_sphere
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.threads import threads_for

__all__ = ["PlyFacts", "camera_table", "of_ply", "score_ply", "score_ply_on_orbit"]

SMALLEST_RADIUS = 0.25
"""Smaller models are enlarged to this: the near plane of the renderer, at 0.2, would cut into them."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class PlyFacts:
    """What a PLY says of itself.

    Args:
        gaussians: their number.
        sh_degree: of the coefficients in the file.
        sh_degree_used: highest band with a coefficient other than 0.
        opacity_scale: the factor that is baked into the stored opacities, 1 if none is.
        for_rendering: whether they are test-time opacities that the plain ones cannot be had from.
        dropout: the rate that the model was trained with, from the file or as told.
    """

    gaussians: int
    sh_degree: int
    sh_degree_used: int
    opacity_scale: float
    for_rendering: bool
    dropout: float

    def __str__(self) -> str:
        used = "" if self.sh_degree_used == self.sh_degree else f" (bands above {self.sh_degree_used} are zero)"
        opacities = "plain, as far as the file says"
        if self.for_rendering:
            opacities = "those of the test, used as they are, for CA too"
        elif self.opacity_scale < 1:
            opacities = f"{self.opacity_scale:g} baked in, taken out for CA"
        return (
            f"{self.gaussians:,} Gaussians, SH degree {self.sh_degree}{used}; opacities: {opacities}; dropout rate of "
            f"the training: {self.dropout:g}"
        )


def of_ply(
    ply: Path, *, background: Tensor, dropout: float = 0.0, device: str = "cpu"
) -> tuple[TrainedModel, PlyFacts]:
    """Return the model of a standard 3DGS PLY, and what the file says of it.

    A PLY that says that the test-time scaling is baked into its opacities says the rate as well. The scaling is undone,
    because CA is measured on plain opacities and the evaluation scales by itself. Opacities that were scaled by the
    mean of their noise are used as they are, for CA too.

    Args:
        ply: the model.
        background: colour behind it, shape (3,).
        dropout: the rate that the model was trained with, if the PLY does not say it.
        device: where to render.

    Raises:
        ValueError: if the PLY says another rate than ``dropout``, is damaged or holds no Gaussian, or the rate is not
            in [0, 1).
        FileNotFoundError: if the PLY is missing.
    """
    if not 0 <= dropout < 1:
        raise ValueError(f"--dropout is the rate of the training, in [0, 1); got {dropout:g}.")
    loaded = load_ply(ply)
    gaussians, baked = loaded.gaussians, round(1.0 - loaded.opacity_scale, 12)
    if not len(gaussians):
        raise ValueError(f"{ply} holds no Gaussian: there is nothing to score.")
    if baked > 0 and not loaded.for_rendering:
        if dropout not in (0.0, baked):
            raise ValueError(f"{ply} was trained with dropout {baked:g}, not {dropout:g}: leave out --dropout.")
        plain = (gaussians.opacities / loaded.opacity_scale).clamp(max=1 - 1e-6)
        gaussians, dropout = replace(gaussians, opacity_logits=inverse_sigmoid(plain)), baked
    bands = [degree for degree in range(gaussians.sh_degree + 1) if degree == 0 or _band(gaussians, degree).any()]
    facts = PlyFacts(
        len(gaussians), gaussians.sh_degree, bands[-1], loaded.opacity_scale, loaded.for_rendering, dropout
    )
    model = TrainedModel(
        gaussians=gaussians.to(device),
        background=background.to(device),
        dropout=dropout,
        opacity_scale=1.0 if loaded.for_rendering else 1.0 - dropout,
    )
    return model, facts


def score_ply(
    ply: Path,
    options: SceneOptions,
    out: Path | None = None,
    *,
    dropout: float = 0.0,
    samples: int = 5,
    seed: int = 0,
    perceptual: PerceptualMetric | None = None,
    device: str = "cpu",
    say: Say = print,
) -> Evaluation:
    """Measure the model of a PLY on the photographs of a scene; writes and prints what `measure` does.

    Args:
        ply: the model, in the frame of the scene's cameras.
        options: the scene.
        out: folder for the results; ``<ply>_evaluation`` by default.
        dropout: as of `of_ply`.
        samples: K of the CA score.
        seed: of its masks.
        perceptual: a perceptual metric.
        device: where to render.
        say: receives the progress, the table, and doubts whether the frames agree.

    Raises:
        ValueError: as `of_ply` and `check_frame`.
        FileNotFoundError: if the PLY or the scene is missing.
    """
    scene = options.load()
    model, facts = of_ply(ply, background=scene.background, dropout=dropout, device=device)
    say(f"{ply}: {facts}")
    for doubt in check_frame(model.gaussians, scene, ply):
        say(doubt)
    result = measure(
        model,
        scene,
        out or _folder(ply),
        samples=samples,
        seed=seed,
        perceptual=perceptual,
        about=asdict(facts),
        say=say,
    )
    if _worse_than_one_colour(result, scene):
        say(
            f"Every training view is further from its photograph than a picture of one colour would be: {ply} is not "
            f"in the frame of {scene.name}, or not a model of it. The PSNR says nothing, CA is that of these views."
        )
    return result


def score_ply_on_orbit(
    ply: Path,
    orbit: OrbitOptions,
    out: Path | None = None,
    *,
    background: str = "black",
    dropout: float = 0.0,
    samples: int = 5,
    seed: int = 0,
    device: str = "cpu",
    say: Say = print,
) -> CameraEvaluation:
    """Measure the model of a PLY without photographs; write ``evaluation.json``, ``evaluation.md`` and pictures.

    If it is interrupted, the same call continues with the next camera.

    Args:
        ply: the model, in any frame and of any size.
        orbit: the cameras.
        out: folder for the results; ``<ply>_evaluation`` by default.
        background: ``"black"`` or ``"white"``.
        dropout: as of `of_ply`.
        samples: K of the CA score.
        seed: of its masks.
        device: where to render.
        say: receives the table, and what became of an interrupted measurement.

    Raises:
        ValueError: as `of_ply` and `OrbitOptions.views`, or if there is no such background.
        FileNotFoundError: if the PLY is missing.
    """
    if background not in BACKGROUNDS:
        raise ValueError(f"background must be one of {', '.join(BACKGROUNDS)}, got {background!r}.")
    model, facts = of_ply(ply, background=torch.tensor(BACKGROUNDS[background]), dropout=dropout, device=device)
    say(f"{ply}: {facts}")
    sphere = bounding_sphere(model.gaussians.means, model.gaussians.opacities)
    if sphere.surroundings and orbit.arc > 180:
        say(
            "This is a place and not an object: an orbit shows it from sides that no photograph may have seen. Give "
            "its photographs (--path), or the side that was photographed (--arc 40)."
        )
    enlarged = max(1.0, SMALLEST_RADIUS / sphere.radius)
    model = replace(model, gaussians=_scaled(model.gaussians, enlarged))
    cameras = orbit.views(model.gaussians.means, model.gaussians.opacities)
    folder = out or _folder(ply)
    keep = folder / PARTIAL
    remove_leftovers(folder / VIEWS)
    with threads_for(orbit.size**2):
        result = evaluate_cameras(
            model, cameras, samples=samples, seed=seed, pictures=folder / VIEWS, keep=keep, progress=True, say=say
        )
        computed_on = machine()
    data = {
        "ply": asdict(facts),
        "orbit": asdict(orbit) | {"center": sphere.center.tolist(), "radius": sphere.radius, "enlarged": enlarged},
        **result.as_dict(),
        "ca_settings": asdict(model.ca_score(samples=samples, seed=seed).settings),
        "background": model.background.tolist(),
        "machine": computed_on,
    }
    write_json(folder / "evaluation.json", data)
    table = camera_table(result)
    write_text(folder / "evaluation.md", f"{facts}\n\n{table}")
    keep.unlink(missing_ok=True)
    say(table)
    say(
        "An orbit sees the model from where no photograph may have been taken: compare these scores with others from"
        " the same cameras alone; for those of the scene's own views give the scene (--scene FOLDER)."
    )
    say(f"Scores and pictures are in {folder}")
    return result


def camera_table(result: CameraEvaluation) -> str:
    """Return one row per camera and the mean, in Markdown; CA in units of 1e-3."""
    units = {
        "ca": 1e-3,
        "ca_std_error": 1e-3,
        "ca_exact": 1e-3,
        "ca_neutral": 1e-3,
        "cv": 1.0,
        "visible": 1.0,
        "covered": 1.0,
    }
    title = {name: name if unit == 1 else f"{name} x1e-3" for name, unit in units.items()}
    rows: list[dict[str, object]] = [
        {"view": view.name} | {title[q]: getattr(view, q) / unit for q, unit in units.items()} for view in result.views
    ]
    rows.append({"view": "mean"} | {title[q]: result.mean(q) / unit for q, unit in units.items()})
    return markdown_table(rows, ["view", *title.values()])


def _folder(ply: Path) -> Path:
    """Return the default folder for the results."""
    return ply.with_name(ply.stem + "_evaluation")


def _band(gaussians: Gaussians, degree: int) -> Tensor:
    """Return the coefficients of one band of spherical harmonics above 0."""
    return gaussians.sh_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1]


def _scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    """Return the model in a world that is larger by a factor; its pictures from larger orbits are the same."""
    return replace(
        gaussians, means=gaussians.means * factor, log_scales=gaussians.log_scales + torch.tensor(factor).log().item()
    )


def _worse_than_one_colour(result: Evaluation, scene: Scene) -> bool:
    """Whether no training view is nearer to its photograph than the photograph's mean colour is."""

    def of_mean(view: View) -> float:
        return psnr(view.image.mean((1, 2), keepdim=True).expand_as(view.image), view.image)

    limits = {view.name: of_mean(view) for view in scene.train}
    return bool(limits) and all(v.psnr < limits[v.name] for v in result.views if v.split == "train")
