"""Published methods, and the best known setting for few photographs, as data: settings, source, and what differs."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

from reference_trainer.training.config import TrainConfig

__all__ = ["RECIPES", "Recipe", "with_recipe", "with_steps"]


@dataclass(frozen=True)
class Recipe:
    """A method in the settings of this package; docs/recipes.md has more on each.

    Args:
        config: at the method's own number of iterations; loss and density by the names of their registries. Whole
            numbers from 100 on in these are steps, see `with_recipe`.
        source: paper, repository and commit, or what it is made of.
        differs: what differs from the original, and why.
        needs: what a scene must have beside photographs, cameras and points.
    """

    config: TrainConfig
    source: str
    differs: str
    needs: str = "nothing"


_INRIA = TrainConfig(
    iterations=30_000,
    sh_every=1_000,
    densify_until=15_000,
    densify_gradient=2e-4,
    prune_size=0.1,
    opacity_reset=0.01,
    opacity_reset_from=3_000,
    opacity_reset_over_white=True,
)
_CORGS = TrainConfig(
    iterations=10_000,
    models=2,
    random_background="on",
    opacity_reset_from=501,
    loss="photometric + co_regularization(between(1.0, 500))",
    density="co_pruning(5.0)",
)
_LOUDER = 1.2  # DNGaussian's L1 + 0.2 (1 - SSIM) over (1 - l) L1 + l (1 - SSIM) with l = 0.2 / 1.2

RECIPES: dict[str, Recipe] = {
    "3dgs": Recipe(
        TrainConfig(iterations=10_000),
        "3DGS (Kerbl et al. 2023) with the schedule that FSGS a536a64 and CoR-GS 1db13a4 have for few views",
        "as fsgs without depth and unpooling; the source of the paper's own row 3DGS is not public",
    ),
    "inria": Recipe(
        _INRIA,
        "3DGS (Kerbl et al. 2023), graphdeco-inria/gaussian-splatting 82bc469",
        "no pruning by pixels on the screen, which has no effect there",
    ),
    "fsgs": Recipe(
        TrainConfig(
            iterations=10_000,
            loss="photometric + pearson(between(0.05, 0, 9_500)) + pearson(between(0.001, 9_500))",
            density="proximity(until=2_000)",
        ),
        "FSGS (ECCV 2024), VITA-Group/FSGS a536a64",
        "no correlation at pseudo views, which needs its depth network in training; new Gaussians stand between "
        "neighbors, as in its paper",
        "a depth prior (--depth)",
    ),
    "dngaussian": Recipe(
        TrainConfig(
            iterations=6_000,
            sh_every=1_000,
            loss=f"photometric({0.2 / _LOUDER:.6f})"
            ' + patch_depth(0.01, which="hard") + patch_depth(between(0.01, 1_000), which="soft")'
            f" + flat({0.002 / _LOUDER:.6f}) + scale({0.001 / _LOUDER:.6f})"
            f" + opacity({0.001 / _LOUDER:.6f}, split=0.2)",
            means_rate=1.6e-2,
            means_rate_final=1.6e-4,
            scales_rate=3e-3,
            densify_gradient=1.3e-3 / _LOUDER,
            prune_opacity=0.01,
            opacity_reset_every=0,
        ),
        "DNGaussian (CVPR 2024) on LLFF, Fictionarry/DNGaussian 13ecf60",
        "spherical harmonics for neural colors; one loss with a depth weight of 0.01 for its three optimizer steps; no "
        "smoothness of the depth, no removal of near or unseen Gaussians, growth at any opacity",
        "a depth prior (--depth); there random points",
    ),
    "binocular": Recipe(
        TrainConfig(
            iterations=30_000,
            sh_degree=1,
            sh_every=1_000,
            loss="photometric + alpha(optional=True) + warp(between(1.0, 20_000))",
            densify_gradient=2e-4,
            opacity_reset_every=0,
            opacity_decay=0.995,
        ),
        "Binocular3DGS (NeurIPS 2024), hanl2010/Binocular3DGS 2b3b7a4",
        "each view once an epoch; over black DTU needs alpha(dark=0.118), a world in other units a shift of warp",
    ),
    "corgs": Recipe(
        _CORGS,
        "CoR-GS (ECCV 2024) on LLFF, jiaw-z/CoR-GS 1db13a4",
        "pseudo views between near and far of the initial points, drawn at each step; the models' splits are seeded "
        "apart",
        "initial points, cameras that look to one side, a world in LLFF's units",
    ),
    "segs": Recipe(
        dataclasses.replace(_CORGS, density="self_ensembling(start=2_000, stop=9_500)", means_rate_final=1.6e-4),
        "SE-GS (ICCV 2025) on LLFF, sailor-z/SE-GS 43668d7",
        "as corgs; what is uncertain is seen over the scene's background, Gaussians below 1/255 are not perturbed",
        "as corgs",
    ),
    "mvgs": Recipe(
        dataclasses.replace(_INRIA, loss="photometric + views(3)", density="ray_boxes"),
        "MVGS (2024), xiaobiaodu/MVGS ec9b30e, three views a step",
        "density control counts all views of a step, not the last alone; no coarse to fine",
    ),
    "absgs": Recipe(
        dataclasses.replace(_INRIA, density="absgrad"),
        "AbsGS (ACM MM 2024), TY424/AbsGS 87d7a5a",
        "no pruning by pixels on the screen, which has no effect there",
    ),
    "sparse": Recipe(
        TrainConfig(
            iterations=3_000,
            sh_every=150,
            densify_from=1_000,
            prune_size_from=900,
            opacity_reset_from=600,
            guard=3_000,
            dropout=0.2,
            opacity_decay=0.995,
            random_background="auto",
            loss="photometric + smooth_depth(between(0.1, 1000))",
        ),  # the schedule of 3dgs at 3,000 steps, but for the beginning of density control
        "no publication: 3dgs densified later, dropout (Chen et al. 2025), Binocular3DGS's opacity decay, CoR-GS's "
        "random background, Monodepth2's smoothness, our guard",
        "nothing; benchmarks/choices.md says how it was chosen",
    ),
    "distilled": Recipe(
        TrainConfig(
            iterations=300,
            means_rate=1.6e-5,
            densify_every=0,
            opacity_reset_every=0,
            guard=300,
            dropout=0.2,
            loss="photometric + distillation",  # refused until the models are named
        ),
        "no publication: a model of sparse trained on, to show what several of other seeds show in the mean",
        "nothing; benchmarks/setting.md says what it gains",
        "--init A.ply --loss \"photometric + distillation('A.ply', 'B.ply')\"",
    ),
}
"""All recipes, by the name that ``--recipe`` knows."""


def with_steps(expression: str, times: float) -> str:
    """Return an expression with its steps, the whole numbers from 100 on, multiplied and rounded.

    Example:
        >>> with_steps("d2gs(ramp(0.05, 0.3, 0, 10_000), neighbors=10)", 0.3)
        'd2gs(ramp(0.05, 0.3, 0, 3000), neighbors=10)'
    """
    if times == 1:
        return expression
    # Not within a name, such as my_loss200, nor after a decimal point, as in 0.125.
    return re.sub(r"(?<![\w.])[1-9][\d_]{2,}(?![\w.])", lambda at: str(round(times * int(at[0]))), expression)


_MARKS = "sh_every", "densify_from", "densify_until", "prune_size_from", "opacity_reset_from", "guard"


def with_recipe(name: str, **changes: object) -> TrainConfig:
    """Return the settings of a recipe with some fields changed.

    With other ``iterations`` the steps at which something begins or ends are scaled in proportion: ``sh_every``,
    ``densify_from``, ``densify_until``, ``prune_size_from``, ``opacity_reset_from``, ``guard``, and in loss and density
    the whole numbers from 100 on. Rates and the steps between two densifications or resets stay: the optimizer needs
    its time after either. ``changes`` are taken as they are.

    Args:
        name: a key of `RECIPES`.
        changes: fields of `TrainConfig`.

    Raises:
        ValueError: if there is no such recipe, or a value is out of range.

    Example:
        >>> short = with_recipe("binocular", iterations=3_000, sh_every=500)
        >>> short.loss, short.sh_every, short.densify_from
        ('photometric + alpha(optional=True) + warp(between(1.0, 2000))', 500, 50)
    """
    if name not in RECIPES:
        raise ValueError(f"there is no recipe {name!r}; choose one of {', '.join(RECIPES)}.")
    config = RECIPES[name].config
    # Through TrainConfig, which refuses a number of iterations that is none.
    times = TrainConfig(iterations=changes.get("iterations", config.iterations)).iterations / config.iterations  # type: ignore[arg-type]
    scaled: dict[str, object] = {
        # At least 1 for sh_every: 0 would mean all bands from the first step on, not soon.
        mark: max(int(mark == "sh_every"), round(times * at))
        for mark in _MARKS
        if (at := getattr(config, mark)) is not None
    }
    scaled |= {field: with_steps(getattr(config, field), times) for field in ("loss", "density")}
    return dataclasses.replace(config, **{**scaled, **changes})  # type: ignore[arg-type]
