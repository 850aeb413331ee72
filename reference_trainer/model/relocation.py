"""The relocation formula of 3DGS-MCMC: several Gaussians in place of one."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["compute_relocation"]


@torch.no_grad()
def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return opacities and scales with which n Gaussians at one place look like one (3DGS-MCMC, equation 9).

    Opacities (N,) and scales (N, 3) are those of the one; ``ratios`` (N,) holds n, clamped to the size of ``binoms``,
    whose row n and column k is n choose k. New opacities are at least ``min_opacity``, and the scales account for it
    (gsplat 1.6).

    Example:
        >>> table = torch.tensor([[1.0, 0.0], [1.0, 1.0]])
        >>> opacity, scales = compute_relocation(torch.tensor([0.75]), torch.ones(1, 3), torch.tensor([2]), table)
        >>> opacity.item(), round(scales[0, 0].item(), 4)  # 0.75 / (2 x 0.5 - 0.5^2 / sqrt(2))
        (0.5, 0.9111)
    """
    n = ratios.long().clamp(1, len(binoms))
    opacity = (1 - (1 - opacities.double()) ** (1 / n.double())).clamp_min(min_opacity)
    k = torch.arange(len(binoms), dtype=torch.float64, device=binoms.device)
    # The signs of the terms alternate: in single precision they would cancel.
    terms = binoms.double().cumsum(0) * (-1) ** k / (k + 1).sqrt()
    shrink = opacities.double() / (terms[n - 1] * opacity[:, None] ** (k + 1)).sum(1)
    return opacity.to(opacities), scales * shrink[:, None].to(scales)
