"""One run from photographs to scores: train, monitor, checkpoint, evaluate, write pictures; resumable at any point."""

from __future__ import annotations

import dataclasses
import logging
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from ca_reg import CAMonitor
from ca_reg.sinks import MLflowSink, WandbSink
from reference_trainer.evaluation.evaluate import evaluate, training_snapshot
from reference_trainer.evaluation.lpips import LPIPS, load_lpips
from reference_trainer.evaluation.metrics import view_psnr
from reference_trainer.evaluation.results import PARTIAL, machine, write_json
from reference_trainer.evaluation.trained_model import TrainedModel
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
    check_run,
    check_trusted,
    modules_named,
    read_results,
    read_run_settings,
    run_lock,
    run_settings,
    settings_of_run,
)  # fmt: skip
from reference_trainer.runs.guarded import keep_removed
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.scenes.virtual_cameras import measured_views
from reference_trainer.threads import threads_for
from reference_trainer.training.assembly import check
from reference_trainer.training.checkpoint import load_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingInterrupted, TrainingStoppedError
from reference_trainer.training.plan import make_plan
from reference_trainer.training.trainer import Trainer

__all__ = ["Monitoring", "SinkName", "load_run", "model_of", "run_experiment", "save_for_viewers"]

SinkName = Literal["wandb", "mlflow"]
_log = logging.getLogger(__name__)
_CURVES_EVERY = 10  # steps between points of the loss; more would not be told apart in a curve


