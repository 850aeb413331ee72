"""The rules of the plan, each about one thing that training could use; docs/performance.md says what each is worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from reference_trainer.scenes.dense import ENOUGH, SOURCE, source_views
from reference_trainer.scenes.exposure import difference, exposures
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.assembly import draws_background, make_density, make_losses, make_regularizer
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import Photometric
from reference_trainer.training.losses.depth import Warp
from reference_trainer.training.losses.penalties import Alpha
from reference_trainer.training.model_state import initial_gaussians, seen_by_any

__all__ = ["DROPOUT_GAINS", "FAR_APART_GAINS", "RULES", "PlanItem"]


@dataclass(frozen=True)
class PlanItem:
    """The decision on one thing that training could use; as a rule returns it, what the plan alone would do.

    Args:
        name: what it is about.
        decision: whether training uses it, uses less of it, leaves it out, or leaves it out although it is recommended.
        reason: why, with the numbers seen in the scene.
        changes: fields of `TrainConfig` that carry the decision out; empty where nothing has to change.
    """

    name: str
    decision: Literal["used", "reduced", "left out", "recommended"]
    reason: str
    changes: Mapping[str, Any] = field(default_factory=dict)


def sh_bands(scene: Scene, config: TrainConfig) -> PlanItem:
    """Bands of spherical harmonics: those that begin after the last step would stay 0.

    Lower degrees for few views save time, but were not shown to be as good.
    """
    name = "SH bands"
    if config.sh_degree == 0:
        return PlanItem(name, "left out", "asked for (sh_degree=0)")
    if scene.start is not None:
        reason = f"all from the first step on: training starts from degree {scene.start.sh_degree}"
        return PlanItem(name, "used", reason)
    reached = config.sh_degree_at(config.iterations)
    if reached < config.sh_degree:
        reason = f"bands above degree {reached} would begin after the last step, {config.iterations}, and stay 0"
        return PlanItem(name, "reduced" if reached else "left out", reason, {"sh_degree": reached})
    positions, cameras = scene.points.positions, [view.camera for view in scene.train]
    seen = int(torch.stack([camera.inside(*camera.project(positions)) for camera in cameras]).sum(0).median())
    sees = f"the median point is seen by {seen} of {len(scene.train)} training views"
    return PlanItem(name, "used", f"{sees}; lower degrees are not known to end as well")


def alpha_masks(scene: Scene, config: TrainConfig) -> PlanItem:
    """Alpha masks: the pictures lie on the background already, but a warp fills what is transparent with fog."""
    masks = [view.alpha for view in scene.train if view.alpha is not None]
    if not masks:
        return PlanItem("alpha masks", "left out", "by construction: no training picture has one")
    losses = make_losses(config)
    if any(isinstance(term, Alpha) and term.dark is None for term in losses):
        return PlanItem("alpha masks", "used", "asked for: Alpha compares with them")
    if draws_background(config, scene):
        return PlanItem("alpha masks", "used", "asked for (random_background): the pictures lie over it")
    if any(isinstance(term, Warp) for term in losses):
        reason = "Warp agrees with fog where pictures are transparent (lego: 20 in place of 24 dB): add alpha to loss"
        return PlanItem("alpha masks", "recommended", reason)
    empty = sum(float((alpha == 0).float().mean()) for alpha in masks) / len(masks)
    reason = f"by construction: the pictures, {empty:.0%} of them empty, lie on the background already"
    return PlanItem("alpha masks", "left out", reason)


def background(scene: Scene, config: TrainConfig) -> PlanItem:
    """The background is added behind the Gaussians, whatever its color: it costs next to nothing."""
    if draws_background(config, scene):
        why = "the photographs do not show it" if config.random_background == "auto" else "asked for"
        return PlanItem("background", "used", f"a color drawn anew at each step (random_background): {why}")
    color = ", ".join(f"{value:g}" for value in scene.background.tolist())
    shown = ", which photographs show" if config.random_background == "auto" else ""
    return PlanItem("background", "used", f"({color}) behind everything{shown}; adding it takes less than 1% of a step")


def depth_output(scene: Scene, config: TrainConfig) -> PlanItem:
    """Depth is rendered only if a term of the loss needs it."""
    if asking := _terms_that_need("depth", config):
        return PlanItem("depth output", "used", f"asked for: {asking} looks at it")
    return PlanItem("depth output", "left out", "by construction: no term of the loss looks at depth")


def _terms_that_need(what: str, config: TrainConfig) -> str:
    """Return the names of the terms of the loss that need something of the renderer, empty if none does."""
    return ", ".join(dict.fromkeys(type(term).__name__ for term in make_losses(config) if what in term.needs))


def distortion(scene: Scene, config: TrainConfig) -> PlanItem:
    """Cameras are pinholes once they are loaded."""
    reason = "by construction: cameras are pinholes; the loader undoes it and says how far it goes"
    return PlanItem("lens distortion", "left out", reason)


def densification(scene: Scene, config: TrainConfig) -> PlanItem:
    """Clones and splits."""
    name, points = "densification", scene.points
    until, every = config.densify_end, config.densify_every
    if every == 0:
        return PlanItem(name, "left out", "asked for (densify_every=0)")
    first = (config.densify_from // every + 1) * every  # the schedule counts from step 0
    if first >= until:
        return PlanItem(name, "left out", f"by construction: the first would be at step {first} of {until}")
    pixels = sum(view.camera.width * view.camera.height for view in scene.train) / len(scene.train)
    reason = f"{len(points.positions)} initial points are {len(points.positions) / pixels:.2f} per pixel of a view"
    reason += f"; detail comes from clones and splits, from step {first} of {config.iterations} on"
    return PlanItem(name, "used", reason)


def opacity_reset(scene: Scene, config: TrainConfig) -> PlanItem:
    """Lowering all opacities."""
    name, first = "opacity reset", config.opacity_reset_from
    if config.opacity_reset_over_white and scene.is_white and config.densify_from > 0:
        first = min(first, config.densify_from)
    until = config.densify_end
    if not make_density(config).resets:
        return PlanItem(name, "left out", f"by construction: density control by {config.density} has none")
    if config.opacity_reset_every == 0:
        return PlanItem(name, "left out", "asked for (opacity_reset_every=0)")
    if first >= until:
        return PlanItem(name, "left out", f"by construction: the first would be at step {first} of {until}")
    return PlanItem(name, "used", f"first at step {first} of {config.iterations}")


def dropout(scene: Scene, config: TrainConfig) -> PlanItem:
    """Dropout is never switched on unasked: comparisons need a training without it. It is recommended where it paid."""
    count, apart = len(scene.train), _degrees_apart(scene)
    views = f"{count} views, {apart:.0f} degrees apart" if count > 1 else "1 view"
    far = count > 1 and apart > FAR_APART
    if far:
        gains, where = [*FAR_APART_GAINS.values()], f"where views were further than {FAR_APART} degrees apart"
    else:
        # Nearest in ratio: 2 and 3 views differ more than 24 and 25.
        nearest = min(DROPOUT_GAINS, key=lambda n: abs(math.log(n / count)))
        gains, where = [*DROPOUT_GAINS[nearest].values()], f"with {nearest} views"
    # Far apart, dropout alone gained little: there the whole setting is recommended, up to as many views as it was
    # measured with.
    pays = count <= FEW if far else sorted(gains)[len(gains) // 2] >= WORTH
    reason = f"{views}; {where} dropout changed PSNR by {_range(gains)} (means of 3 seeds or more)"
    if pays:
        of_scenes = SPARSE_GAINS_FAR_APART if far else SPARSE_GAINS
        ends = [end for ends in of_scenes.values() for end in ends]
        reason += f"; the whole setting by {_range(ends)} (dense start, single trainings of {len(of_scenes)} scenes)"
        if config.opacity_decay == 1 or not make_regularizer(config).drops:
            reason += ": use --recipe sparse"
    if make_regularizer(config).drops:
        return PlanItem("dropout", "used", f"asked for; {reason}")
    return PlanItem("dropout", "recommended" if pays else "left out", f"not asked for; {reason}")


def _range(gains: Sequence[float]) -> str:
    """Return the least and the largest of some gains, losses included."""
    return f"{min(gains):+.1f} to {max(gains):+.1f} dB"


def dropped(scene: Scene, config: TrainConfig) -> PlanItem:
    """Dropped Gaussians."""
    masks = make_regularizer(config).drops and not config.analytic
    reason = "what a mask drops is neither projected nor sorted in the step" if masks else "training draws no masks"
    return PlanItem("dropped Gaussians", "left out", f"by construction: {reason}")


def guarding(scene: Scene, config: TrainConfig) -> PlanItem:
    """The guard against what hangs where nobody took a photograph."""
    if not config.regularizers:
        reason = "by construction: without dropout or noise the Gaussians of a model need each other"
        return PlanItem("guard", "left out", reason)
    if len(scene.train) < 2:
        return PlanItem("guard", "left out", "by construction: no camera is between or beyond a single training view")
    if not config.guard:
        return PlanItem("guard", "left out", "not asked for: --guard 500 removes what hangs where no camera was")
    return PlanItem("guard", "used", f"asked for (guard={config.guard})")


def regularizer_inputs(scene: Scene, config: TrainConfig) -> PlanItem:
    """What the regularizers need besides the opacities."""
    if needed := ", ".join(make_regularizer(config).needs):
        return PlanItem("inputs of the regularizers", "used", f"asked for: they need {needed}")
    reason = "by construction: they look at opacities alone, so neither neighbors nor depths are computed"
    return PlanItem("inputs of the regularizers", "left out", reason)


def unseen(scene: Scene, config: TrainConfig, device: torch.device | str = "cpu") -> PlanItem:
    """Initial Gaussians that have no pixel in a training view: they would stay as they are and fog the test views."""
    name = "Gaussians outside every view"
    if scene.start is not None:
        return PlanItem(name, "used", "by construction: training goes on from a model, with all that it has")
    start = initial_gaussians(scene, replace(config, initial_points="all"))
    outside = len(start) - int(seen_by_any(start, scene.train, device).sum())
    counts = f"{outside} of {len(start)} initial Gaussians have no pixel in a training view"
    if outside == 0:
        return PlanItem(name, "left out", f"by construction: {counts}")
    return PlanItem(name, "left out", f"{counts}: no photograph tells of them", {"initial_points": "seen"})


def saturated(scene: Scene, config: TrainConfig) -> PlanItem:
    """White pixels, where the photograph is saturated."""
    share = sum(float((view.image >= 1).all(0).float().mean()) for view in scene.train) / len(scene.train)
    reason = f"{share:.1%} of the pixels are white; without them nothing would tell how bright these places are"
    return PlanItem("saturated pixels", "used", reason)


def ssim_windows(scene: Scene, config: TrainConfig) -> PlanItem:
    """Parts of the picture where photograph and background are the same."""
    color = scene.background[:, None, None]
    busy = [(view.image != color).any(0) for view in scene.train]
    share = sum(float(part.any(1).float().mean() * part.any(0).float().mean()) for part in busy) / len(busy)
    if not any(isinstance(term, Photometric) and term.lambda_dssim > 0 for term in make_losses(config)):
        return PlanItem("SSIM windows without change", "left out", "by construction: the loss has no SSIM")
    reason = f"the box around what differs from the background is {share:.0%} of a picture"
    return PlanItem("SSIM windows without change", "used", f"{reason}; cutting it out gains nothing")


def moments(scene: Scene, config: TrainConfig) -> PlanItem:
    """Exact mean and variance over masks."""
    if config.analytic:
        return PlanItem("moments", "used", "asked for (analytic): every step trains on the expectation")
    if asking := _terms_that_need("moments", config):
        return PlanItem("moments", "used", f"asked for: {asking} renders them")
    return PlanItem("moments", "left out", "by construction: a step needs none; the monitor measures at its own steps")


def initial_size(scene: Scene, config: TrainConfig) -> PlanItem:
    """The size of initial points. Distances between random points say nothing about a surface: Gaussians pile up."""
    name, points = "size of initial points", scene.points
    count = len(points.positions)
    if scene.start is not None:
        return PlanItem(name, "used", f"by construction: {count} Gaussians have sizes of their own")
    if points.source != "random":
        size = f"as wide as {config.initial_scale:g} x the distance to their neighbors"
        return PlanItem(name, "used", f"{count} measured points, {size}")
    reason = f"{count} random points as wide as the distance to their neighbors would pile up; half as wide is as good"
    return PlanItem(name, "reduced", reason, {"initial_scale": 0.5})


def dense_start(scene: Scene, config: TrainConfig) -> PlanItem:
    """Points measured by stereo. It is decided when the scene is loaded: the plan can only tell of them."""
    name, count, number = "dense start", len(scene.train), len(scene.points.positions)
    if scene.start is not None:
        return PlanItem(name, "left out", "by construction: training starts from a model")
    if scene.points.source == SOURCE:
        return PlanItem(name, "used", f"{number} points, those measured on the training photographs among them")
    if scene.points.source != "random" and number >= ENOUGH:
        return PlanItem(name, "left out", f"{number} measured points are enough")
    cameras, matched = [view.camera for view in scene.train], 0
    for i, camera in enumerate(cameras):
        seen = camera.depths_of(scene.points.positions)
        matched += len(seen) > 0 and bool(source_views(cameras, i, float(seen.median())))
    overlap = f"{matched} of {count} training views see the same as another one from 0.5 to 60 degrees apart"
    if matched < 2:
        return PlanItem(name, "left out", f"{overlap}, too few to measure points on")
    gains = ", ".join(f"{gain:+.1f} on {scene}" for scene, gain in DENSE_GAINS.items())
    return PlanItem(name, "left out", f"{overlap}: --points dense adds measured points, which gained {gains} dB")


def one_exposure(scene: Scene, config: TrainConfig) -> PlanItem:
    """Photographs made equally bright. It is decided when the scene is loaded: the plan can only tell of them."""
    name = "one exposure"
    if any(view.exposure is not None for view in scene.train):
        return PlanItem(name, "used", "one photograph is brighter than another, which the run undoes")
    if len(scene.train) > FEW:  # the time goes by the pairs
        return PlanItem(name, "left out", f"not looked for among more than {FEW} photographs")
    factors = exposures(scene.train, scene.points.positions)
    if factors is None:
        return PlanItem(name, "left out", "no photograph is brighter than another by more than shading")
    gains = ", ".join(f"{gain:+.1f} dB on {scene}" for scene, gain in ONE_EXPOSURE_GAINS.items())
    return PlanItem(name, "left out", f"{difference(factors)}: --one-exposure undoes that, which gained {gains}")


DENSE_GAINS = {"fern": 1.9, "herz-jesu": 1.0, "fountain": 0.7, "sceaux": 0.4, "cape": 0.3}
"""What a dense start added to COLMAP's points of the same photographs gained, dB: benchmarks/dense_start.md."""
ONE_EXPOSURE_GAINS = {"herz-jesu": 0.0, "sceaux": 0.5}
"""What one exposure gained there, dB, in the mean of six trainings: benchmarks/choices.md."""
_BUILT_IN = "the built-in scene"
DROPOUT_GAINS = {
    2: {("fern", 0.2): 1.4, (_BUILT_IN, 0.1): 1.7, (_BUILT_IN, 0.2): 1.7},
    3: {("cape", 0.2): 1.2, ("fern", 0.2): 1.1, ("fountain", 0.2): 1.2, ("herz-jesu", 0.1): 1.3,
        ("herz-jesu", 0.2): 1.5, ("sceaux", 0.2): 0.5, (_BUILT_IN, 0.1): 1.8, (_BUILT_IN, 0.2): 1.5},
    6: {("fern", 0.2): 0.4, (_BUILT_IN, 0.1): 0.6, (_BUILT_IN, 0.2): 0.3},
    9: {("fern", 0.2): 0.0, (_BUILT_IN, 0.1): 0.1, (_BUILT_IN, 0.2): 0.3},
    17: {("fern", 0.2): -0.2, (_BUILT_IN, 0.1): -0.1, (_BUILT_IN, 0.2): -0.3},
    24: {(_BUILT_IN, 0.1): -0.1, (_BUILT_IN, 0.2): -0.2},
    48: {(_BUILT_IN, 0.1): -0.1, (_BUILT_IN, 0.2): -0.3},
}  # fmt: skip
"""What dropout changed PSNR by, in dB, by the number of views, the scene and the rate: means of three seeds or
more, from the rows that docs/results.md shows."""
WORTH = 0.2
"""What dropout must have gained in half of the trainings with about as many views to be recommended, dB."""
FAR_APART, FEW = 25, 9
"""Degrees between a view and the nearest other one beyond which dropout alone gained little, and the number of such
views up to which the whole setting was measured."""
FAR_APART_GAINS = {("DTU scan24", 0.2): 0.4, ("DTU scan65", 0.2): -0.1, ("lego", 0.2): 0.3}
"""What dropout gained there, with 3, 3 and 8 views."""
SPARSE_GAINS = {
    "cape": (2.0, 2.6), "fern": (1.5, 2.0), "fountain": (0.9, 1.7), "herz-jesu": (0.8, 2.2), "sceaux": (-0.7, 1.6),
    _BUILT_IN: (1.7, 3.0),
}  # fmt: skip
"""What ``--recipe sparse``, with one exposure or without, changed PSNR by against a plain training, with 3 views: the
least and the largest difference of two trainings with one seed and one dense start (of the built-in scene its own
points), dB, from benchmarks/setting.md."""
SPARSE_GAINS_FAR_APART = {"DTU scan24": (1.4, 1.6), "DTU scan65": (0.6, 1.2), "lego": (0.8, 0.9)}
"""The same where views are far apart, with 3, 3 and 8 views."""

RULES: tuple[Callable[[Scene, TrainConfig], PlanItem], ...] = (
    sh_bands, alpha_masks, background, depth_output, distortion, densification, opacity_reset, dropout, dropped,
    guarding, regularizer_inputs, initial_size, unseen, saturated, ssim_windows, moments, dense_start,
    one_exposure,
)  # fmt: skip
"""All rules, in the order of the table; each is given the settings with what those before it have changed."""


def _degrees_apart(scene: Scene) -> float:
    """The median over the training views of the angle to the nearest other one, seen from the middle of the points."""
    middle = scene.points.positions.median(0).values
    to = torch.nn.functional.normalize(torch.stack([view.camera.position for view in scene.train]) - middle, dim=1)
    # The diagonal, each view with itself, must not be the nearest.
    return float((to @ to.T).fill_diagonal_(-1.0).amax(1).clamp(-1, 1).arccos().rad2deg().median())
