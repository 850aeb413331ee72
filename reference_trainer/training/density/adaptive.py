"""The density control of the INRIA code (Kerbl et al. 2023, Sec. 5.2), and AbsGS's."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from ca_reg._check import check_count
from reference_trainer.camera import Camera
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.render import ViewSplats
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density.operations import (
    DensityStatistics,
    clone,
    decay_opacity,
    is_large,
    prune,
    refuse_not_finite,
    reset_opacity,
    split,
)
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.model_state import DensityStrategy
from reference_trainer.training.randomness import stream

__all__ = ["AbsGradDensity", "AdaptiveDensity"]


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
        # Before pruning, so that what has decayed below its threshold goes at once.
        if config.opacity_decay < 1 and step > config.densify_from:
            decay_opacity(optimizer, config.opacity_decay)
        if self.is_due(step):
            refuse_not_finite(optimizer, step)
            self.densify(optimizer, step)
            if len(optimizer.gaussians) == 0:
                raise TrainingStoppedError(
                    f"all Gaussians were pruned after step {step}: lower prune_opacity or noise, or raise "
                    "opacity_reset, opacity_decay or prune_size."
                )
            # Sums over the old set mean nothing for the new one.
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
        # Both decided before either acts: a clone must not be split in the same step.
        selected, large = self.selected(optimizer), is_large(optimizer, self.large)
        clone(optimizer, selected & ~large)
        split(optimizer, selected & large, generator=self.split_generator(step))

    def selected(self, optimizer: GaussianOptimizer) -> Tensor:
        """Return which Gaussians are to be cloned if they are small, and split if they are large, shape (N,) bool."""
        return self.statistics.mean_gradient >= self.config.densify_gradient

    def select(self, optimizer: GaussianOptimizer, keep: Tensor) -> None:
        """Keep some Gaussians, (N,) bool, with their statistics."""
        super().select(optimizer, keep)
        self.statistics = self.statistics[keep]

    def split_generator(self, step: int) -> torch.Generator:
        """Return the random generator for the splits of a step."""
        return stream(self.config.seed, step, "split", self.device)

    def observes(self, step: int) -> bool:
        """Whether densification has not ended."""
        return step < self.config.densify_end

    def observe(self, splats: ViewSplats, camera: Camera) -> None:
        """Count the gradients of the Gaussians that were rendered."""
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


class AbsGradDensity(AdaptiveDensity):
    """Clones by the gradient of the projected center, splits by the sum of its absolute values over the pixels (AbsGS).

    Pixels pull a Gaussian that is too large in different directions, and their gradients cancel: AbsGS (Ye et al. 2024)
    splits where ``mean over the steps of |(sum |g_x|, sum |g_y|)|`` is large, the sums over the pixels. All else is
    `AdaptiveDensity` with the settings of `TrainConfig`, but for two of them, which are arguments here.
    Defaults are the source's (TY424/AbsGS 87d7a5a, arguments/__init__.py); its pruning by pixel weight is off there.

    Dropped Gaussians: neither sum counts a step that dropped them.

    Args:
        clone_gradient: threshold of the signed gradient, in place of ``densify_gradient``.
        split_gradient: threshold of the absolute gradient.
        dense_fraction: larger Gaussians are split, smaller ones cloned, as with the setting of this name.
        opacity_ceiling: value that higher opacities are regularly lowered to, in (0, 1).
        ceiling_every: number of steps between these, until densification ends; 0 never lowers.
    """

    needs = frozenset({"absgrad"})

    def __init__(
        self,
        clone_gradient: float = 2e-4,
        split_gradient: float = 4e-4,
        dense_fraction: float = 1e-3,
        opacity_ceiling: float = 0.8,
        ceiling_every: int = 500,
    ) -> None:
        given = {"clone_gradient": clone_gradient, "split_gradient": split_gradient, "dense_fraction": dense_fraction}
        for name, value in given.items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value}.")
        check_count(ceiling_every, "ceiling_every", minimum=0, hint=": 0 turns it off")
        if not 0 < opacity_ceiling < 1:
            raise ValueError(f"opacity_ceiling must be in (0, 1), got {opacity_ceiling}: ceiling_every=0 turns it off.")
        self.settings = {"densify_gradient": clone_gradient, "dense_fraction": dense_fraction}
        self.split_gradient, self.opacity_ceiling, self.ceiling_every = split_gradient, opacity_ceiling, ceiling_every

    def begin(self, config: TrainConfig, scene: Scene, device: torch.device, count: int) -> None:
        """Replace two settings by this strategy's own."""
        super().begin(dataclasses.replace(config, **self.settings), scene, device, count)  # type: ignore[arg-type]

    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Do as the base class, then lower opacities if it is time."""
        super().before_step(optimizer, step)
        if self.ceiling_every and 0 < step < self.config.densify_end and step % self.ceiling_every == 0:
            reset_opacity(optimizer, self.opacity_ceiling)

    def selected(self, optimizer: GaussianOptimizer) -> Tensor:
        """Select large Gaussians by their absolute gradients."""
        seen = self.statistics
        assert seen.absolute_sum is not None
        # A mean over the steps that rendered it, like the signed gradient that decides about clones.
        torn = seen.absolute_sum / seen.steps.clamp(min=1) >= self.split_gradient
        return torch.where(is_large(optimizer, self.large), torn, super().selected(optimizer))
