"""The training loop."""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ca_reg import Chain
from reference_trainer.evaluation.shares import Guard, guard
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.progress import progress_bar
from reference_trainer.render import NotFiniteError
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.assembly import (
    check,
    draws_background,
    make_density,
    make_losses,
    make_regularizer,
    make_renderer,
)
from reference_trainer.training.checkpoint import fingerprints, load_checkpoint, read_state, save_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingStoppedError, hold_interrupts
from reference_trainer.training.model_state import ModelState
from reference_trainer.training.randomness import stream, view_order
from reference_trainer.training.step import Step, read_later

__all__ = ["Trainer"]

_log = logging.getLogger(__name__)


class Trainer:
    """Fits Gaussians to the training views of a scene.

    Args:
        scene: photographs, cameras and initial points; or a model to start from, all of whose bands train at once.
        config: all settings.
        device: where to train.

    Attributes:
        step: the number of steps taken.
        seconds: wall-clock time that they took.
        processor_seconds: CPU time that all threads spent on them: the fairer figure on a busy machine.
        loss: of the last step, of all models together; nan before the first.
        renderer: what renders all but moments.
        models: what is trained; the first is the one that is measured and written.
        optimizer: of the first model.
        density: likewise.
        regularizer: likewise.
        removed: of the first model, as it was before, what the guard removed after the last step; None if nothing.

    Raises:
        ValueError: if the photographs lack what a term of the loss compares with, or the training is to be analytic
            and a regularizer has no exact expectation.
        ImportError: if gsplat is to render, and is missing.
        RuntimeError: if gsplat is to render on something else than a CUDA device.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> trainer = Trainer(synthetic_scene(width=48, height=36, points=200), TrainConfig(iterations=2, dropout=0.2))
        >>> trainer.train()
        >>> trainer.step
        2
    """

    def __init__(self, scene: Scene, config: TrainConfig, device: torch.device | str = "cpu") -> None:
        check(config)
        if scene.start is not None:  # whose colors have all bands already
            config = dataclasses.replace(config, sh_every=0)
        self.scene = scene
        self._extent = scene.extent  # computed from the cameras at every look
        self.config = config
        self.device = torch.device(device)
        self.renderer = make_renderer(config)
        self.renderer.prepare(self.device)
        self.step = 0
        self.seconds = self.processor_seconds = 0.0
        self.loss = math.nan
        self.removed: tuple[TrainedModel, Guard] | None = None
        self._shown: tuple[Tensor, View] | None = None  # the last render, and its view
        self.views = [view.to(self.device) for view in scene.train]
        self.background = scene.background.to(self.device)
        self._draws_background = draws_background(config, scene)
        self.models = [
            ModelState(scene, config, make_density(config, i), make_regularizer(config), device=self.device, index=i)
            for i in range(config.models)
        ]
        first = self.models[0]
        self.optimizer, self.density, self.regularizer = first.optimizer, first.density, first.regularizer
        self.losses = make_losses(config)
        for term in self.losses:
            term.begin(scene)
        if config.analytic:
            self._refuse_draws_without_multiplier()
        self._guards = config.guard > 0 and bool(config.regularizers) and len(scene.train) > 1
        if config.guard and not config.regularizers:
            _log.info("no guard: without dropout or noise the Gaussians of a model need each other.")
        elif config.guard and not self._guards:
            _log.info("no guard: there is no camera between or beyond a single training view.")

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they stand, of the first model."""
        return self.optimizer.gaussians

    @property
    def sh_degree(self) -> int:
        """The highest band of spherical harmonics that the last step used."""
        return self.config.sh_degree_at(self.step)

    @property
    def regularized(self) -> bool:
        """Whether the last step used the regularizers; before training, whether the first step will."""
        return max(self.step - 1, 0) >= self.config.regularize_from

    def train(
        self,
        *,
        until: int | None = None,
        after_step: Callable[[Trainer], None] | None = None,
        progress: bool = False,
    ) -> None:
        """Train up to a step.

        Args:
            until: stop after this step; the configured number by default.
            after_step: called after every step.
            progress: whether to show a progress bar with PSNR, number of Gaussians and time left.

        Raises:
            TrainingStoppedError: if the loss or the Gaussians are not finite, or no Gaussian is left.
            TrainingInterrupted: on Ctrl-C or SIGTERM, between two steps: what is saved then continues to the identical
                result.
        """
        last = self.config.iterations if until is None else min(until, self.config.iterations)
        with (
            hold_interrupts() as stop_if_interrupted,
            progress_bar(total=self.config.iterations, initial=self.step, disable=not progress) as bar,
        ):
            while self.step < last:
                stop_if_interrupted()
                start, spent = time.perf_counter(), time.process_time()
                self.train_step()
                self.seconds += time.perf_counter() - start
                self.processor_seconds += time.process_time() - spent
                if progress and self.step % 10 == 0:
                    psnr = -10 * math.log10(max(self.mse, 1e-12))
                    bar.set_postfix_str(f"{psnr:.1f} dB, {len(self.gaussians):,} Gaussians", refresh=False)
                bar.update()
                if after_step is not None:
                    after_step(self)
            stop_if_interrupted()  # also after the last step

    @property
    def mse(self) -> float:
        """Mean squared error of the first model's (regularized) render in the last step; nan before the first."""
        if self._shown is None:
            return math.nan
        image, view = self._shown
        return torch.nn.functional.mse_loss(view.as_taken(image).clamp(0, 1), view.as_taken(view.image)).item()

    def train_step(self) -> float:
        """Take one step on one view; return the loss, of all models together."""
        terms = [term for term in self.losses if term.acts(self.step)]
        try:  # also where density control renders
            for model in self.models:
                model.density.before_step(model.optimizer, self.step)
            self.density.together(self.models, self.step)
            steps = self.begin_steps()
            for step in steps:
                if self.config.analytic and len(step.regularizer):
                    step.expect()
                else:
                    step.sample(depth=any("depth" in term.needs for term in terms))
            values = [term(step) for step in steps for term in terms] or [steps[0].image.new_zeros(())]
            loss = functools.reduce(torch.add, values)
        except NotFiniteError as error:
            raise TrainingStoppedError(f"step {self.step + 1} cannot be rendered: {error}") from error
        read = read_later(loss.detach())
        if loss.requires_grad:
            loss.backward()  # type: ignore[no-untyped-call]
        value = read()  # only now: a card has computed it meanwhile
        if not math.isfinite(value):
            for model in self.models:
                model.optimizer.clear_gradients()
            raise TrainingStoppedError(f"the loss became {value} at step {self.step + 1}: lower the learning rates.")
        if loss.requires_grad:
            for model, step in zip(self.models, steps, strict=True):
                for splats, camera in step.observed if model.density.observes(self.step) else ():
                    if splats.means.grad is not None:  # none if nothing was rendered, or no term saw it
                        model.density.observe(splats, camera)
                model.optimizer.set_means_rate(self.config.means_rate_at(self.step) * self._extent)
                model.optimizer.step()
        self.step += 1
        self.loss = value
        self._shown = steps[0].image.detach(), steps[0].view
        self.removed = None
        if self._guards and self.regularized:
            self._guard()
        steps.clear()  # each step refers to all: a cycle would keep their graphs until garbage collection
        return value

    def save(self, path: Path) -> None:
        """Write a checkpoint from which `load` continues to the identical result.

        Raises:
            TrainingStoppedError: if the model or the state of its optimizer is not finite: such a checkpoint would
                replace a good one.
            OSError: if it cannot be written; what was there before is kept.
        """
        # The first model's entries stand at the top, as in files of a single model.
        first, *others = [model.state_dict() for model in self.models]
        moved = [x for model in (first, *others) for x in (model["gaussians"], *model["moments"].values())]
        if not all(bool(x.isfinite().all()) for tensors in moved for x in tensors.values()):
            raise TrainingStoppedError(
                f"Gaussians became nan or infinite by step {self.step}, which is not saved: lower the learning rates."
            )
        state = {
            "config": json.dumps(dataclasses.asdict(self.config)),
            "scene": self.scene.name,
            "train_views": [view.name for view in self.scene.train],
            "fingerprints": fingerprints(self.scene),
            "step": self.step,
            "seconds": self.seconds,
            "processor_seconds": self.processor_seconds,
            **first,
            **({"others": others} if others else {}),
        }
        save_checkpoint(path, state)

    @classmethod
    def load(
        cls,
        path: Path,
        scene: Scene,
        device: torch.device | str = "cpu",
        *,
        refuse: Callable[[TrainConfig], None] = lambda config: None,
    ) -> Trainer:
        """Continue from a checkpoint.

        Args:
            path: of the checkpoint.
            scene: the scene that it was trained on.
            device: where to train.
            refuse: called with the settings in the file before anything is made of them; raises to refuse them.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a readable checkpoint, something in it is missing or does not fit, or it
                belongs to another scene or other training views, be it of the same names.
        """
        state = load_checkpoint(path, device)
        config, models = read_state(state, scene, path, refuse)
        try:
            trainer = cls(scene, config, device)
        except ValueError as error:
            raise ValueError(f"{path}, config: {error}") from error
        trainer.step = state["step"]
        trainer.seconds, trainer.processor_seconds = state["seconds"], state["processor_seconds"]
        try:
            for model, of_model in zip(trainer.models, models, strict=True):
                model.load_state_dict(of_model)
        except ValueError as error:
            raise ValueError(f"{path}, regularizer: {error}") from error
        return trainer

    def _refuse_draws_without_multiplier(self) -> None:
        """Raise a ValueError if a regularizer has no exact expectation."""
        with torch.no_grad():
            x = self.gaussians.params(self.views[0].camera)
            if self.regularizer.alpha_factor(x) is None:
                names = ", ".join(type(member).__name__ for member in self.regularizer)
                raise ValueError(
                    "analytic training needs draws that are independent factors of the opacities, which those of "
                    f"{names} are not: leave out analytic."
                )

    def _guard(self) -> None:
        """Remove from all models what hangs where nobody took a photograph, if it is time."""
        config, step = self.config, self.step
        if step < config.iterations and (step <= config.densify_from or step % config.guard):
            return
        for model in self.models:
            gaussians = model.gaussians.map(Tensor.detach)
            rendered = TrainedModel(gaussians, self.background, config.regularizers, step, self.sh_degree)
            found = guard(rendered, self.scene)
            if found.where:
                _log.info("step %d: %s", step, found)
                model.density.select(model.optimizer, found.keep)
                if model is self.models[0]:
                    self.removed = rendered, found

    def begin_steps(self) -> list[Step]:
        """Choose the view of the step and what regularizes it; return a `Step` for every model."""
        begun, steps, background = self.step >= self.config.regularize_from, list[Step](), self.background
        if self._draws_background:
            generator = stream(self.config.seed, self.step, "background", self.device)
            background = torch.rand(3, generator=generator, device=self.device)
        view = self.views[view_order(self.config.seed, self.step, len(self.views))].over(background, self.background)
        for model in self.models:
            step = Step(
                self.step,
                view,
                self.views,
                model.gaussians,
                model.regularizer if begun else Chain(),
                background,
                photographed_over=self.background,
                sh_degree=self.config.sh_degree_at(self.step + 1),
                seed=self.config.seed,
                renderer=self.renderer,
                absgrad="absgrad" in self.density.needs and self.density.observes(self.step),
                label=model.label,
                siblings=steps,
            )
            steps.append(step)
        return steps
