"""Statistics of every Gaussian since the last densification."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["DensityStatistics"]


@dataclass
class DensityStatistics:
    """Gradients of every Gaussian, and steps that drew it, since the last densification.

    A Gaussian that a step did not draw (outside the view, or dropped by a regularizer) is not counted in that step. If
    dropped Gaussians were counted with their zero gradient, the threshold would in effect rise by 1 / (1 - p).

    Args:
        gradient_sum: summed norms of the loss gradient with respect to the projected center in normalized device
            coordinates, as in the INRIA code: times half the image size, shape (N,).
        steps: the number of steps that drew it, shape (N,).
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
        drawn: Tensor,
        gradient: Tensor,
        width: int,
        height: int,
        absolute: Tensor | None = None,
    ) -> None:
        """Count one step.

        Args:
            indices: the Gaussians that may have been drawn, each once, shape (M,).
            drawn: which of them were, shape (M,) bool.
            gradient: of the loss with respect to their projected centers, per pixel; 0 if not drawn, shape (M, 2).
            width: image width, pixels.
            height: image height, pixels.
            absolute: the sums over the pixels of the absolute gradients, shape (M, 2).
        """
        for total, x in ((self.gradient_sum, gradient), (self.absolute_sum, absolute)):
            if total is not None and x is not None:
                norms = torch.hypot(0.5 * width * x[:, 0], 0.5 * height * x[:, 1])
                total.index_add_(0, indices, norms.to(total))
        self.steps.index_add_(0, indices, drawn.to(self.steps))

    def named(self) -> dict[str, Tensor]:
        """Return the statistics that are kept, by name."""
        return {name: x for name, x in vars(self).items() if x is not None}

    def __getitem__(self, index: Tensor) -> DensityStatistics:
        """Return the statistics of some Gaussians."""
        return DensityStatistics(**{name: x[index] for name, x in self.named().items()})

    @property
    def mean_gradient(self) -> Tensor:
        """Mean gradient norm over the steps that drew a Gaussian; 0 where none did, shape (N,)."""
        return self.gradient_sum / self.steps.clamp(min=1)
