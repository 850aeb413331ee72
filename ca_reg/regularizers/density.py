"""The paper's density-based dropout: the denser the surroundings, the more often a Gaussian is dropped."""

from __future__ import annotations

from torch import Tensor

from ca_reg.regularizers._surroundings import RankedDropout, mean_distances, relative_ranks

__all__ = ["DensityDropout"]


class DensityDropout(RankedDropout):
    """Drop at rates from ``low``, the sparsest, to ``high``, the densest (paper, appendix, density-based dropout).

    ``p = low + (high - low) rank``, with the rank in [0, 1] of the density, which falls with the mean distance to the k
    nearest neighbors. As for dropout, ``train()`` returns ``opacity * keep`` and ``eval()`` ``opacity * (1 - p)``. The
    paper gives the rates and their linear mapping, but neither ``k`` nor the measure of density; with ranks neither an
    outlier nor two coinciding Gaussians dominate the rates, whose mean is always ``(low + high) / 2``.

    Args:
        low: rate of the sparsest, in [0, 1). The paper uses 0.2.
        high: rate of the densest, in [0, 1). The paper uses 0.5.
        k: number of neighbors; 3DGS initializes its scales from 3.
        every: steps between neighbor searches; by default 3DGS's densification interval.
        compensate: scale the survivors in training rather than all opacities in evaluation.
        scale: scale the opacities in evaluation, as the paper does.

    Raises:
        ValueError: if a rate is outside [0, 1), or ``k`` or ``every`` below 1.

    Example:
        >>> import torch
        >>> from ca_reg import Params
        >>> means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [9.0, 0, 0], [99.0, 0, 0]])
        >>> DensityDropout(k=1).rates(Params(torch.ones(5), means=means))
        tensor([0.4250, 0.4250, 0.4250, 0.2750, 0.2000])
    """

    def measure(self, means: Tensor) -> Tensor:
        """Return the rank of the density, (N,)."""
        return relative_ranks(-mean_distances(means, self.k))
