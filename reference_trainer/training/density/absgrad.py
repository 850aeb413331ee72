"""AbsGS's density control: absolute gradients, which do not cancel between pixels, decide what to split."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ca_reg._check import check_count
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.operations import is_large, reset_opacity

__all__ = ["AbsGradDensity"]


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

    Raises:
        TypeError: if ``ceiling_every`` is no integer.
        ValueError: if one is out of range.
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
        torn = seen.absolute_sum / seen.steps.clamp(min=1) >= self.split_gradient
        return torch.where(is_large(optimizer, self.large), torn, super().selected(optimizer))
