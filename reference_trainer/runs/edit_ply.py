"""Write a finished model anew: with its test-time opacities, or without the Gaussians that co-adapt most or hang."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from reference_trainer.evaluation.evaluate import Evaluation, evaluate
from reference_trainer.evaluation.shares import Heat, all_but_highest, guard
from reference_trainer.evaluation.tables import QUANTITIES, markdown_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import is_ply, replacing
from reference_trainer.model.ply import save_ply
from reference_trainer.runs.folder import check_writable
from reference_trainer.runs.ply import load_for_views, load_plain_ply_model, load_ply_model, log_other_frame, scaled
from reference_trainer.runs.run import save_for_viewers
from reference_trainer.scenes.options import OrbitOptions, SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.threads import threads_for
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = ["SMALL", "bake_ply", "clean_ply", "compress_ply", "refined"]

SMALL = (".spz", ".sog")
"""Formats of `compress_ply`, by the ends of file names."""

_log = logging.getLogger(__name__)


def bake_ply(source: Path, target: Path, *, regularizer: str | None = None, trust: Collection[str] = ()) -> str:
    """Write a PLY with a model's test-time opacities, such as those times 1 - p after dropout p.

    A header comment records what was done, so that no program of this package does it again. The layout is that of
    `save_ply`; unknown properties are dropped. ``source`` holds plain opacities; ``regularizer`` says what it was
    trained with, such as ``"dropout(0.2)"``, if the PLY does not; ``trust`` is as for `load_run`. Returns the
    expression of the regularizers.

    Raises:
        ValueError: if the regularizers are unknown or cannot be parsed, the test-time opacities are the plain ones or
            depend on the camera, those of the source are test-time ones already, or the target is no .ply.
        FileExistsError: if the target exists: plain opacities are needed to train on and are never overwritten.
        FileNotFoundError: if there is no source.

    Example:
        >>> import tempfile
        >>> import torch
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> from reference_trainer.model.ply import load_ply, save_ply
        >>> gaussians = Gaussians.from_points(torch.rand(5, 3), torch.rand(5, 3), torch.full((5,), 0.1), sh_degree=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plain, baked = Path(folder, "plain.ply"), Path(folder, "baked.ply")
        ...     save_ply(gaussians, plain)
        ...     _ = bake_ply(plain, baked, regularizer="dropout(0.2)")
        ...     load_ply(baked).opacity_scale
        0.8
    """
    if target.exists():
        raise FileExistsError(f"{target} exists already: give another --out, or delete it.")
    if not is_ply(target):
        raise ValueError(f"{target} must end in .ply, {' or '.join(SMALL)}.")
    model, facts = load_plain_ply_model(source, regularizer=regularizer, trust=trust)
    if not facts.regularizer:
        raise ValueError(f"{source} does not say what it was trained with: give --regularizer, such as 'dropout(0.2)'.")
    if model.factor == 1:
        raise ValueError(f"a model trained with {facts.regularizer} is rendered as it is: there is nothing to bake.")
    save_for_viewers(model, target)
    return facts.regularizer


def compress_ply(source: Path, target: Path, *, regularizer: str | None = None, trust: Collection[str] = ()) -> None:
    """Write a model with its test-time opacities as one of the small files that viewers in the web read.

    The opacities of ``source`` are plain or of the test already; ``target`` is one of `SMALL` by its name. SPZ takes a
    tenth of a PLY. ``regularizer`` and ``trust`` are as for `bake_ply`.

    Raises:
        ImportError: if GaussForge is missing.
        FileExistsError: if the target exists.
        ValueError: if the PLY is damaged, or its test-time opacities depend on the camera.
    """
    try:
        from gaussforge import GaussForge
    except ImportError as error:
        raise ImportError(f"{target.suffix} files need GaussForge: pip install 'ca_reg[web]'.") from error
    if target.exists():
        raise FileExistsError(f"{target} exists already: give another --out, or delete it.")
    model, _ = load_ply_model(source, background=torch.zeros(3), regularizer=regularizer, trust=trust)
    with tempfile.TemporaryDirectory() as work:
        plain = Path(work, "plain.ply")
        save_for_viewers(model, plain)
        made = GaussForge().convert(plain.read_bytes(), "ply", target.suffix[1:].lower())
    if "error" in made:
        raise ValueError(f"GaussForge cannot write {target}: {made['error']}.")
    with replacing(target) as place:
        place.write_bytes(made["data"])


def clean_ply(
    ply: Path,
    where: SceneOptions | OrbitOptions,
    out: Path,
    *,
    fraction: float = 0.1,
    refine: int | None = None,
    hanging: bool = False,
    background: str = "auto",
    regularizer: str | None = None,
    anyway: bool = False,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> dict[str, Evaluation]:
    """Write a model without the Gaussians of highest share of the exact score per blend weight, or without what hangs.

    With ``hanging`` those that `guard` finds are removed, from models trained with dropout or noise. Otherwise, shares
    (at drop rate 1/2) and weights are measured at the training views, or at those of the orbit, and the ``fraction``,
    in (0, 1), of all Gaussians is removed; those without a share stay. This leaves holes, which ``refine`` training
    steps on the photographs close, without densification and with the regularizers of the model: by default 100, but
    none with ``hanging``, which leaves no holes, and none without a scene. Logs a table of quality and co-adaptation
    before and after, and says so if the photographs are fitted worse, or the model does not belong to the scene.
    Returns the evaluations by row of the table.

    ``where`` is the model's scene, or an orbit around it; opacities are written plain. ``anyway`` cleans a model that
    was trained with dropout, too, which made all measured ones worse. The rest is as in `score_ply`.

    Raises:
        ValueError: as `score_ply`, if ``fraction`` or ``refine`` is out of range, no view has a score, the PLY has
            only test-time opacities, which cannot be trained, the model was trained with dropout, or with ``hanging``
            without a regularizer, there is no scene, or ``out`` is no .ply.
        FileExistsError: if ``out`` exists.
        FileNotFoundError: if the PLY or the scene is missing.
    """
    refine = (0 if hanging else 100) if refine is None else refine
    if not 0 < fraction < 1 or refine < 0:
        raise ValueError(f"fraction must be in (0, 1) and refine at least 0, got {fraction} and {refine}.")
    if out.exists():
        raise FileExistsError(f"{out} exists already: give another --out, or delete it.")
    if not is_ply(out):
        raise ValueError(f"a cleaned model is a PLY: clean to {out.with_suffix('.ply')}, and bake that for others.")
    check_writable(out.parent)
    loaded = load_for_views(ply, where, background=background, regularizer=regularizer, device=device, trust=trust)
    model, scene = loaded.model, loaded.scene
    if model.for_rendering:
        raise ValueError(f"the opacities of {ply} are those of the test: give the PLY with plain ones.")
    if hanging:
        if scene is None:
            raise ValueError("what hangs is found between and beyond the cameras of a scene: give --scene FOLDER.")
        hung = guard(model, scene)
        _log.info("%s", hung)
        stays = hung.keep
    elif model.chain.drops and not anyway:
        raise ValueError(
            f"{ply} was trained with {model.regularizer}, which leaves little to remove: cleaning such a model made it "
            "worse (fern, 24.21 to 23.80 dB at the test views). Keep it as it is, remove what hangs where nobody was "
            "(--hanging), or say --anyway."
        )
    else:
        views = [view.to(device) for view in loaded.views["orbit" if scene is None else "train"]]
        stays = all_but_highest(Heat.of(model, views).values, fraction)
    taken = model if bool(stays.all()) else replace(model, gaussians=model.gaussians[stays])
    models = {"as it was": model, "taken out": taken}
    if scene is None:
        _log.info("Without photographs nothing can close the holes: for that give the scene (--scene FOLDER).")
    elif refine:
        models[f"after {refine} steps"] = refined(models["taken out"], scene, refine, device)
    found: dict[str, Evaluation] = {}
    for name, each in models.items():  # one that nothing was taken out of has been measured
        found[name] = found["as it was"] if each is model and found else evaluate(each, loaded.views)
    *_, last = models.values()
    save_ply(scaled(last.gaussians, 1 / loaded.enlarged), out, regularizer=last.regularizer, step=last.step)
    _log.info(_table(found))
    if scene is not None:
        log_other_frame(found["as it was"], scene, ply)
    before, *_, after = (evaluation.mean("train", "psnr") for evaluation in found.values())
    if round(after, 2) < round(before, 2):  # as they are shown
        _log.warning("The photographs of the training are fitted worse than before: %.2f dB, for %.2f.", after, before)
    _log.info("%s: %d of %d Gaussians", out, len(last.gaussians), len(stays))
    return found


def refined(model: TrainedModel, scene: Scene, steps: int, device: str = "cpu") -> TrainedModel:
    """Return a model after some more training steps on a scene, at the final learning rate of the means.

    No Gaussian is added or removed. Regularizers go on from the last step of the training, and keep its rates. Errors
    are those of `Trainer`.
    """
    usual, start = TrainConfig(), model.gaussians
    first = model.step if model.regularizer else 0
    config = replace(
        usual, iterations=first + steps, regularizer=model.regularizer, sh_degree=start.sh_degree,
        means_rate=usual.means_rate_final, densify_every=0, opacity_reset_every=0,
    )  # fmt: skip
    trainer = Trainer(replace(scene, start=start), config, device)
    trainer.step = first
    trainer.regularizer.hold(max(first - 1, 0))  # as in `TrainedModel.params`
    with threads_for(scene.pixels):
        trainer.train()
    return replace(model, gaussians=trainer.gaussians.map(Tensor.detach))


def _table(found: dict[str, Evaluation]) -> str:
    """Return a table with the means of every split, one row per model."""
    rows: list[dict[str, object]] = []
    for name, evaluation in found.items():
        row: dict[str, object] = {"model": name, "Gaussians": evaluation.gaussians}
        for split in dict.fromkeys(view.split for view in evaluation.views):
            for quantity in ("psnr", "ca_exact_half"):
                shown = QUANTITIES[quantity]
                row[f"{split} {shown.title}"] = shown.text([evaluation.mean(split, quantity)])
        rows.append(row)
    known = [title for title in rows[0] if any(row[title] != "n/a" for row in rows)]
    return markdown_table(rows, known)
