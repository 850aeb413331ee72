"""Several runs of one scene, which differ by their seeds, distilled into one model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from reference_trainer.runs.folder import CONFIG, PLY, read_run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import with_recipe

__all__ = ["distilled"]


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
        sh_degree=first.sh_degree,
        loss=f"photometric + distillation({', '.join(map(repr, paths))})",
    )
    return replace(options, init=paths[0], points="auto"), config
