"""Density control that removes the Gaussians that co-adapt most for what they contribute."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg import attribute
from ca_reg._check import check_count
from reference_trainer.evaluation.shares import all_but_highest, blend_weights, share_per_weight
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.operations import refuse_not_finite

__all__ = ["SharePruning"]


class SharePruning(AdaptiveDensity):
    """`AdaptiveDensity` that also prunes by the share of the exact score per blend weight.

    Every ``every`` steps between ``densify_from`` and ``densify_until`` this removes the ``fraction`` of the Gaussians
    whose `ca_reg.attribute` shares, summed over the training views, are highest relative to their blend weights; those
    without a share stay. Not a published method: in docs/studies.md, where finished models were pruned, this criterion
    lowered the score most at equal count. Each time costs an exact score, its shares and a backward pass per training
    view.

    Dropped Gaussians: not counted in the gradients, as in `AdaptiveDensity`; shares and weights are those of the plain
    opacities, without draws or test-time scaling.

    Args:
        every: positive number of steps.
        fraction: of the Gaussians, in (0, 1).
        drop_rate: of the score, in (0, 1).

    Raises:
        TypeError: if ``every`` is no integer.
        ValueError: if one is out of range.
    """

    def __init__(self, every: int = 500, fraction: float = 0.02, drop_rate: float = 0.5) -> None:
        check_count(every, "every", minimum=1, hint=": density control without it is 'adaptive'")
        for name, value in (("fraction", fraction), ("drop_rate", drop_rate)):
            if not 0 < value < 1:
                raise ValueError(f"{name} must be in (0, 1), got {value}.")
        self.every, self.fraction, self.drop_rate = every, fraction, drop_rate

    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Prune by share as well, after all else; the other Gaussians keep their statistics."""
        super().before_step(optimizer, step)
        if self.config.densify_from < step < self.config.densify_end and step % self.every == 0:
            refuse_not_finite(optimizer, step)
            self.select(optimizer, all_but_highest(self.shares_per_weight(optimizer, step), self.fraction))

    def shares_per_weight(self, optimizer: GaussianOptimizer, step: int) -> Tensor:
        """Return each current Gaussian's share per blend weight over the training views, shape (N,), float64."""
        model = TrainedModel(
            optimizer.gaussians.map(torch.Tensor.detach),
            self.scene.background.to(self.device),
            sh_degree=self.config.sh_degree_at(step),
        )
        views = [view.to(self.device) for view in self.scene.train]
        score, opacities = model.exact_ca_score(drop_rate=self.drop_rate), model.gaussians.opacities
        shares = torch.stack([attribute(score, model.shares, opacities, view).shares for view in views]).sum(0)
        return share_per_weight(shares, blend_weights(model, views))
