"""One run from photographs to scores: train, monitor, checkpoint, evaluate, write pictures; resumable at any point."""

from __future__ import annotations

import dataclasses
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAMonitor
from reference_trainer.evaluation.evaluate import evaluate, glance
from reference_trainer.evaluation.kept import PARTIAL
from reference_trainer.evaluation.lpips import LPIPS, load_lpips
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.evaluation.trajectory import measured_views
from reference_trainer.files import remove_leftovers
from reference_trainer.model.ply import save_ply
from reference_trainer.runs.folder import (
    BAKED_PLY,
    CHECKPOINT,
    CONFIG,
    PLAN,
    PLY,
    RESULTS,
    VIEWS,
    begun_with,
    read_results,
    read_run_settings,
    run_settings,
)  # fmt: skip
from reference_trainer.runs.lock import run_lock
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.threads import threads_for
from reference_trainer.training.assembly import check
from reference_trainer.training.checkpoint import load_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingInterrupted, TrainingStoppedError
from reference_trainer.training.plan import make_plan
from reference_trainer.training.trainer import Trainer

__all__ = ["check_intervals", "load_run", "model_of", "run_experiment", "save_for_viewers"]


def check_intervals(monitor_every: int, checkpoint_every: int) -> None:
    """Raise a ValueError unless these numbers of steps are at least 0 and at least 1."""
    if monitor_every < 0 or checkpoint_every < 1:
        raise ValueError(
            f"expected monitor_every of at least 0, for no measurements, and checkpoint_every of at least 1, got "
            f"{monitor_every} and {checkpoint_every}."
        )


def model_of(trainer: Trainer) -> TrainedModel:
    """Return the trainer's current model, for use at test time."""
    return TrainedModel(
        gaussians=trainer.gaussians.map(Tensor.detach),
        background=trainer.background,
        regularizer=trainer.config.regularizers if trainer.regularized else "",
        step=trainer.step,
        sh_degree=trainer.sh_degree,
    )


def save_for_viewers(model: TrainedModel, path: Path, *, pad_to_degree: int | None = None) -> None:
    """Write a model as a PLY with its test-time opacities, marked so that nothing scales them again.

    Args:
        model: what to write.
        path: the file.
        pad_to_degree: as in `save_ply`.
    """
    factor = model.factor  # a uniform one, which a reader can undo, or None
    save_ply(
        model.gaussians,
        path,
        bake_p=None if factor is None else 1 - factor,
        opacities=model.test_opacities if factor is None else None,
        pad_to_degree=pad_to_degree,
        regularizer=model.regularizer,
        step=model.step,
    )


