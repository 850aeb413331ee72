"""What Gaussians contribute to the renders, and how much they co-adapt for it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render import render
from reference_trainer.scenes.scene import Viewpoint

__all__ = ["blend_weights", "share_per_weight"]


def blend_weights(model: TrainedModel, views: Sequence[Viewpoint]) -> Tensor:
    """Return the weight with which every Gaussian enters the test-time renders, summed over all pixels and views.

    The image is linear in the colours, so the weights are the gradient of its sum: no approximation.

    Args:
        model: what to measure.
        views: on the model's device.

    Returns:
        Sums of alpha times transmittance, shape (N,), float64.
    """
    gaussians, opacities = model.gaussians, model.test_opacities
    total = torch.zeros_like(opacities, dtype=torch.float64)
    for view in views:
        colors = torch.zeros_like(gaussians.means).requires_grad_()
        out = render(gaussians.means, gaussians.quaternions, gaussians.scales, opacities, view.camera, colors=colors)
        total += torch.autograd.grad(out.image[0].sum(), colors)[0][:, 0]
    return total


def share_per_weight(shares: Tensor, weights: Tensor) -> Tensor:
    """Return how much Gaussians co-adapt for what they contribute.

    Args:
        shares: shape (N,), float64.
        weights: of `blend_weights`, shape (N,).

    Returns:
        The quotients, shape (N,): 0 for a Gaussian without a share, infinite for one that only shows where others are
        dropped.

    Example:
        >>> share_per_weight(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([4.0, 0.0, 0.0]))
        tensor([0.2500,    inf, 0.0000])
    """
    return torch.where(shares > 0, shares / weights, 0.0)
