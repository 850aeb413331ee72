"""Several runs of one scene, of other seeds and kinds, distilled into one model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from reference_trainer.runs.folder import CONFIG, PLY, read_run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES, with_recipe, with_steps

__all__ = ["distilled", "member_settings"]

_THREE: tuple[dict[str, Any], ...] = (
    {},
    {"means_rate": 4e-5, "means_rate_final": 4e-7},
    {"loss": "photometric + alpha(optional=True) + warp(between(1.0, 2_000), shift=0.15, relative=True, hidden=0.02)"},
)
"""What three members change, at the steps of ``sparse``: models of one kind share what is wrong with their kind."""


def member_settings(config: TrainConfig, number: int, of: int) -> TrainConfig:
    """Return the settings of a member from those of the first, number 0, of ``sparse``.

    The first learns from the others, which have seeds of their own and half of its steps; three have other settings as
    well. benchmarks/choices.md chose both.

    Example:
        >>> first = with_recipe("sparse", iterations=3_000)
        >>> second, third = (member_settings(first, number, of=3) for number in (1, 2))
        >>> second.seed, second.iterations, second.means_rate, third.loss.partition("shift")[0]
        (1, 1500, 4e-05, 'photometric + alpha(optional=True) + warp(between(1.0, 1000), ')
    """
    if number == 0:
        return config
    changes, steps = dict(_THREE[number]) if of == len(_THREE) else {}, config.iterations // 2
    if loss := changes.get("loss"):
        changes["loss"] = with_steps(loss, steps / RECIPES["sparse"].config.iterations)
    return with_recipe("sparse", iterations=steps, seed=config.seed + number, **changes)


def distilled(members: Sequence[Path]) -> tuple[SceneOptions, TrainConfig]:
    """Return scene and settings of a training in which the first of several runs learns what all show in the mean.

    The runs are finished, with dropout and noise at the rates of the first as their only regularizers: a schedule
    would begin anew. Raises what `read_run_settings` raises.
    """
    options, first = read_run_settings(members[0] / CONFIG)
    paths = [(member / PLY).resolve().as_posix() for member in members]
    config = with_recipe(
        "distilled",
        seed=first.seed,
        dropout=first.dropout,
        noise=first.noise,
        random_background=first.random_background,
        sh_degree=first.sh_degree,
        loss=f"photometric + distillation({', '.join(map(repr, paths))})",
    )
    return replace(options, init=paths[0], points="auto"), config
