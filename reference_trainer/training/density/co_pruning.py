"""CoR-GS's density control: Gaussians without a counterpart in the other model are pruned."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ca_reg._check import check_count
from ca_reg.neighbors import nearest_distance
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.operations import refuse_not_finite
from reference_trainer.training.density.strategy import ControlledModel
from reference_trainer.training.errors import TrainingStoppedError

__all__ = ["CoPruning"]


class CoPruning(AdaptiveDensity):
    """`AdaptiveDensity` that also prunes where the models disagree (CoR-GS, Zhang et al. 2024, Sec. 3.3).

    Every ``every`` steps after ``densify_from``, to the end of the training, Gaussians that lack a neighbor nearer than
    ``distance`` in any other model are pruned; all models are compared before any is pruned. It needs ``models=2``.
    Defaults are the source's for LLFF (jiaw-z/CoR-GS 1db13a4, train.py, lines 284-301).

    Dropped Gaussians: not counted in the gradients, as in `AdaptiveDensity`; neighbors are sought among all.

    Args:
        distance: world units, positive: 5 in the worlds of LLFF, 10 in those of DTU.
        every: positive number of steps.

    Raises:
        TypeError: if ``every`` is no integer.
        ValueError: if one is out of range.
    """

    needs = frozenset({"models"})

    def __init__(self, distance: float = 5.0, every: int = 500) -> None:
        if not distance > 0:
            raise ValueError(f"distance must be positive, got {distance}.")
        check_count(every, "every", minimum=1, hint=": density control without it is 'adaptive'")
        self.distance, self.every = distance, every

    def together(self, models: Sequence[ControlledModel], step: int) -> None:
        """Prune all models."""
        if not (step > self.config.densify_from and step % self.every == 0):
            return
        for model in models:
            refuse_not_finite(model.optimizer, step)
        means = [model.gaussians.means.detach() for model in models]
        keeps = [
            torch.stack([nearest_distance(own, other) < self.distance for other in means if other is not own]).all(0)
            for own in means
        ]
        for model, keep in zip(models, keeps, strict=True):
            if not bool(keep.any()):
                raise TrainingStoppedError(
                    f"no Gaussian has one of another model within {self.distance:g} after step {step}: raise distance, "
                    "which is in world units."
                )
            assert isinstance(model.density, AdaptiveDensity)
            model.density.select(model.optimizer, keep)
