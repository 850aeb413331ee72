"""Score any 3DGS PLY at the views of a scene, or from cameras on an orbit around it."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from ca_reg.regularizers import parse
from reference_trainer.evaluation.evaluate import Evaluation
from reference_trainer.evaluation.lpips import LPIPS
from reference_trainer.evaluation.metrics import counted, psnr
from reference_trainer.evaluation.pictures import file_names, is_own_png
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import load_ply
from reference_trainer.render.constants import MIN_ALPHA, NEAR_PLANE
from reference_trainer.runs.folder import VIEWS, check_trusted, folder_name
from reference_trainer.runs.guarded import log_what_hangs
from reference_trainer.runs.measure import measure
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.images import image_size
from reference_trainer.scenes.options import BACKGROUNDS, OrbitOptions, SceneOptions
from reference_trainer.scenes.scene import Scene, View, Viewpoint
from reference_trainer.scenes.virtual_cameras import bounding_sphere, measured_views, orbit_views

__all__ = [
    "ModelWithViews", "PlyFacts", "check_frame", "load_for_views", "load_plain_ply_model", "load_ply_model",
    "log_other_center", "log_other_frame", "scaled", "score_ply",
]  # fmt: skip

_log = logging.getLogger(__name__)

CLEARLY = 1.0
"""PSNR, dB, by which other cameras have to fit the training views better than their own."""
NEARLY_MIDDLE = 0.1
"""Pixels from the middle of the picture within which a principal point is taken to be there."""
SMALLEST_RADIUS = 0.25
"""Smaller models are enlarged to this radius: the renderer's near plane, at 0.2, would cut into them."""


@dataclass(frozen=True)
class PlyFacts:
    """What a PLY file says about its model."""

    gaussians: int  # number of Gaussians
    sh_degree: int  # of the coefficients in the file
    sh_degree_used: int  # highest band with a nonzero coefficient
    opacity_scale: float  # the factor baked into the stored opacities, 1 if none is
    for_rendering: bool  # whether they are test-time opacities from which the plain ones cannot be recovered
    regularizer: str  # what the model was trained with, from the file or the caller

    def __str__(self) -> str:
        used = "" if self.sh_degree_used == self.sh_degree else f" (bands above {self.sh_degree_used} are zero)"
        opacities = "plain, as far as the file says"
        if self.for_rendering:
            opacities = "those of the test, used as they are, for CA too"
        elif self.opacity_scale < 1:
            opacities = f"{self.opacity_scale:g} baked in, taken out for CA"
        return (
            f"{self.gaussians:,} Gaussians, SH degree {self.sh_degree}{used}; opacities: {opacities}; trained with: "
            f"{self.regularizer or 'no regularizer, as far as is known'}"
        )


