"""Remove from a finished model the Gaussians that co-adapt most relative to their contribution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from reference_trainer.evaluation.evaluate import Evaluation, evaluate
from reference_trainer.evaluation.results import markdown_table
from reference_trainer.evaluation.shares import Heat, all_but_highest
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.ply import save_ply
from reference_trainer.runs.score_ply import place, scaled
from reference_trainer.scenes.options import OrbitOptions, SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.threads import threads_for
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = ["clean_ply", "refined"]


def clean_ply(
    ply: Path,
    where: SceneOptions | OrbitOptions,
    out: Path,
    *,
    fraction: float = 0.1,
    refine: int = 100,
    background: str = "auto",
    regularizer: str | None = None,
    device: str = "cpu",
    say: Callable[[str], None] = print,
) -> dict[str, Evaluation]:
    """Write a model without the Gaussians of highest share of the exact score per blend weight, and refined.

    Shares (at drop rate 1/2) and weights are measured at the training views, or at those of the orbit. The removal
    leaves holes, which a few training steps on the photographs close; without a scene or with ``refine=0`` they stay.

    Args:
        ply: a standard 3DGS PLY.
        where: its scene, or an orbit around it.
        out: the file to write, opacities plain; it must not exist.
        fraction: of the Gaussians to remove, in (0, 1); those without a share stay.
        refine: training steps afterwards, without densification, with the regularizers of the model.
        background: as in `score_ply`.
        regularizer: as in `score_ply`.
        device: where to render and train.
        say: receives the progress, and a table of quality and co-adaptation before and after.

    Returns:
        The evaluations by row of the table.

    Raises:
        ValueError: as `score_ply`, if ``fraction`` or ``refine`` is out of range, no view has a score, or the PLY has
            only test-time opacities, which cannot be trained.
        FileExistsError: if ``out`` exists.
        FileNotFoundError: if the PLY or the scene is missing.
    """
    if not 0 < fraction < 1 or refine < 0:
        raise ValueError(f"fraction must be in (0, 1) and refine at least 0, got {fraction} and {refine}.")
    if out.exists():
        raise FileExistsError(f"{out} exists already: give another --out, or delete it.")
    placed = place(ply, where, background=background, regularizer=regularizer, device=device, say=say)
    model, scene = placed.model, placed.scene
    if model.for_rendering:
        raise ValueError(f"the opacities of {ply} are those of the test: give the PLY with plain ones.")
    views = [view.to(device) for view in placed.views["orbit" if scene is None else "train"]]
    keep = all_but_highest(Heat.of(model, views).values, fraction)
    models = {"as it was": model, "taken out": replace(model, gaussians=model.gaussians[keep])}
    if scene is None:
        say("Without photographs nothing can close the holes: for that give the scene (--scene FOLDER).")
    elif refine:
        models[f"after {refine} steps"] = refined(models["taken out"], scene, refine, device)
    found = {name: evaluate(each, placed.views) for name, each in models.items()}
    *_, last = models.values()
    save_ply(scaled(last.gaussians, 1 / placed.enlarged), out, regularizer=last.regularizer, step=last.step)
    say(_table(found))
    say(f"{out}: {len(last.gaussians)} of {len(keep)} Gaussians")
    return found


def refined(model: TrainedModel, scene: Scene, steps: int, device: str = "cpu") -> TrainedModel:
    """Return a model after some more training steps on a scene, at the final learning rate of the means.

    No Gaussian is added or removed. Errors are those of `Trainer`.
    """
    usual, start = TrainConfig(), model.gaussians
    config = replace(
        usual, iterations=steps, regularizer=model.regularizer, sh_degree=start.sh_degree,
        means_rate=usual.means_rate_final, densify_every=0, opacity_reset_every=0,
    )  # fmt: skip
    trainer = Trainer(replace(scene, start=start), config, device)
    with threads_for(scene.pixels):
        trainer.train()
    return replace(model, gaussians=trainer.gaussians.map(Tensor.detach))


def _table(found: dict[str, Evaluation]) -> str:
    """Return a table with the means of every split, one row per model."""
    rows: list[dict[str, object]] = []
    for name, evaluation in found.items():
        row: dict[str, object] = {"model": name, "Gaussians": evaluation.gaussians}
        for split in dict.fromkeys(view.split for view in evaluation.views):
            row |= {
                f"{split} PSNR": evaluation.mean(split, "psnr"),
                f"{split} exact CA at 1/2 x1e-3": evaluation.mean(split, "ca_exact_half") * 1e3,
            }
        rows.append(row)
    known = [title for title in rows[0] if any(row[title] == row[title] for row in rows)]  # not only nan
    return markdown_table(rows, known)
