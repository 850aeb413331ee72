"""One run from photographs to scores: train, monitor, checkpoint, evaluate, write pictures. Resumable at any point."""

from __future__ import annotations

import dataclasses
import signal
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAMonitor
from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.lpips import lpips_option
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.model import Model
from reference_trainer.evaluation.report import machine, markdown_table, write_json
from reference_trainer.files import remove_leftovers
from reference_trainer.json_files import read_json
from reference_trainer.model.ply import save_ply
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.studies.run_settings import read_run_settings
from reference_trainer.training.checkpoint import load_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingInterrupted
from reference_trainer.training.plan import Plan, make_plan
from reference_trainer.training.trainer import Trainer, TrainingStoppedError

__all__ = [
    "BAKED_PLY",
    "CHECKPOINT",
    "CONFIG",
    "PLAN",
    "PLY",
    "RESULTS",
    "load_run",
    "model_of",
    "run_experiment",
    "save_for_viewers",
    "summary",
]

CONFIG = "config.json"
PLAN = "plan.json"
CHECKPOINT = "checkpoint.pt"
PLY = "point_cloud.ply"
BAKED_PLY = "point_cloud_for_viewers.ply"
RESULTS = "results.json"


def model_of(trainer: Trainer) -> Model:
    """Return the trainer's model as it is to be used at test time."""
    config = trainer.config
    return Model(
        gaussians=trainer.gaussians.map(Tensor.detach),
        background=trainer.background,
        dropout=0.0 if config.compensate else config.dropout,
        opacity_scale=config.test_time_scale,
        sh_degree=trainer.sh_degree,
        expected_noise=config.noise if config.scale_noise else 0.0,
        clip_noise=config.clip_noise,
    )


def save_for_viewers(model: Model, path: Path, *, pad_to_degree: int | None = None) -> None:
    """Write a model as a PLY with its test-time opacities, marked so that nothing scales them again.

    Args:
        model: what to write.
        path: the file.
        pad_to_degree: as of `save_ply`.
    """
    if model.expected_noise > 0:
        save_ply(model.gaussians, path, opacities=model.test_opacities, pad_to_degree=pad_to_degree)
    else:  # one factor, which a reader can take out again
        save_ply(model.gaussians, path, bake_p=1 - model.opacity_scale, pad_to_degree=pad_to_degree)