def load_ply_model(
    ply: Path,
    *,
    background: Tensor,
    regularizer: str | None = None,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> tuple[TrainedModel, PlyFacts]:
    """Return the model of a standard 3DGS PLY over a background (3,), and what the file says about it.

    A PLY of this package records the regularizers of the training, which decide the test-time opacities, and whether
    its opacities are scaled by 1 - p already: that is undone, because CA is measured on plain opacities and the
    evaluation does its own scaling. Test-time opacities of any other kind are used as they are, for CA too.
    ``regularizer`` overrides what the PLY says; ``trust`` names modules that its comments may import, as for
    `load_run`.

    Raises:
        ValueError: if the PLY is damaged or holds no Gaussian, was scaled for another rate than ``regularizer`` says,
            or names unknown regularizers.
        FileNotFoundError: if the PLY is missing.
    """
    loaded = load_ply(ply)
    gaussians, baked = loaded.gaussians, round(1.0 - loaded.opacity_scale, 12)
    if not len(gaussians):
        raise ValueError(f"{ply} holds no Gaussian: there is nothing to score.")
    text = regularizer
    if text is None:
        text = loaded.regularizer
        check_trusted(ply, text, trust)
        try:
            parse(text, imports=bool(trust))
        except ValueError as error:
            raise ValueError(f"{ply} says what it was trained with: {error} Give --regularizer.") from error
    if baked > 0 and not loaded.for_rendering:
        gaussians = replace(
            gaussians, opacity_logits=torch.logit((gaussians.opacities / loaded.opacity_scale).clamp(max=1 - 1e-6))
        )
        text = text or f"dropout({baked})"
    degrees = range(1, gaussians.sh_degree + 1)
    used = max((d for d in degrees if gaussians.sh_rest[:, d**2 - 1 : (d + 1) ** 2 - 1].any()), default=0)
    facts = PlyFacts(len(gaussians), gaussians.sh_degree, used, loaded.opacity_scale, loaded.for_rendering, text)
    model = TrainedModel(
        gaussians.to(device), background.to(device), text, loaded.step, for_rendering=loaded.for_rendering
    )
    if baked > 0 and not loaded.for_rendering and not math.isclose(model.dropout, baked, rel_tol=1e-6):
        raise ValueError(f"{ply} was scaled for dropout {baked:g}, not for {text}: leave out --regularizer.")
    return model, facts


def load_plain_ply_model(
    ply: Path, *, regularizer: str | None = None, device: str = "cpu", trust: Collection[str] = ()
) -> tuple[TrainedModel, PlyFacts]:
    """Do as `load_ply_model` over black, with a ValueError unless the opacities are plain."""
    model, facts = load_ply_model(ply, background=torch.zeros(3), regularizer=regularizer, device=device, trust=trust)
    if facts.for_rendering or facts.opacity_scale != 1:
        by = "those of the test" if facts.for_rendering else f"scaled by {facts.opacity_scale:g}"
        raise ValueError(f"the opacities of {ply} are {by} already: give the PLY with plain ones.")
    return model, facts


@dataclass(frozen=True)
class ModelWithViews:
    """A model and the views that it is measured at."""

    model: TrainedModel  # enlarged if it is tiny and there is no scene
    enlarged: float  # the factor by which it is enlarged
    views: Mapping[str, Sequence[Viewpoint]]  # by split; ``"orbit"`` without a scene
    scene: Scene | None  # None for an orbit
    about: dict[str, object]  # entries about all this for a file of results

    def beside(self, first: ModelWithViews) -> ModelWithViews:
        """Return it as it stands beside another one, with the same cameras: at the size of that.

        Without a scene of its own, its views and its background are those of the other one, too.
        """
        if self.scene is not None and self.enlarged == first.enlarged:
            return self
        background = (first if self.scene is None else self).model.background
        gaussians = scaled(self.model.gaussians, first.enlarged / self.enlarged)
        model = replace(self.model, gaussians=gaussians, background=background)
        return replace(self, model=model, enlarged=first.enlarged, views=first.views)


def load_for_views(
    ply: Path,
    where: SceneOptions | OrbitOptions,
    *,
    background: str = "auto",
    regularizer: str | None = None,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> ModelWithViews:
    """Load the model of a PLY and the views of a scene, or cameras on an orbit; arguments and errors of `score_ply`."""
    scene = load_scene(where, trains=False) if isinstance(where, SceneOptions) else None
    if scene is None and background not in ("auto", *BACKGROUNDS):
        raise ValueError(f"background must be one of {', '.join(BACKGROUNDS)}, got {background!r}.")
    color = torch.tensor(BACKGROUNDS.get(background, BACKGROUNDS["black"])) if scene is None else scene.background
    model, facts = load_ply_model(ply, background=color, regularizer=regularizer, device=device, trust=trust)
    _log.info(f"{ply}: {facts}")
    about: dict[str, object] = {"ply": asdict(facts)}
    if isinstance(where, OrbitOptions):
        return _on_orbit(model, where, about)
    assert scene is not None
    for doubt in check_frame(model.gaussians, scene, ply):
        _log.info(doubt)
    _log_other_size(ply, scene)
    return ModelWithViews(model, 1.0, measured_views(scene), scene, about | {"scene": scene.name})


def score_ply(
    ply: Path,
    where: SceneOptions | OrbitOptions,
    out: Path | None = None,
    *,
    background: str = "auto",
    regularizer: str | None = None,
    samples: int = 5,
    seed: int = 0,
    perceptual: LPIPS | None = None,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> Evaluation:
    """Measure the model of a PLY at the views of a scene or on an orbit; writes and prints what `measure` does.

    For a scene the model is in the frame of its cameras, for an orbit in any frame and of any size; an orbit has a
    background, ``"black"`` (the default) or ``"white"``, a scene its own. Results go to ``out``, by default to
    ``<ply>_evaluation``, with ``_orbit`` and the regularizer behind it if they are given. ``regularizer`` and
    ``trust`` are as in `load_ply_model`, ``samples``, ``seed`` and ``perceptual`` as in `evaluate`.

    Raises:
        ValueError: from `load_ply_model`, `check_frame` or `orbit_views`, or if the background is unknown.
        FileNotFoundError: if the PLY or the scene is missing.
    """
    loaded = load_for_views(ply, where, background=background, regularizer=regularizer, device=device, trust=trust)
    scene = loaded.scene
    # Folders of their own, or the scores at other views or of another regularizer would take each other's place.
    kind = ["orbit"] * (scene is None) + [folder_name(x) for x in (regularizer,) if x is not None]
    folder = out or ply.with_name("_".join([ply.stem, "evaluation", *kind]))
    result = measure(
        loaded.model, loaded.views, folder, about=loaded.about, samples=samples, seed=seed, perceptual=perceptual
    )
    log_what_hangs(loaded.model, scene, folder)
    if scene is None:
        _log.info(
            "An orbit sees the model from where no photograph may have been taken: compare these scores with others "
            "from the same cameras alone; for those of the scene's own views give the scene (--scene FOLDER)."
        )
    else:
        log_other_frame(result, scene, ply)
        log_other_center(loaded.model, scene, ply)
    return result


def _on_orbit(model: TrainedModel, orbit: OrbitOptions, about: dict[str, object]) -> ModelWithViews:
    """Return the model, enlarged if it is tiny, and the viewpoints around it."""
    sphere = bounding_sphere(model.gaussians.means, model.gaussians.opacities)
    if sphere.surroundings and orbit.arc > 180:
        _log.info(
            "This is a place and not an object: an orbit shows it from sides that no photograph may have seen. Give "
            "its photographs (--scene), or the side that was photographed (--arc 40)."
        )
    enlarged = max(1.0, SMALLEST_RADIUS / sphere.radius)
    model = replace(model, gaussians=scaled(model.gaussians, enlarged))
    cameras = orbit_views(
        model.gaussians.means,
        model.gaussians.opacities,
        count=orbit.cameras,
        width=orbit.size,
        height=orbit.size,
        fill=0.8,  # so that what lies outside the bounding sphere, such as a plant's highest leaf, shows too
        world=orbit.world,
        arc=math.radians(orbit.arc),
    )
    views = [Viewpoint(f"{index:03d}", camera) for index, camera in enumerate(cameras)]
    found = {"center": sphere.center.tolist(), "radius": sphere.radius, "enlarged": enlarged}
    return ModelWithViews(model, enlarged, {"orbit": views}, None, about | {"orbit": asdict(orbit) | found})


def scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    """Return the model scaled by a factor about the origin; pictures from cameras scaled alike are the same."""
    return replace(
        gaussians, means=gaussians.means * factor, log_scales=gaussians.log_scales + torch.tensor(factor).log().item()
    )


def log_other_frame(result: Evaluation, scene: Scene, ply: Path) -> None:
    """Log it if at every training view one color, the mean of the pixels that count, fits better than the model."""

    def of_mean(view: View) -> float:
        pixels = counted(view.image, view.mask)[:, None]
        return psnr(pixels.mean(2, keepdim=True).expand_as(pixels), pixels)

    limits = {view.name: of_mean(view) for view in scene.train}
    if limits and all(v.psnr < limits[v.name] for v in result.views if v.split == "train"):
        _log.info(
            f"Every training view is further from its photograph than a picture of one color would be: {ply} is not "
            f"in the frame of {scene.name}, or not a model of it. The PSNR says nothing, CA is that of these views."
        )


def log_other_center(model: TrainedModel, scene: Scene, ply: Path) -> None:
    """Log it if the model fits the training views better through the middle of the picture than through their centers.

    That is where the INRIA code takes every principal point to be.
    """
    gains = list[float]()
    for view in (view.to(model.background.device) for view in scene.train):
        camera = view.camera
        middle = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
        if math.dist((camera.cx, camera.cy), (middle.cx, middle.cy)) < NEARLY_MIDDLE:
            return
        images = (model.test_rendering(replace(view, camera=each)).image.clamp(0, 1) for each in (camera, middle))
        own, other = (psnr(image, view.image, view.mask) for image in images)
        gains.append(other - own)
    if gains and min(gains) > 0 and fmean(gains) > CLEARLY:
        _log.info(
            f"The training views fit {fmean(gains):.1f} dB better through the middle of the picture than through the "
            f"principal points of {scene.name}: {ply} is of a trainer that takes no notice of them, as INRIA's, and "
            "every view is measured beside its place. To measure it as it was trained, set cx and cy of the cameras to "
            "half the width and height; to train it right, crop the photographs around their principal points."
        )


def _log_other_size(ply: Path, scene: Scene) -> None:
    """Log it if the PLY lies in a run whose training views were larger or smaller than those of the scene."""
    for view, name in zip(scene.train, file_names([view.name for view in scene.train]), strict=True):
        file = ply.parent / VIEWS / "train" / f"{name}.png"
        if file.is_file() and is_own_png(file):
            (width, height), camera = image_size(file), view.camera
            if (width, height) != (camera.width, camera.height):
                _log.info(
                    f"{ply} was trained at {width}x{height}, the size of its pictures in {file.parent}, and is "
                    f"measured at {camera.width}x{camera.height}: its own scores are no comparison. --downscale gives "
                    "its size."
                )
            return


NEARLY_NONE = 0.01
"""Fraction of the Gaussians below which a camera counts as blind to a model: stray ones may be anywhere."""


def check_frame(gaussians: Gaussians, scene: Scene, name: str | Path) -> list[str]:
    """Count, before anything is rendered, the Gaussians that the cameras of a scene, of both splits, see.

    A Gaussian counts if its center is beyond the near plane (0.2) and inside the picture, and its opacity is at least
    1/255: fainter ones are never rendered. Returns doubts for people: a line about the cameras that see less than 1 %
    of the model, which messages call ``name``; nothing if all see more.

    Raises:
        ValueError: if no Gaussian can be rendered, or all cameras together see less than 1 %.
    """
    visible = gaussians[gaussians.opacities >= MIN_ALPHA]
    count, means = len(visible), visible.means
    if not count:
        raise ValueError(
            f"{name}: none of the {len(gaussians):,} Gaussians has an opacity of 1/255, all are invisible."
        )
    views = [*scene.train, *scene.test]
    before = torch.stack([view.camera.project(means)[1] >= NEAR_PLANE for view in views])
    inside = torch.stack([view.camera.inside(*view.camera.project(means)) for view in views]) & before
    seen = int(inside.any(0).sum())
    if seen < NEARLY_NONE * count:
        behind_all = int((~before).all(0).sum())
        center = means.double().median(0).values
        reach = (means - center).norm(dim=1).kthvalue(-(-98 * count // 100)).values  # without stray ones
        rig = torch.stack([view.camera.position for view in views]).double()
        forward = torch.stack([view.camera.forward for view in views]).double().mean(0)
        raise ValueError(
            f"the cameras of {scene.name} do not see {name}: of {count:,} Gaussians, {seen:,} ({seen / count:.2%}) are "
            f"in any of the {len(views)} pictures, {behind_all:,} are behind all cameras. The model lies around "
            f"{_text(center)} within {reach:.3g}; the cameras stand around {_text(rig.mean(0))} within "
            f"{(rig - rig.mean(0)).norm(dim=1).max():.3g} and look towards {_text(forward)} on average. Both must be "
            "in one frame: give the files that the model was trained with (see --format: COLMAP, LLFF and Blender "
            "files of one scene may differ in their frame), or leave out the scene for cameras on an orbit."
        )
    blind = [view.name for view, n in zip(views, inside.sum(1).tolist(), strict=True) if n < NEARLY_NONE * count]
    if not blind:
        return []
    return [f"{len(blind)} of {len(views)} cameras see less than {NEARLY_NONE:.0%} of {name}: {', '.join(blind)}."]


def _text(point: Tensor) -> str:
    """Return a point for a message."""
    return f"({', '.join(f'{x:.3g}' for x in point.tolist())})"
