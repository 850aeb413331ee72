"""The paper's geometry-aware dropout: the more the surroundings vary, the more often a Gaussian is dropped."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg._precision import at_least_single, without_autocast
from ca_reg.regularizers._surroundings import RankedDropout, neighbors_of, relative_ranks

__all__ = ["GeometryDropout", "surface_variation"]

EIGEN_CHUNK = 16_384  # matrices; cuSOLVER's batches end at 32k


class GeometryDropout(RankedDropout):
    """Drop at rates from ``low``, on planes, to ``high``, in scattered volumes (paper, geometry-aware dropout).

    ``p = low + (high - low) rank``, with the rank in [0, 1] of :func:`surface_variation`. As for dropout, ``train()``
    returns ``opacity * keep`` and ``eval()`` ``opacity * (1 - p)``.

    The paper has one sentence about it, "estimate local geometric complexity by computing structural variation among
    each Gaussian's nearest neighbors", and calls it infeasible at O(N^3). It does not give the measure, its direction,
    the rates or ``k``: here the measure is the standard one for point clouds, and the rates are those of the paper's
    density-based dropout. With neighbors from a k-d tree it takes O(N log N).

    Args:
        low: rate where the surroundings vary least, in [0, 1).
        high: rate where they vary most, in [0, 1).
        k: number of neighbors.
        every: steps between neighbor searches; by default 3DGS's densification interval.
        compensate: scale the survivors in training rather than all opacities in evaluation.
        scale: scale the opacities in evaluation, as the paper does.

    Raises:
        ValueError: if a rate is outside [0, 1), or ``k`` or ``every`` below 1.

    Example:
        >>> from ca_reg import Params
        >>> plane = torch.rand(100, 3) * torch.tensor([1.0, 1.0, 0.0])
        >>> cloud = torch.rand(100, 3) + 9.0
        >>> rates = GeometryDropout().rates(Params(torch.ones(200), means=torch.cat([plane, cloud])))
        >>> bool(rates[:100].max() < rates[100:].min())
        True
    """

    def __init__(
        self,
        low: float = 0.2,
        high: float = 0.5,
        k: int = 10,
        *,
        every: int = 100,
        compensate: bool = False,
        scale: bool = True,
    ) -> None:
        super().__init__(low, high, k, every=every, compensate=compensate, scale=scale)

    def measure(self, means: Tensor) -> Tensor:
        """Return the rank of the surface variation, (N,)."""
        return relative_ranks(surface_variation(means, self.k))


def surface_variation(means: Tensor, k: int) -> Tensor:
    """Return the smallest eigenvalue of the covariance of each point (N, 3) and its k neighbors, as a share of all.

    The definition is that of Pauly, Gross and Kobbelt, "Efficient simplification of point-sampled surfaces" (2002). In
    [0, 1/3], (N,): 0 on a plane or a line or if all points coincide, 1/3 if the covariance is isotropic.
    """
    means = at_least_single(means)
    _, numbers = neighbors_of(means, k)
    # Sorted by index: Gaussians with the same members then get exactly the same value, and the same rank.
    members = torch.cat([torch.arange(len(means), device=means.device)[:, None], numbers], dim=1).sort(dim=1).values
    offsets = means[members] - means[members[:, :1]]
    offsets = offsets - offsets.mean(1, keepdim=True)
    # Relative to the largest offset, so that squares neither vanish nor overflow.
    offsets = offsets / offsets.abs().amax((1, 2), keepdim=True).clamp_min(torch.finfo(means.dtype).tiny)
    with without_autocast(means.device):
        # In chunks, because cuSOLVER refuses larger batches; each matrix is solved by itself, whatever the chunk.
        variances = torch.cat([torch.linalg.eigvalsh(x.mT @ x) for x in offsets.split(EIGEN_CHUNK)])
    return variances[:, 0].clamp_min(0) / variances.sum(1).clamp_min(torch.finfo(means.dtype).eps)
