"""3DGS-MCMC's density control: dead Gaussians move to live ones, their number grows, and noise explores."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ca_reg._check import check_finite
from reference_trainer.model.gaussians import Gaussians, compute_relocation
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.rotations import rotation_matrices
from reference_trainer.training.density.operations import refuse_not_finite
from reference_trainer.training.model_state import DensityStrategy
from reference_trainer.training.randomness import stream

__all__ = ["MCMCDensity"]

_MOST = 50  # Gaussians at one place; more are treated as this many
_OPACITIES = 0.005, 1 - torch.finfo(torch.float32).eps  # least and greatest opacity of a copy


class MCMCDensity(DensityStrategy):
    """Relocates dead Gaussians, adds some, and moves all by noise (3DGS-MCMC, Kheradmand et al. 2024, Sec. 3).

    When the schedule densifies, every Gaussian with an opacity of at most ``prune_opacity`` becomes a copy of a live
    one drawn by opacity. Then further copies, drawn likewise, raise the number of Gaussians by the factor ``growth``,
    up to ``max_gaussians``. The n at one place get the opacity ``1 - (1 - o)^(1/n)`` and the scales of equation 9, so
    that they look as the one did; the optimizer state of those drawn is cleared. After every step all centers move by
    ``Sigma xi``, xi normal with standard deviation ``noise x (rate of the means) x sigmoid(100 (0.005 - o))``: only
    faint Gaussians move visibly.

    Of `TrainConfig` it reads seed, schedule (``densify_from``, ``_until``, ``_every``), ``prune_opacity``,
    ``max_gaussians`` and the rate of the means; there are no splits, resets or decay. Defaults are the source's
    (ubc-vision/3dgs-mcmc 7b4fc9f), which also has ``densify_until=25_000`` of 30,000 steps, ``initial_opacity=0.5``,
    ``initial_scale=0.1``, a limit for every scene, and a loss of 0.01 times the mean opacity and 0.01 times the mean
    scale, without which few Gaussians die.

    Dropped Gaussians: treated like all others, by their plain opacities; gradients are not used. It has no state: its
    random numbers depend on seed and step.

    Args:
        noise: strength of the exploration noise, at least 0.
        growth: factor on the number of Gaussians, at least 1.
    """

    def __init__(self, noise: float = 5e5, growth: float = 1.05) -> None:
        check_finite(noise, "noise", minimum=0, hint=": 0 turns it off")
        check_finite(growth, "growth", minimum=1, hint=": 1 adds nothing")
        self.noise, self.growth = noise, growth

    @torch.no_grad()
    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Relocate and grow as scheduled after ``step`` steps, and move the centers."""
        if self.is_due(step):
            refuse_not_finite(optimizer, step)
            generator = stream(self.config.seed, step, "relocation", self.device)
            relocate(optimizer, optimizer.gaussians.opacities <= self.config.prune_opacity, generator)
            n, limit = len(optimizer.gaussians), self.config.max_gaussians
            target = int(self.growth * n) if limit is None else min(limit, int(self.growth * n))
            if target > n:
                optimizer.append(drawn_copies(optimizer, optimizer.gaussians.opacities, target - n, generator))
        if step and self.noise:
            gaussians = optimizer.gaussians
            axes = rotation_matrices(gaussians.quaternions) * gaussians.scales[:, None]
            generator = stream(self.config.seed, step, "exploration", self.device)
            # Sigma xi = R S S' R' xi: noise in the shape of the Gaussian, so that flat ones stay in
            # their surface. The factor of the opacity leaves opaque ones where they are.
            xi = torch.empty_like(gaussians.means).normal_(generator=generator)
            xi *= torch.sigmoid(100 * (0.005 - gaussians.opacities))[:, None]
            xi *= self.noise * self.config.means_rate_at(step - 1) * self.extent
            gaussians.means.add_((axes @ (axes.mT @ xi[:, :, None])).squeeze(-1))


def relocate(optimizer: GaussianOptimizer, dead: Tensor, generator: torch.Generator) -> None:
    """Make dead Gaussians, (N,) bool, copies of live ones; if none is alive, nothing happens."""
    if bool(dead.any()) and not bool(dead.all()):
        living = torch.where(dead, 0, optimizer.gaussians.opacities)
        optimizer.relocate(dead.nonzero().squeeze(1), drawn_copies(optimizer, living, int(dead.sum()), generator))


def drawn_copies(optimizer: GaussianOptimizer, weights: Tensor, count: int, generator: torch.Generator) -> Gaussians:
    """Return copies of Gaussians drawn in proportion to weights (N,).

    Copies and originals get the opacities and scales with which all at one place look as the one did.
    """
    drawn = torch.multinomial(weights, count, replacement=True, generator=generator)
    copies = optimizer.gaussians[drawn]
    at_one_place = drawn.bincount(minlength=len(weights))[drawn] + 1
    table = [[math.comb(n, k) for k in range(_MOST)] for n in range(_MOST)]
    binoms = torch.tensor(table, dtype=torch.float64, device=drawn.device)
    opacities, scales = compute_relocation(copies.opacities, copies.scales, at_one_place, binoms)
    logits = torch.logit(opacities.clamp(*_OPACITIES))
    copies = replace(copies, opacity_logits=logits, log_scales=scales.log())
    optimizer.relocate(drawn, copies)
    optimizer.forget(drawn)
    return copies
