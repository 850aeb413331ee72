"""The base class of every density control: when and where Gaussians are added and removed."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.render import ViewSplats
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.model_state import ModelState

__all__ = ["DensityStrategy"]


class DensityStrategy(abc.ABC):
    """Adds and removes Gaussians between the steps; custom strategies are subclasses.

    It is made from its arguments alone and told of the training by `begin`. Every step the trainer calls `before_step`,
    then `observe` for every render that trains, then updates the Gaussians. What it counts must be in `state_dict`, so
    that a resumed training is the same.

    Gaussians that a regularizer dropped are not rendered: `observe` must not count them as seen. If they were counted
    with their gradient of zero, a threshold would in effect rise by 1 / (1 - p).

    Attributes:
        needs: what it requires: ``"absgrad"`` of the renderer, for ``splats.means.absgrad``, the sums of
            absolute gradients; ``"models"`` of the training, at least two.
        resets: whether it obeys the ``opacity_reset`` settings.
        index: which of the training's models it controls, the first being 0.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    resets: ClassVar[bool] = False
    index: int = 0

    config: TrainConfig
    scene: Scene
    extent: float
    large: float
    device: torch.device

    def begin(self, config: TrainConfig, scene: Scene, device: torch.device, count: int) -> None:
        """Prepare for a training.

        Args:
            config: all settings.
            scene: its extent in world units is the unit of sizes.
            device: of the Gaussians.
            count: their number.
        """
        # Every model has its own random splits: those of seeds below 2^32 never meet.
        self.config = replace(config, seed=config.seed + (self.index << 32))
        self.scene, self.extent, self.device = scene, scene.extent, device
        self.large = config.dense_fraction * self.extent  # what is larger is split, what is smaller cloned
        self.reset(count)

    def is_due(self, step: int) -> bool:
        """Whether the schedule densifies before this step."""
        every = self.config.densify_every
        return bool(every) and self.config.densify_from < step < self.config.densify_end and step % every == 0

    def reset(self, count: int) -> None:  # noqa: B027 (not every strategy counts)
        """Start counting anew, for ``count`` Gaussians."""

    @abc.abstractmethod
    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Change the set of Gaussians before the step with this number, the first being 0.

        Before a step and not after it, so that between steps the model is always optimized: a clone lays a second splat
        over the first until further steps have adapted to it.

        Raises:
            TrainingStoppedError: if the Gaussians are not finite, or none is left.
        """

    def select(self, optimizer: GaussianOptimizer, keep: Tensor) -> None:
        """Keep some Gaussians, (N,) bool, with all that is counted of them."""
        optimizer.select(keep)

    def together(self, models: Sequence[ModelState[DensityStrategy]], step: int) -> None:  # noqa: B027
        """Change models by comparing them with each other: pruning what another one lacks, for example.

        Called once a step, of the first model's strategy, after `before_step` of every model's. Most
        strategies look at one model alone and do nothing here.
        """

    def observes(self, step: int) -> bool:
        """Whether `observe` is to be called at a step, with what the strategy needs of the renderer."""
        return True

    def observe(self, splats: ViewSplats, camera: Camera) -> None:  # noqa: B027
        """Count a render whose gradients have been computed.

        Args:
            splats: what was rendered; ``splats.means.grad`` is the gradient per pixel of the projected centers.
            camera: of the render.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return the counts as float32 tensors by name."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:  # noqa: B027
        """Restore what `state_dict` returned."""
