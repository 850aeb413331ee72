"""The density control of the INRIA code (Kerbl et al. 2023, Sec. 5.2), with the options of its descendants."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.render import ViewSplats
from reference_trainer.training.density.operations import (
    clone,
    decay_opacity,
    is_large,
    prune,
    refuse_not_finite,
    reset_opacity,
    split,
)
from reference_trainer.training.density.statistics import DensityStatistics
from reference_trainer.training.density.strategy import DensityStrategy
from reference_trainer.training.errors import TrainingStoppedError
from reference_trainer.training.randomness import stream

__all__ = ["AdaptiveDensity"]


class AdaptiveDensity(DensityStrategy):
    """Clones and splits where the gradient of the projected centers is large, prunes what is faint, resets opacities.

    All thresholds and steps are those of `TrainConfig`; ``opacity_decay`` below 1 makes it Binocular3DGS's. Gaussians
    dropped in a step are not counted in it; like all others they are pruned, reset and decayed by plain opacity.
    """

    resets = True

    def reset(self, count: int) -> None:
        """Forget the gradients."""
        self.statistics = DensityStatistics.zeros(count, self.device, absolute="absgrad" in self.needs)

    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Densify, prune, reset and decay as scheduled after ``step`` steps."""
        config = self.config
        if config.opacity_decay < 1 and step > config.densify_from:
            decay_opacity(optimizer, config.opacity_decay)
        if self.is_due(step):
            refuse_not_finite(optimizer, step)
            self.densify(optimizer, step)
            if len(optimizer.gaussians) == 0:
                raise TrainingStoppedError(
                    f"all Gaussians were pruned after step {step}: lower prune_opacity or noise, raise opacity_reset."
                )
            self.reset(len(optimizer.gaussians))
        if config.opacity_reset_every and step < self.config.densify_end:
            since = step - config.opacity_reset_from
            early = config.opacity_reset_over_white and step == config.densify_from > 0
            if (since >= 0 and since % config.opacity_reset_every == 0) or (early and self.scene.is_white):
                reset_opacity(optimizer, config.opacity_reset)

    def densify(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Grow and prune once."""
        config = self.config
        if config.max_gaussians is None or len(optimizer.gaussians) < config.max_gaussians:
            self.grow(optimizer, step)
        size = config.prune_size if step > config.prune_size_from else None
        prune(optimizer, min_opacity=config.prune_opacity, max_scale=None if size is None else size * self.extent)

    def grow(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Clone and split once."""
        selected, large = self.selected(optimizer), is_large(optimizer, self.large)
        clone(optimizer, selected & ~large)
        split(optimizer, selected & large, generator=self.split_generator(step))

    def selected(self, optimizer: GaussianOptimizer) -> Tensor:
        """Return which Gaussians are to be cloned if they are small, and split if they are large, shape (N,) bool."""
        return self.statistics.mean_gradient >= self.config.densify_gradient

    def select(self, optimizer: GaussianOptimizer, keep: Tensor) -> None:
        """Keep some Gaussians, (N,) bool, with their statistics."""
        optimizer.select(keep)
        self.statistics = self.statistics[keep]

    def split_generator(self, step: int) -> torch.Generator:
        """Return the random generator for the splits of a step."""
        return stream(self.config.seed, step, "split", self.device)

    def observes(self, step: int) -> bool:
        """Whether densification has not ended."""
        return step < self.config.densify_end

    def observe(self, splats: ViewSplats, camera: Camera) -> None:
        """Count the gradients of the Gaussians that were drawn."""
        means = splats.means
        assert means.grad is not None
        absolute = means.absgrad if "absgrad" in self.needs else None  # type: ignore[attr-defined]
        self.statistics.update(splats.indices, splats.touched, means.grad, camera.width, camera.height, absolute)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the statistics."""
        return self.statistics.named()

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the statistics."""
        self.statistics = DensityStatistics(**state)
