"""The training loop."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ca_reg import GaussianDropout, OpacityNoise, StartStop
from reference_trainer.camera import Camera
from reference_trainer.model.density import DensityStatistics, decay_opacity, densify, prune, reset_opacity
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer, LearningRates
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render import NotFiniteError, Splats, render
from reference_trainer.render.gsplat import GsplatSplats, load_gsplat_render
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.checkpoint import load_checkpoint, save_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.expectation import render_expectation
from reference_trainer.training.initial import initial_gaussians
from reference_trainer.training.interruption import hold_interrupts
from reference_trainer.training.losses import expected_photometric_loss, photometric_loss
from reference_trainer.training.randomness import stream, view_order
from reference_trainer.training.state import read_state

__all__ = ["Trainer", "TrainingStoppedError"]


class TrainingStoppedError(RuntimeError):
    """Training cannot go on; the message says why and what to try."""


class Trainer:
    """Fits Gaussians to the training views of a scene.

    Args:
        scene: photographs, cameras and initial points.
        config: all settings.
        device: where to train.

    Attributes:
        step: the number of steps taken.
        seconds: wall-clock time that they took.
        renderer: what draws the draws of the regularizers.

    Raises:
        ValueError: if the scene has no initial points.
        ImportError: if gsplat is to draw, and is missing.
        RuntimeError: if gsplat is to draw on something else than a CUDA device.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> trainer = Trainer(synthetic_scene(width=48, height=36, points=200), TrainConfig(iterations=2, dropout=0.2))
        >>> trainer.train()
        >>> trainer.step
        2
    """

    def __init__(self, scene: Scene, config: TrainConfig, device: torch.device | str = "cpu") -> None:
        self.scene = scene
        self.config = config
        self.device = torch.device(device)
        self.renderer = render if config.renderer == "torch" else load_gsplat_render(self.device)
        self.step = 0
        self.seconds = 0.0
        self.views = [view.to(self.device) for view in scene.train]
        self.background = scene.background.to(self.device)
        start = config.regularize_from
        self.dropout = GaussianDropout(StartStop(config.dropout, start), compensate=config.compensate)
        self.noise = OpacityNoise(StartStop(config.noise, start), clip=config.clip_noise)
        self.optimizer = GaussianOptimizer(initial_gaussians(scene, config).to(self.device), self._rates())
        self.statistics = DensityStatistics.zeros(len(self.gaussians), self.device)

    @property
    def gaussians(self) -> Gaussians:
        """The model as it stands."""
        return self.optimizer.gaussians

    @property
    def sh_degree(self) -> int:
        """The highest band of spherical harmonics that the last step used."""
        return self._sh_degree(self.step)

    @property
    def regularized(self) -> bool:
        """Whether the last step used the regularizers; of a model that has not begun, whether the first one will."""
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
            progress: whether to show a progress bar with loss, PSNR, count and time left.

        Raises:
            TrainingStoppedError: if the loss or the Gaussians are not finite, or no Gaussian is left.
            TrainingInterrupted: on Ctrl-C or SIGTERM, between two steps: what is saved then continues to the identical
                result.
        """
        from tqdm import tqdm

        last = self.config.iterations if until is None else min(until, self.config.iterations)
        with (
            hold_interrupts() as stop_if_interrupted,
            tqdm(total=self.config.iterations, initial=self.step, disable=not progress, mininterval=0.5) as bar,
        ):
            while self.step < last:
                stop_if_interrupted()
                start = time.perf_counter()
                loss, mse = self.train_step()
                self.seconds += time.perf_counter() - start
                if progress and self.step % 10 == 0:
                    psnr = -10 * math.log10(max(mse, 1e-12))
                    bar.set_postfix(loss=f"{loss:.4f}", psnr=f"{psnr:.2f}", gaussians=len(self.gaussians))
                bar.update()
                if after_step is not None:
                    after_step(self)
            stop_if_interrupted()  # the last step is no shelter

    def train_step(self) -> tuple[float, float]:
        """Take one step on one view; return the loss and the mean squared error of the (regularized) render."""
        config, step = self.config, self.step
        self._control_density()
        view = self.views[view_order(config.seed, step, len(self.views))]
        try:
            loss, image, splats = self._expected_loss(view) if self._is_analytic() else self._sampled_loss(view)
        except NotFiniteError as error:
            raise TrainingStoppedError(f"step {step + 1} cannot be rendered: {error}") from error
        value = loss.item()
        if not math.isfinite(value):
            raise TrainingStoppedError(f"the loss became {value} at step {step + 1}: lower the learning rates.")
        if splats.indices.numel() > 0:
            loss.backward()  # type: ignore[no-untyped-call]
            self._count(splats, view.camera)
            self.optimizer.set_means_rate(self._means_rate(step))
            self.optimizer.step()
        self.step += 1
        with torch.no_grad():
            mse = torch.mean((image.clamp(0, 1) - view.image) ** 2).item()
        return value, mse

    def save(self, path: Path) -> None:
        """Write a checkpoint from which `load` continues to the identical result.

        Raises:
            TrainingStoppedError: if the model or the state of its optimizer is not finite: such a checkpoint would
                replace a good one.
            OSError: if it cannot be written; what was there before is kept.
        """
        optimizer = self.optimizer.state_dict()
        tensors = [*optimizer["gaussians"].values(), *(x for of in optimizer["moments"].values() for x in of.values())]
        if not all(bool(x.isfinite().all()) for x in tensors):
            raise TrainingStoppedError(
                f"Gaussians became nan or infinite by step {self.step}, which is not saved: lower the learning rates."
            )
        state = {
            "config": json.dumps(dataclasses.asdict(self.config)),
            "scene": self.scene.name,
            "train_views": [view.name for view in self.scene.train],
            "step": self.step,
            "seconds": self.seconds,
            "statistics": vars(self.statistics),
            **optimizer,
        }
        save_checkpoint(path, state)

    @classmethod
    def load(cls, path: Path, scene: Scene, device: torch.device | str = "cpu") -> Trainer:
        """Continue from a checkpoint.

        Args:
            path: of the checkpoint.
            scene: the scene that it was trained on.
            device: where to train.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a readable checkpoint, something in it is missing or does not fit, or it
                belongs to another scene or other training views.
        """
        state = read_state(load_checkpoint(path, device), scene, path)
        try:
            trainer = cls(scene, state.config, device)
        except ValueError as error:
            raise ValueError(f"{path}, config: {error}") from error
        trainer.step, trainer.seconds, trainer.statistics = state.step, state.seconds, state.statistics
        trainer.optimizer.load_state_dict(state.optimizer)
        return trainer

    def _rates(self) -> LearningRates:
        config = self.config
        return LearningRates(
            means=self._means_rate(0),
            log_scales=config.scales_rate,
            quaternions=config.quaternions_rate,
            opacity_logits=config.opacity_rate,
            sh_dc=config.color_rate,
            sh_rest=config.color_rate / 20,
        )

    def _sh_degree(self, number: int) -> int:
        """Highest band of spherical harmonics of the step with this number, the first being 1."""
        return min(self.config.sh_degree, number // self.config.sh_every)

    def _means_rate(self, step: int) -> float:
        """Learning rate of the means: falls exponentially over the run, in world units."""
        config = self.config
        along = step / config.iterations
        rate = math.exp((1 - along) * math.log(config.means_rate) + along * math.log(config.means_rate_final))
        return rate * self.scene.extent

    def _regularized(self) -> Tensor:
        """Opacities of this step: some dropped, some shaken."""
        opacities = self.gaussians.opacities
        for regularizer, name in ((self.dropout, "dropout"), (self.noise, "noise")):
            regularizer.set_step(self.step)
            opacities = regularizer(opacities, generator=stream(self.config.seed, self.step, name, self.device))
        return opacities

    def _is_analytic(self) -> bool:
        """Whether this step trains on the expectation over the regularizers."""
        return self.config.analytic and self.step >= self.config.regularize_from

    def _sampled_loss(self, view: View) -> tuple[Tensor, Tensor, Splats]:
        """Loss and image of one draw of the regularizers."""
        rendering = render_gaussians(
            self.gaussians,
            view.camera,
            self.background,
            opacities=self._regularized(),
            sh_degree=self._sh_degree(self.step + 1),
            renderer=self.renderer,
        )
        return (
            photometric_loss(rendering.image, view.image, self.config.lambda_dssim),
            rendering.image,
            rendering.splats,
        )

    def _expected_loss(self, view: View) -> tuple[Tensor, Tensor, Splats]:
        """Loss and image in expectation over the regularizers."""
        degree = self._sh_degree(self.step + 1)
        out = render_expectation(self.gaussians, view.camera, self.background, self.config, sh_degree=degree)
        loss = expected_photometric_loss(out.image, out.variance, view.image, self.config.lambda_dssim)
        return loss + out.penalty, out.image, out.splats

    def _count(self, splats: Splats | GsplatSplats, camera: Camera) -> None:
        """Enter the Gaussians that were drawn into the densification statistics."""
        gradient = splats.projection.means.grad
        assert gradient is not None
        drawn = splats.lists.touched
        self.statistics.update(splats.indices[drawn], gradient[drawn], camera.width, camera.height)

    def _control_density(self) -> None:
        """Densify, prune, reset and decay as the schedule says for the steps that are done.

        This happens before a step and not after it, so that whoever looks at the model between steps finds it
        optimized: a clone doubles the opacity of its place until the next steps have adapted to it.
        """
        config, step = self.config, self.step
        until = config.iterations if config.densify_until is None else config.densify_until
        if config.opacity_decay < 1 and step > config.densify_from:
            decay_opacity(self.optimizer, config.opacity_decay)
        every = config.densify_every
        if every and config.densify_from < step < until and step % every == 0:
            # The renderer would tell, but only after pruning has taken for faint what is not a number.
            if not all(bool(x.isfinite().all()) for _, x in self.gaussians.named()):
                raise TrainingStoppedError(
                    f"Gaussians became nan or infinite by step {step}: lower the learning rates."
                )
            self._densify()
            if len(self.gaussians) == 0:
                raise TrainingStoppedError(
                    f"all Gaussians were pruned after step {step}: lower prune_opacity or noise, raise opacity_reset."
                )
        if config.opacity_reset_every and step < until:
            since = step - config.opacity_reset_from
            early = config.opacity_reset_over_white and step == config.densify_from > 0
            if (since >= 0 and since % config.opacity_reset_every == 0) or (early and self.scene.is_white):
                reset_opacity(self.optimizer, config.opacity_reset)

    def _densify(self) -> None:
        config = self.config
        if config.max_gaussians is None or len(self.gaussians) < config.max_gaussians:
            densify(
                self.optimizer,
                self.statistics,
                gradient_threshold=config.densify_gradient,
                size_threshold=config.dense_fraction * self.scene.extent,
                generator=stream(config.seed, self.step, "split", self.device),
            )
        max_scale = None
        if config.prune_size is not None and self.step > config.prune_size_from:
            max_scale = config.prune_size * self.scene.extent
        prune(self.optimizer, min_opacity=config.prune_opacity, max_scale=max_scale)
        self.statistics = DensityStatistics.zeros(len(self.gaussians), self.device)
