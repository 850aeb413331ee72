"""What was seen of every Gaussian since the last densification."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["DensityStatistics", "screen_norm"]


def screen_norm(gradient: Tensor, width: int, height: int) -> Tensor:
    """Return the norms (M,) of gradients per pixel (M, 2), per half an image size (INRIA's device coordinates)."""
    return torch.hypot(0.5 * width * gradient[:, 0], 0.5 * height * gradient[:, 1])


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

    def update(self, indices: Tensor, drawn: Tensor, gradient: Tensor, width: int, height: int) -> None:
        """Count one step.

        Args:
            indices: the Gaussians that may have been drawn, each once, shape (M,).
            drawn: which of them were, shape (M,) bool.
            gradient: of the loss with respect to their projected centres, per pixel, 0 of the others, shape (M, 2).
            width: image width, pixels.
            height: image height, pixels.
        """
        self.gradient_sum.index_add_(0, indices, screen_norm(gradient, width, height).to(self.gradient_sum))
        self.steps.index_add_(0, indices, drawn.to(self.steps))

    def __getitem__(self, index: Tensor) -> DensityStatistics:
        """Return those of some Gaussians."""
        return DensityStatistics(self.gradient_sum[index], self.steps[index])

    @property
    def mean_gradient(self) -> Tensor:
        """Mean gradient norm over the steps that drew a Gaussian; 0 where none did, shape (N,)."""
        return self.gradient_sum / self.steps.clamp(min=1)