@dataclass(frozen=True)
class Monitoring:
    """What is measured and saved while a model trains; it does not affect what is trained.

    Args:
        every: steps between measurements of CA and PSNR, which also take place after the last step; 0 for none.
        protocol: whether to log the paper's CA of five renders in the place of the exact score of all tables.
        pictures: whether each measurement also logs the ``details`` of `CAMonitor` (see `training_snapshot`).
        checkpoint_every: steps between checkpoints, the most that a dead worker costs.
        sinks: where measurements and curves go besides TensorBoard: ``"wandb"``, ``"mlflow"``.

    Raises:
        ValueError: if an interval is out of range.
    """

    every: int = 500
    protocol: bool = False
    pictures: bool = False
    checkpoint_every: int = 500
    sinks: tuple[SinkName, ...] = ()

    def __post_init__(self) -> None:
        if self.every < 0 or self.checkpoint_every < 1:
            raise ValueError(
                f"monitor_every must be at least 0 (0: never) and checkpoint_every at least 1, got {self.every} and "
                f"{self.checkpoint_every}."
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

    ``pad_to_degree`` is that of `save_ply`. Raises ValueError if these opacities depend on the camera.
    """
    if model.depends_on_camera:
        raise ValueError(f"what is rendered after {model.regularizer} depends on the camera: no file can hold it.")
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
    monitoring: Monitoring = Monitoring(),
    lpips: str | None = None,
    progress: bool = False,
    on_step: Callable[[Trainer], None] = lambda trainer: None,
) -> dict[str, Any]:
    """Train on a scene, measure, and return what ``results.json`` holds; continues where an earlier call stopped.

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
        monitoring: what is measured and saved on the way.
        lpips: perceptual metric of the evaluation: None, ``"installed"``, or a weights file.
        progress: whether to show a progress bar.
        on_step: called with the trainer, which it must not change, after every step and before each view is measured.

    Raises:
        ValueError: if the folder holds a run with other settings, a damaged file, or files that this program did not
            write.
        FolderInUseError: if another process is at work in the folder; nothing there was touched.
        TrainingStoppedError: if training cannot go on; the last checkpoint is kept, and the message names it.
        TrainingInterrupted: on Ctrl-C, after a checkpoint has been saved; a second Ctrl-C does not wait for it. On
            SIGTERM a checkpoint is saved as well, and the signal is raised again, which ends the process.
        OSError: if a file cannot be written, such as on a full disk; its previous content is kept.
    """
    check(config)
    perceptual = load_lpips(lpips, device=device)
    settings_of_run(out, options, config, auto=auto, given=given)
    if (out / RESULTS).exists():
        return _complete(out, perceptual)
    # Before the folder is made, so that a mistyped scene does not claim it.
    scene = load_scene(options, seed=config.seed)
    _log.info(scene)
    with run_lock(out), threads_for(scene.pixels):
        begun = settings_of_run(out, options, config, auto=auto, given=given)  # perhaps since, by another process
        if (out / RESULTS).exists():
            return _complete(out, perceptual)
        settings = _planned(scene, config, out, auto=auto, given=given, device=device) if begun is None else begun
        remove_leftovers(out, below=False)  # an evaluation of the run may be writing to a subfolder right now
        remove_leftovers(out / VIEWS)
        resumed = (out / CHECKPOINT).exists()
        own = modules_named(config)
        trainer = _load(out, scene, device, settings, own) if resumed else Trainer(scene, settings, device)
        write_json(out / CONFIG, run_settings(options, settings))
        if resumed:
            _log.info("%s: continues from step %d", out, trainer.step)
        else:
            trainer.save(out / CHECKPOINT)
        with _saved_at_the_end(trainer, out):
            _train(trainer, out, monitoring, resumed=resumed, progress=progress, on_step=on_step)
        return _measure(trainer, out, perceptual, on_step)


def load_run(folder: Path, device: torch.device | str = "cpu", *, trust: Collection[str] = ()) -> Trainer:
    """Load the trainer of a run, finished or not, with its scene.

    ``trust`` names modules that the run's settings may import: a folder may come from anybody, and what its settings
    name as module:Class would be executed here.

    Raises:
        FileNotFoundError: if the folder holds no run, or its scene is not where it was.
        ValueError: if its settings or its checkpoint are damaged, do not belong together, or name other modules.
    """
    check_run(folder)
    options, config = read_run_settings(folder / CONFIG)
    for settings in (options, config):
        check_trusted(folder, settings, trust)
    if options.path != "synthetic" and not Path(options.path).exists():
        raise FileNotFoundError(
            f"{folder} was trained on {options.path}, which is not there anymore: put the scene back, or write where "
            f'it is now, under the same name, as "path" into {folder / CONFIG}.'
        )
    return _load(folder, load_scene(options, seed=config.seed), device, config, trust)


def _load(
    folder: Path, scene: Scene, device: torch.device | str, config: TrainConfig, trust: Collection[str]
) -> Trainer:
    """Load the checkpoint of a run, whose settings are those of its ``config.json`` and name no untrusted module."""

    def refuse(found: TrainConfig) -> None:
        check_trusted(folder, found, trust)
        # A trainer that starts from a model sets sh_every, and a run that has moved finds the models of its loss there.
        changed = [
            f"{name}: {value} -> {getattr(config, name)}"
            for name, value in vars(found).items()
            if value != getattr(config, name) and name not in ("sh_every", "loss")
        ]
        if changed:
            raise ValueError(
                f"{folder / CONFIG} was changed since the training began ({'; '.join(changed)}): undo that."
            )

    return Trainer.load(folder / CHECKPOINT, scene, device, refuse=refuse)


def _complete(out: Path, perceptual: LPIPS | None) -> dict[str, Any]:
    """Return the results of a complete run; logs if they lack the metric that is asked for."""
    _log.info("%s: complete, nothing to do", out)
    results = read_results(out)
    if perceptual is not None and results.get("perceptual_metric") != perceptual.name:
        _log.info("%s was measured without %s: ca-reg evaluate with --lpips does that", out, perceptual.name)
    return results


def _planned(
    scene: Scene, config: TrainConfig, out: Path, *, auto: bool, given: Collection[str], device: torch.device | str
) -> TrainConfig:
    """Return the settings that a run begins with; with ``auto`` those of a plan, which is written."""
    if not auto:
        (out / PLAN).unlink(missing_ok=True)  # left by a run that stopped before its config.json was written
        return config
    plan = make_plan(scene, config, given=given, device=device)
    write_json(out / PLAN, plan.as_dict())
    for row in (each for each in plan.rows() if each["change"] != "-" or each["decision"] == "recommended"):
        change = "" if row["change"] == "-" else f" ({row['change']})"
        _log.info("plan: %s %s%s: %s", row["item"], row["decision"], change, row["reason"])
    _log.info("plan: all decisions, with reasons, are in %s", out / PLAN)
    return plan.applied(config, given=given)


@contextmanager
def _saved_at_the_end(trainer: Trainer, out: Path) -> Iterator[None]:
    """Save a training that is interrupted; if it cannot go on, add to the error where the last checkpoint is."""
    checkpoint = out / CHECKPOINT
    try:
        yield
    except TrainingInterrupted as stop:
        trainer.save(checkpoint)
        last = trainer.config.iterations
        _log.info("%s: saved at step %d of %d; the same command continues there", out, trainer.step, last)
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
    monitoring: Monitoring,
    *,
    resumed: bool,
    progress: bool,
    on_step: Callable[[Trainer], None],
) -> None:
    """Train to the end, with monitoring and checkpoints."""
    last, every = trainer.config.iterations, monitoring.every

    def moments_now(opacity: Tensor, view: View, *rest: Any) -> Any:  # of the model as it is when it is measured
        return model_of(trainer).moments(opacity, view, *rest)

    def quality(opacity: Tensor, view: View) -> float:  # the monitor's own test-time scaling knows only dropout
        return view_psnr(model_of(trainer).test_rendering(view).image, view)

    def details(opacity: Tensor, view: View) -> dict[str, Tensor]:
        return training_snapshot(model_of(trainer), view)

    monitored: AbstractContextManager[CAMonitor | None] = nullcontext()
    if every:
        model = model_of(trainer)
        score = model.exact_ca_score(drop_rate=0.5, moments=moments_now)
        if monitoring.protocol:
            score = model.ca_score(render_fn=lambda opacity, view: model_of(trainer).render(opacity, view))
        views = {"train": trainer.views, "test": [view.to(trainer.device) for view in trainer.scene.test]}
        monitored = CAMonitor(
            score,
            out,
            views={name: group for name, group in views.items() if group},
            every=every,
            last_step=last,
            psnr=quality,
            details=details if monitoring.pictures else None,
            sinks=[
                WandbSink(project="ca_reg", name=out.name) if name == "wandb" else MLflowSink()
                for name in monitoring.sinks
            ],
            resume_step=trainer.step if resumed else None,
        )
    with monitored as monitor:
        if monitor is not None:
            where = " and ".join(monitor.backends)
            _log.info("%s: CA and PSNR go to %s every %d steps and after the last", out, where, every)
            _write_settings(monitor, trainer)
            if trainer.step > 0:  # perhaps missing; what is logged is not repeated
                monitor(trainer.step, trainer.gaussians.opacities)

        def after_step(trainer: Trainer) -> None:
            step = trainer.step
            if monitor is not None:
                monitor(step, trainer.gaussians.opacities)
                _write_curves(monitor, trainer)
            if trainer.removed is not None:  # before the checkpoint, which does not know it any more
                keep_removed(out, step, trainer.removed[0], trainer.scene, trainer.removed[1])
            if step % monitoring.checkpoint_every == 0 or step == last:
                trainer.save(out / CHECKPOINT)
            on_step(trainer)

        trainer.train(after_step=after_step, progress=progress)


def _write_settings(monitor: CAMonitor, trainer: Trainer) -> None:
    """Show in TensorBoard and the sinks what is trained: the settings that are not at their default."""
    if monitor.writer is not None:
        usual = vars(TrainConfig())
        chosen = {name: value for name, value in vars(trainer.config).items() if value != usual[name]}
        text = "\n".join(f"    {name}: {value}" for name, value in ({"scene": trainer.scene.name} | chosen).items())
        monitor.writer.add_text("settings", text, trainer.step)


def _write_curves(monitor: CAMonitor, trainer: Trainer) -> None:
    """Show in TensorBoard and the sinks the loss of the step and the rates that change."""
    if monitor.writer is not None and trainer.step % _CURVES_EVERY == 0:
        rate = trainer.config.means_rate_at(trainer.step - 1) * trainer.scene.extent
        shown = {"loss": trainer.loss, "learning rate/means": rate, "dropout rate": model_of(trainer).dropout}
        for name, value in shown.items():
            monitor.writer.add_scalar(name, value, trainer.step)


def _measure(
    trainer: Trainer, out: Path, perceptual: LPIPS | None, on_step: Callable[[Trainer], None]
) -> dict[str, Any]:
    """Evaluate the trained model; write it, its pictures and its scores, and return the results."""
    model = model_of(trainer)
    save_ply(model.gaussians, out / PLY, regularizer=model.regularizer, step=model.step)
    if model.depends_on_camera:
        _log.info("%s: what is rendered at test time depends on the camera, so that there is no %s", out, BAKED_PLY)
    elif model.factor != 1:
        save_for_viewers(model, out / BAKED_PLY)
    partial = out / PARTIAL
    evaluation = evaluate(
        model,
        measured_views(trainer.scene),
        perceptual=perceptual,
        pictures=out / VIEWS,
        partial=partial,
        on_view=lambda: on_step(trainer),  # keeps an open viewer page up to date while views are measured
    )
    results = {
        "scene": trainer.scene.name,
        "config": dataclasses.asdict(trainer.config),
        "seconds": trainer.seconds,
        "processor_seconds": trainer.processor_seconds,
        **evaluation.as_dict(),
        "ca_settings": dataclasses.asdict(model.ca_score().settings),
        "machine": machine(trainer.device),
    }
    partial.unlink(missing_ok=True)  # before results.json, because a complete run is not touched again
    write_json(out / RESULTS, results)
    return read_results(out)