def run_experiment(
    options: SceneOptions,
    config: TrainConfig,
    out: Path,
    *,
    auto: bool = False,
    given: Collection[str] = (),
    device: torch.device | str = "cpu",
    monitor_every: int = 500,
    checkpoint_every: int = 500,
    lpips: str | None = None,
    progress: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Train on a scene and measure the result; what a former call has done already is not done again.

    The folder receives ``config.json`` with the settings that are trained with, with ``auto`` also ``plan.json`` with
    the reasons for those that were not asked for, ``checkpoint.pt``, ``ca.jsonl`` with TensorBoard events,
    ``point_cloud.ply`` with the plain opacities (where those of the test are others, after dropout or with
    ``scale_noise``, also ``point_cloud_for_viewers.ply`` with them, marked), ``views/`` with pictures of every view,
    and ``results.json``, which marks the run as complete.

    Args:
        options: the scene; random initial points use the seed of ``config``.
        config: all settings of the training.
        out: folder of this run.
        auto: leave out what the scene does not need (`make_plan`). A run that is continued keeps the plan it began
            with, or goes on without one if it began without.
        given: with ``auto``, fields of ``config`` that the plan must not change although they are at their default.
        device: where to train.
        monitor_every: steps between measurements of CA and PSNR; 0 for none.
        checkpoint_every: steps between checkpoints.
        lpips: perceptual metric of the evaluation: None, ``"installed"``, or a weights file.
        progress: whether to show a progress bar.
        say: receives a line about what is happening.

    Returns:
        The content of ``results.json``.

    Raises:
        ValueError: if the folder holds a run with other settings, or a damaged file.
        TrainingStoppedError: if training cannot go on; the last checkpoint is kept, and the message names it.
        TrainingInterrupted: on Ctrl-C, after a checkpoint has been saved; a second Ctrl-C does not wait for it. After
            SIGTERM the checkpoint is saved, too, and the signal raised again, which ends the process.
        OSError: if a file cannot be written, such as on a full disk; what was there before is kept.
    """
    perceptual = lpips_option(lpips, device=device)
    begun = (out / CONFIG).exists()
    if auto and begun and (out / PLAN).exists():
        config = _plan(out / PLAN).applied(config, given=given)
    if begun:
        _refuse_other_run(out, _claim(options, config))
    if (out / RESULTS).exists():
        say(f"{out}: complete, nothing to do")
        return _results(out)
    scene = options.load(seed=config.seed)
    if auto and not begun:
        plan = make_plan(scene, config, given=given)
        config = plan.applied(config, given=given)
        write_json(out / PLAN, plan.as_dict())
        _tell(plan, out, say)
    elif not begun:
        (out / PLAN).unlink(missing_ok=True)  # of a run that ended before it had begun
    remove_leftovers(out)
    checkpoint = out / CHECKPOINT
    resumed = checkpoint.exists()
    trainer = Trainer.load(checkpoint, scene, device) if resumed else Trainer(scene, config, device)
    write_json(out / CONFIG, _claim(options, config))  # not earlier: a mistyped scene must not claim the folder
    if resumed:
        say(f"{out}: continues from step {trainer.step}")
    else:
        trainer.save(checkpoint)
    try:
        _train(trainer, out, monitor_every, checkpoint_every, resumed=resumed, progress=progress, say=say)
    except TrainingInterrupted as stop:
        trainer.save(checkpoint)
        say(f"{out}: saved at step {trainer.step} of {config.iterations}; the same command continues there")
        if stop.signal == signal.SIGTERM:  # who sent it expects the process to end by it
            sys.stdout.flush()
            signal.raise_signal(signal.SIGTERM)
        raise
    except TrainingStoppedError as error:
        step = load_checkpoint(checkpoint)["step"]
        raise TrainingStoppedError(f"{error} The model of step {step} is kept in {checkpoint}.") from error
    model = model_of(trainer)
    save_ply(model.gaussians, out / PLY)
    if model.opacity_scale < 1 or model.expected_noise > 0:
        save_for_viewers(model, out / BAKED_PLY)
    evaluation = evaluate(model, scene, perceptual=perceptual, pictures=out / "views")
    results = {
        "scene": scene.name,
        "config": dataclasses.asdict(config),
        "seconds": trainer.seconds,
        **evaluation.as_dict(),
        "machine": machine(),
    }
    write_json(out / RESULTS, results)
    return _results(out)


def summary(results: Mapping[str, Any]) -> str:
    """Return the content of ``results.json`` as a short table in Markdown; CA in units of 1e-3."""
    rows: list[dict[str, object]] = []
    for split, mean in sorted(results["mean"].items()):
        known = {name: float("nan") if value is None else value for name, value in mean.items()}
        rows.append(
            {
                "views": split,
                "PSNR": known["psnr"],
                "SSIM": known["ssim"],
                "LPIPS": known["lpips"],
                "CA x1e-3": known["ca"] * 1e3,
                "CV": known["cv"],
                "Gaussians": results["gaussians"],
                "seconds": results["seconds"],
            }
        )
    return markdown_table(rows, list(rows[0]))


def load_run(folder: Path, device: torch.device | str = "cpu") -> Trainer:
    """Load the trainer of a run, finished or not, with its scene.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if its settings or its checkpoint are damaged, or do not belong together.
    """
    if not (folder / CONFIG).exists():
        raise FileNotFoundError(f"{folder} holds no run (no {CONFIG}): give the --out folder of ca-reg train.")
    options, config = read_run_settings(folder / CONFIG)
    return Trainer.load(folder / CHECKPOINT, options.load(seed=config.seed), device)


def _results(out: Path) -> dict[str, Any]:
    """Read the results of a complete run."""
    results = read_json(out / RESULTS)
    if not isinstance(results, dict) or "mean" not in results:
        raise ValueError(f"{out / RESULTS} does not hold the results of a run: delete it to measure again.")
    return results


def _plan(path: Path) -> Plan:
    """Read the plan of a run."""
    try:
        return Plan.from_dict(read_json(path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _claim(options: SceneOptions, config: TrainConfig) -> dict[str, Any]:
    """Return the content of ``config.json``."""
    return {"scene": dataclasses.asdict(options.absolute()), "config": dataclasses.asdict(config)}


def _tell(plan: Plan, out: Path, say: Callable[[str], None]) -> None:
    """Say what the plan changes."""
    changing = [row for row in plan.rows() if row["change"] != "-"]
    for row in changing:
        say(f"plan: {row['item']} {row['decision']} ({row['change']}): {row['reason']}")
    say(f"plan: {len(changing)} settings changed, reasons in {out / PLAN}; --no-auto trains exactly as asked")


def _refuse_other_run(out: Path, settings: dict[str, Any]) -> None:
    """Refuse a folder that holds a run with other settings."""
    found = _claim(*read_run_settings(out / CONFIG))
    changed = [
        f"{key}: {found[part][key]} -> {value}"
        for part, values in settings.items()
        for key, value in values.items()
        if found[part][key] != value
    ]
    if changed:
        raise ValueError(
            f"{out} holds a run with other settings ({'; '.join(changed)}): give another folder, or delete this one."
        )


def _train(
    trainer: Trainer,
    out: Path,
    monitor_every: int,
    checkpoint_every: int,
    *,
    resumed: bool,
    progress: bool,
    say: Callable[[str], None],
) -> None:
    """Train to the end with a monitor and checkpoints on the way."""
    last = trainer.config.iterations

    def checkpoint(trainer: Trainer) -> None:
        if trainer.step % checkpoint_every == 0 or trainer.step == last:
            trainer.save(out / CHECKPOINT)

    if not monitor_every:
        trainer.train(after_step=checkpoint, progress=progress)
        return

    def render_now(opacity: Tensor, view: View) -> tuple[Tensor, Tensor]:
        return model_of(trainer).render(opacity, view)

    score = model_of(trainer).ca_score(render_fn=render_now)
    views = {"train": trainer.views, "test": [view.to(trainer.device) for view in trainer.scene.test]}

    def quality(opacity: Tensor, view: View) -> float:  # the monitor's own scaling knows of dropout only
        return psnr(render_now(model_of(trainer).test_opacities, view)[0].clamp(0, 1), view.image)

    views = {name: group for name, group in views.items() if group}
    with CAMonitor(
        score, out, views=views, every=monitor_every, psnr=quality, resume_step=trainer.step if resumed else None
    ) as monitor:
        say(f"{out}: CA and PSNR go to {' and '.join(monitor.backends)} every {monitor_every} steps")

        if trainer.step > 0:  # the last measurement may have been interrupted; one that is in the log is not repeated
            monitor(trainer.step, trainer.gaussians.opacities)

        def after_step(trainer: Trainer) -> None:
            monitor(trainer.step, trainer.gaussians.opacities)
            checkpoint(trainer)

        trainer.train(after_step=after_step, progress=progress)