def run_experiment(
    options: SceneOptions,
    config: TrainConfig,
    out: Path,
    *,
    auto: bool = False,
    given: Collection[str] = (),
    device: torch.device | str = "cpu",
    monitor_every: int = 500,
    monitor_pictures: bool = False,
    checkpoint_every: int = 500,
    lpips: str | None = None,
    progress: bool = False,
    watch: Callable[[Trainer], None] = lambda trainer: None,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Train on a scene and measure the result; continues where an earlier call stopped.

    The folder receives ``config.json`` with the settings of the training; with ``auto`` also ``plan.json`` with the
    reasons for those that were not asked for; ``checkpoint.pt``; ``ca.jsonl`` and TensorBoard events;
    ``point_cloud.ply`` with the plain opacities, and if the test-time ones differ, as after dropout, also
    ``point_cloud_for_viewers.ply`` with those, marked; ``views/`` with pictures of every view; and ``results.json``,
    which marks the run as complete. It is locked while it is written to (`run_lock`).

    Args:
        options: the scene; random initial points use the seed of ``config``.
        config: all settings of the training.
        out: folder of this run.
        auto: leave out what the scene does not need (`make_plan`). A continued run keeps the plan it began with, or
            none if it began without.
        given: with ``auto``, fields of ``config`` that the plan must not change although they are at their default.
        device: where to train.
        monitor_every: steps between measurements of CA and PSNR; 0 for none. A training of fewer steps is measured at
            its end.
        monitor_pictures: whether each measurement also logs the ``details`` of `CAMonitor` (see `glance`).
        checkpoint_every: steps between checkpoints.
        lpips: perceptual metric of the evaluation: None, ``"installed"``, or a weights file.
        progress: whether to show a progress bar.
        watch: called with the trainer, which it must not change, after every step and before each view is measured.
        say: receives lines about what is happening.

    Returns:
        The content of ``results.json``.

    Raises:
        ValueError: if an interval is out of range, or the folder holds a run with other settings or a damaged file.
        FolderInUseError: if another process is at work in the folder; nothing there was touched.
        TrainingStoppedError: if training cannot go on; the last checkpoint is kept, and the message names it.
        TrainingInterrupted: on Ctrl-C, after a checkpoint has been saved; a second Ctrl-C does not wait for it. On
            SIGTERM a checkpoint is saved as well, and the signal is raised again, which ends the process.
        OSError: if a file cannot be written, such as on a full disk; its previous content is kept.
    """
    check(config)
    check_intervals(monitor_every, checkpoint_every)
    perceptual = load_lpips(lpips, device=device)
    begun_with(out, options, config, auto=auto, given=given)
    if (out / RESULTS).exists():
        return _complete(out, say)
    # Before the folder is made, so that a mistyped scene does not claim it.
    scene = load_scene(options, seed=config.seed)
    for note in scene.notes:
        say(note)
    with run_lock(out), threads_for(scene.pixels):
        begun = begun_with(out, options, config, auto=auto, given=given)  # perhaps since, by another process
        if (out / RESULTS).exists():
            return _complete(out, say)
        settings = _planned(scene, config, out, auto=auto, given=given, say=say) if begun is None else begun
        remove_leftovers(out, below=False)  # an evaluation of the run may be writing to a subfolder right now
        remove_leftovers(out / VIEWS)
        resumed = (out / CHECKPOINT).exists()
        trainer = Trainer.load(out / CHECKPOINT, scene, device) if resumed else Trainer(scene, settings, device)
        write_json(out / CONFIG, run_settings(options, settings))
        if resumed:
            say(f"{out}: continues from step {trainer.step}")
        else:
            trainer.save(out / CHECKPOINT)
        with _saved_at_the_end(trainer, out, say):
            shared: dict[str, Any] = {"resumed": resumed, "progress": progress, "watch": watch, "say": say}
            _train(trainer, out, monitor_every, checkpoint_every, pictures=monitor_pictures, **shared)

        def go_on(text: str) -> None:  # keeps an open viewer page drawn while views are measured
            say(text)
            watch(trainer)

        return _measure(trainer, out, perceptual, go_on)


def load_run(folder: Path, device: torch.device | str = "cpu") -> Trainer:
    """Load the trainer of a run, finished or not, with its scene.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if its settings or its checkpoint are damaged, or do not belong together.
    """
    if not (folder / CONFIG).exists():
        raise FileNotFoundError(f"{folder} holds no run (no {CONFIG}): give the --out folder of ca-reg train.")
    options, config = read_run_settings(folder / CONFIG)
    return Trainer.load(folder / CHECKPOINT, load_scene(options, seed=config.seed), device)


def _complete(out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the results of a complete run."""
    say(f"{out}: complete, nothing to do")
    return read_results(out)


def _planned(
    scene: Scene, config: TrainConfig, out: Path, *, auto: bool, given: Collection[str], say: Callable[[str], None]
) -> TrainConfig:
    """Return the settings that a run begins with; with ``auto`` those of a plan, which is written."""
    if not auto:
        (out / PLAN).unlink(missing_ok=True)  # left by a run that stopped before its config.json was written
        return config
    plan = make_plan(scene, config, given=given)
    write_json(out / PLAN, plan.as_dict())
    changing = [row for row in plan.rows() if row["change"] != "-"]
    for row in changing:
        say(f"plan: {row['item']} {row['decision']} ({row['change']}): {row['reason']}")
    say(f"plan: {len(changing)} settings changed, reasons in {out / PLAN}; --no-auto trains exactly as asked")
    return plan.applied(config, given=given)


@contextmanager
def _saved_at_the_end(trainer: Trainer, out: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Save a training that is interrupted; if it cannot go on, add to the error where the last checkpoint is."""
    checkpoint = out / CHECKPOINT
    try:
        yield
    except TrainingInterrupted as stop:
        trainer.save(checkpoint)
        say(f"{out}: saved at step {trainer.step} of {trainer.config.iterations}; the same command continues there")
        if stop.signal == signal.SIGTERM:  # its sender expects the process to die of it
            sys.stdout.flush()
            signal.raise_signal(signal.SIGTERM)
        raise
    except TrainingStoppedError as error:
        step = load_checkpoint(checkpoint)["step"]
        raise TrainingStoppedError(f"{error} The model of step {step} is kept in {checkpoint}.") from error


def _train(
    trainer: Trainer,
    out: Path,
    monitor_every: int,
    checkpoint_every: int,
    *,
    pictures: bool,
    resumed: bool,
    progress: bool,
    watch: Callable[[Trainer], None],
    say: Callable[[str], None],
) -> None:
    """Train to the end, with monitoring and checkpoints."""
    last = trainer.config.iterations

    def render_now(opacity: Tensor, view: View) -> tuple[Tensor, Tensor]:
        return model_of(trainer).render(opacity, view)

    def quality(opacity: Tensor, view: View) -> float:  # the monitor's own test-time scaling knows only dropout
        return psnr(model_of(trainer).test_rendering(view).image.clamp(0, 1), view.image, view.mask)

    def details(opacity: Tensor, view: View) -> dict[str, Tensor]:
        return glance(model_of(trainer), view)

    monitored: AbstractContextManager[CAMonitor | None] = nullcontext()
    if monitor_every:
        views = {"train": trainer.views, "test": [view.to(trainer.device) for view in trainer.scene.test]}
        monitored = CAMonitor(
            model_of(trainer).ca_score(render_fn=render_now),
            out,
            views={name: group for name, group in views.items() if group},
            every=min(monitor_every, last),
            psnr=quality,
            details=details if pictures else None,
            resume_step=trainer.step if resumed else None,
        )
    with monitored as monitor:
        if monitor is not None:
            say(f"{out}: CA and PSNR go to {' and '.join(monitor.backends)} every {monitor.every} steps")
            if trainer.step > 0:  # the last measurement may be missing; one in the log is not repeated
                monitor(trainer.step, trainer.gaussians.opacities)

        def after_step(trainer: Trainer) -> None:
            if monitor is not None:
                monitor(trainer.step, trainer.gaussians.opacities)
            if trainer.step % checkpoint_every == 0 or trainer.step == last:
                trainer.save(out / CHECKPOINT)
            watch(trainer)

        trainer.train(after_step=after_step, progress=progress)


def _measure(trainer: Trainer, out: Path, perceptual: LPIPS | None, say: Callable[[str], None]) -> dict[str, Any]:
    """Evaluate the trained model; write it, its pictures and its scores, and return the results."""
    model = model_of(trainer)
    save_ply(model.gaussians, out / PLY, regularizer=model.regularizer, step=model.step)
    if model.depends_on_camera:
        say(f"{out}: what is rendered at test time depends on the camera, so that there is no {BAKED_PLY}")
    elif model.factor != 1:
        save_for_viewers(model, out / BAKED_PLY)
    views, keep = measured_views(trainer.scene, say), out / PARTIAL
    evaluation = evaluate(model, views, perceptual=perceptual, pictures=out / VIEWS, keep=keep, say=say)
    results = {
        "scene": trainer.scene.name,
        "config": dataclasses.asdict(trainer.config),
        "seconds": trainer.seconds,
        "processor_seconds": trainer.processor_seconds,
        **evaluation.as_dict(),
        "machine": machine(),
    }
    keep.unlink(missing_ok=True)  # before results.json, because a complete run is not touched again
    write_json(out / RESULTS, results)
    return read_results(out)
