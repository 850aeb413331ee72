"""The operations of density control: clone, split and prune Gaussians, and lower their opacities."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.rotations import rotation_matrices
from reference_trainer.training.errors import TrainingStoppedError

__all__ = ["clone", "decay_opacity", "is_large", "prune", "refuse_not_finite", "reset_opacity", "split"]

_SPLIT_INTO = 2
_SPLIT_SHRINK = 0.8 * _SPLIT_INTO  # children of a split are smaller by this factor, as in the INRIA code


def clone(optimizer: GaussianOptimizer, selected: Tensor) -> None:
    """Add exact copies of the selected Gaussians, (N,) bool, at the end."""
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
    if not all(bool(x.isfinite().all()) for _, x in optimizer.gaussians.named()):
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
    if not bool(keep.all()):
        optimizer.select(keep)


def reset_opacity(optimizer: GaussianOptimizer, ceiling: float) -> None:
    """Lower every opacity to at most ``ceiling`` and forget its optimizer state (Kerbl et al. 2023, Sec. 5.2)."""
    logits = optimizer.gaussians.opacity_logits.detach().clamp(max=math.log(ceiling / (1 - ceiling)))
    optimizer.set_opacity_logits(logits)
    optimizer.forget(slice(None), "opacity_logits")


def decay_opacity(optimizer: GaussianOptimizer, factor: float) -> None:
    """Multiply every opacity by ``factor`` (Binocular3DGS's opacity decay); the optimizer state stays."""
    opacities = optimizer.gaussians.opacities.detach() * factor
    # The floor keeps the logit finite; a Gaussian this faint is pruned long before.
    optimizer.set_opacity_logits(torch.logit(opacities.clamp(min=1e-7)))
