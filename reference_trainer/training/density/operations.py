"""What every density control uses: statistics of the Gaussians, and operations on them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ca_reg.functional import decayed_logits
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.render.engine import engine_for
from reference_trainer.rotations import rotation_matrices
from reference_trainer.training.interruption import TrainingStoppedError

__all__ = [
    "DensityStatistics", "clone", "decay_opacity", "is_large", "prune", "refuse_not_finite", "reset_opacity",
    "split",
]  # fmt: skip


@dataclass
class DensityStatistics:
    """Gradients of every Gaussian, and steps that rendered it, since the last densification.

    A Gaussian that a step did not render (outside the view, or dropped by a regularizer) is not counted in that step.

    Args:
        gradient_sum: summed norms of the loss gradient with respect to the projected center in normalized device
            coordinates, as in the INRIA code: times half the image size, shape (N,).
        steps: the number of steps that rendered it, shape (N,).
        absolute_sum: as ``gradient_sum``, of absolute gradients; None where they are not used.
    """

    gradient_sum: Tensor
    steps: Tensor
    absolute_sum: Tensor | None = None

    @classmethod
    def zeros(cls, count: int, device: torch.device | str = "cpu", *, absolute: bool = False) -> DensityStatistics:
        """Return empty statistics of ``count`` Gaussians."""
        return cls(*(torch.zeros(count, device=device) for _ in range(2 + absolute)))

    def update(
        self,
        indices: Tensor,
        rendered: Tensor,
        gradient: Tensor,
        width: int,
        height: int,
        absolute: Tensor | None = None,
    ) -> None:
        """Count one step.

        Args:
            indices: the Gaussians that may have been rendered, each once, shape (M,).
            rendered: which of them were, shape (M,) bool.
            gradient: of the loss with respect to their projected centers, per pixel; 0 if not rendered, shape (M, 2).
            width: image width, pixels.
            height: image height, pixels.
            absolute: the sums over the pixels of the absolute gradients, shape (M, 2).
        """
        if engine_for(gradient.device, gradient.dtype).name == "triton":
            from reference_trainer.training.density._statistics_triton import count_gradients

            sums = self.gradient_sum, self.steps, self.absolute_sum
            count_gradients(indices, rendered, gradient, absolute, *sums, width, height)
            return
        for total, x in ((self.gradient_sum, gradient), (self.absolute_sum, absolute)):
            if total is not None and x is not None:
                # From pixels to normalized device coordinates, in which thresholds do not depend on
                # the size of the image.
                norms = torch.hypot(0.5 * width * x[:, 0], 0.5 * height * x[:, 1])
                total.index_add_(0, indices, norms.to(total))
        self.steps.index_add_(0, indices, rendered.to(self.steps))

    def named(self) -> dict[str, Tensor]:
        """Return the statistics that are kept, by name."""
        return {name: x for name, x in vars(self).items() if x is not None}

    def __getitem__(self, index: Tensor) -> DensityStatistics:
        """Return the statistics of some Gaussians."""
        return DensityStatistics(**{name: x[index] for name, x in self.named().items()})

    @property
    def mean_gradient(self) -> Tensor:
        """Mean gradient norm over the steps that rendered a Gaussian; 0 where none did, shape (N,)."""
        return self.gradient_sum / self.steps.clamp(min=1)


_SPLIT_INTO = 2
_SPLIT_SHRINK = 0.8 * _SPLIT_INTO  # children of a split are smaller by this factor, as in the INRIA code


def clone(optimizer: GaussianOptimizer, selected: Tensor) -> None:
    """Add exact copies of the selected Gaussians, (N,) bool, at the end."""
    # A clone's optimizer state starts at 0 and the original's does not: this moves the two apart.
    optimizer.append(optimizer.gaussians[selected].map(torch.Tensor.detach))


def split(optimizer: GaussianOptimizer, selected: Tensor, *, generator: torch.Generator | None = None) -> None:
    """Replace each selected Gaussian by two smaller ones, at positions drawn from it, appended at the end.

    Args:
        optimizer: holds the Gaussians; changed.
        selected: which of them, (N,) bool; may be shorter, leaving out those that have been added since.
        generator: for the positions of the children.
    """
    gaussians = optimizer.gaussians.map(torch.Tensor.detach)
    selected = torch.nn.functional.pad(selected, (0, len(gaussians) - len(selected)))
    parents = gaussians[selected].map(lambda x: x.repeat(_SPLIT_INTO, *[1] * (x.ndim - 1)))
    noise = torch.randn(len(parents), 3, generator=generator, dtype=parents.means.dtype, device=parents.means.device)
    # Drawn from the parent itself: standard normal, scaled along its axes, turned into the world.
    offsets = (rotation_matrices(parents.quaternions) @ (noise * parents.scales)[:, :, None]).squeeze(-1)
    smaller = parents.log_scales - math.log(_SPLIT_SHRINK)
    optimizer.select(~selected)
    optimizer.append(replace(parents, means=parents.means + offsets, log_scales=smaller))


def is_large(optimizer: GaussianOptimizer, size: float) -> Tensor:
    """Return which Gaussians have a standard deviation above ``size``, in world units; shape (N,) bool."""
    return optimizer.gaussians.scales.detach().amax(dim=1) > size


def refuse_not_finite(optimizer: GaussianOptimizer, step: int) -> None:
    """Raise a TrainingStoppedError if a parameter is nan or infinite: the renderer would notice, but too late.

    Pruning would remove Gaussians with a nan opacity as too faint.
    """
    # One wait for a card, not one for every parameter.
    if not bool(torch.stack([x.isfinite().all() for _, x in optimizer.gaussians.named()]).all()):
        raise TrainingStoppedError(f"Gaussians became nan or infinite by step {step}: lower the learning rates.")


def prune(optimizer: GaussianOptimizer, *, min_opacity: float, max_scale: float | None = None) -> None:
    """Remove Gaussians that are too faint or too large.

    Args:
        optimizer: holds the Gaussians; changed.
        min_opacity: fainter ones are removed; compared with the plain opacity, without any regularizer.
        max_scale: Gaussians with a larger standard deviation, in world units, are removed; None keeps them.
    """
    keep = optimizer.gaussians.opacities.detach() >= min_opacity
    if max_scale is not None:
        keep &= ~is_large(optimizer, max_scale)
    # Selecting copies all tensors, for nothing if all stay.
    if not bool(keep.all()):
        optimizer.select(keep)


def reset_opacity(optimizer: GaussianOptimizer, ceiling: float) -> None:
    """Lower every opacity to at most ``ceiling`` and forget its optimizer state (Kerbl et al. 2023, Sec. 5.2)."""
    # In logits, so that opacities below the ceiling stay bit for bit.
    logits = optimizer.gaussians.opacity_logits.detach().clamp(max=math.log(ceiling / (1 - ceiling)))
    optimizer.set_opacity_logits(logits)
    optimizer.forget(slice(None), "opacity_logits")


def decay_opacity(optimizer: GaussianOptimizer, factor: float) -> None:
    """Multiply every opacity by ``factor`` (Binocular3DGS's opacity decay); the optimizer state stays."""
    optimizer.set_opacity_logits(decayed_logits(optimizer.gaussians.opacity_logits.detach(), factor))
