"""Density control: where Gaussians are cloned, split and pruned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from reference_trainer.model.gaussians import Gaussians, inverse_sigmoid
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.render.eager.projection import rotation_matrices

__all__ = ["DensityStatistics", "decay_opacity", "densify", "prune", "reset_opacity"]

_SPLIT_INTO = 2
_SPLIT_SHRINK = 0.8 * _SPLIT_INTO  # children of a split are this much smaller, as in the INRIA code


@dataclass
class DensityStatistics:
    """What was seen of every Gaussian since the last densification.

    A Gaussian that a step did not draw (outside the view, or dropped by a regularizer) is not counted in that step. If
    dropped Gaussians were counted with their zero gradient, the threshold would in effect rise by 1 / (1 - p).

    Args:
        gradient_sum: summed norms of the loss gradient with respect to the projected centre, in units of half the image
            size per unit (the INRIA code's normalised device coordinates), shape (N,).
        steps: the number of steps that drew it, shape (N,).
    """

    gradient_sum: Tensor
    steps: Tensor

    @classmethod
    def zeros(cls, count: int, device: torch.device | str = "cpu") -> DensityStatistics:
        """Return empty statistics of ``count`` Gaussians."""
        return cls(*(torch.zeros(count, device=device) for _ in range(2)))

    def update(self, indices: Tensor, gradient: Tensor, width: int, height: int) -> None:
        """Count one step.

        Args:
            indices: the Gaussians that were drawn, shape (M,).
            gradient: of the loss with respect to their projected centres, per pixel, shape (M, 2).
            width: image width, pixels.
            height: image height, pixels.
        """
        half_size = gradient.new_tensor([0.5 * width, 0.5 * height])
        self.gradient_sum[indices] += (gradient * half_size).norm(dim=1).to(self.gradient_sum)
        self.steps[indices] += 1

    @property
    def mean_gradient(self) -> Tensor:
        """Mean gradient norm over the steps that drew a Gaussian; 0 where none did, shape (N,)."""
        return self.gradient_sum / self.steps.clamp(min=1)


def densify(
    optimizer: GaussianOptimizer,
    statistics: DensityStatistics,
    *,
    gradient_threshold: float,
    size_threshold: float,
    generator: torch.Generator | None = None,
) -> None:
    """Clone small and split large Gaussians whose mean gradient reaches a threshold (Kerbl et al. 2023, Sec. 5.2).

    A clone is an exact copy. A split Gaussian is replaced by two smaller ones drawn from it.

    Args:
        optimizer: holds the Gaussians; changed.
        statistics: of these Gaussians.
        gradient_threshold: see `DensityStatistics.gradient_sum`.
        size_threshold: Gaussians whose largest standard deviation exceeds it are split, others cloned; world units.
        generator: for the positions of the children.
    """
    gaussians = optimizer.gaussians.map(torch.Tensor.detach)
    selected = statistics.mean_gradient >= gradient_threshold
    large = gaussians.scales.amax(dim=1) > size_threshold
    clones = gaussians[selected & ~large]
    split = selected & large
    parents = gaussians[split].map(lambda x: x.repeat(_SPLIT_INTO, *[1] * (x.ndim - 1)))
    noise = torch.randn(len(parents), 3, generator=generator, dtype=parents.means.dtype, device=parents.means.device)
    offsets = (rotation_matrices(parents.quaternions) @ (noise * parents.scales)[:, :, None]).squeeze(-1)
    children = Gaussians(
        means=parents.means + offsets,
        log_scales=parents.log_scales - math.log(_SPLIT_SHRINK),
        quaternions=parents.quaternions,
        opacity_logits=parents.opacity_logits,
        sh_dc=parents.sh_dc,
        sh_rest=parents.sh_rest,
    )
    optimizer.select(~split)
    optimizer.append(clones)
    optimizer.append(children)


def prune(optimizer: GaussianOptimizer, *, min_opacity: float, max_scale: float | None = None) -> int:
    """Remove Gaussians that are too faint or too large.

    Args:
        optimizer: holds the Gaussians; changed.
        min_opacity: fainter ones go; compared with the plain opacity, without any regularizer.
        max_scale: Gaussians with a larger standard deviation go, world units; None keeps them.

    Returns:
        How many were removed.
    """
    with torch.no_grad():
        gaussians = optimizer.gaussians
        keep = gaussians.opacities >= min_opacity
        if max_scale is not None:
            keep &= gaussians.scales.amax(dim=1) <= max_scale
        removed = int((~keep).sum())
    if removed:
        optimizer.select(keep)
    return removed


def reset_opacity(optimizer: GaussianOptimizer, ceiling: float) -> None:
    """Lower every opacity to at most ``ceiling`` and forget its optimizer state (Kerbl et al. 2023, Sec. 5.2)."""
    logits = optimizer.gaussians.opacity_logits.detach().clamp(max=math.log(ceiling / (1 - ceiling)))
    optimizer.set_opacity_logits(logits, forget=True)


def decay_opacity(optimizer: GaussianOptimizer, factor: float) -> None:
    """Multiply every opacity by ``factor`` (Binocular3DGS's opacity decay); the optimizer state stays."""
    opacities = optimizer.gaussians.opacities.detach() * factor
    # The floor keeps the logit finite; a Gaussian this faint is pruned long before.
    optimizer.set_opacity_logits(inverse_sigmoid(opacities.clamp(min=1e-7)), forget=False)
