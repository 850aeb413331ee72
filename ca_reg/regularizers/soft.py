"""UGOD's soft dropout, with a rule in place of its uncertainty network."""

from __future__ import annotations

import math

from ca_reg._check import Rate
from ca_reg.params import Params
from ca_reg.regularizers.binary_concrete import BinaryConcrete

__all__ = ["SoftDropout"]


class SoftDropout(BinaryConcrete):
    """Multiply opacities by ``omega = clamp(1 - sigmoid((logit u + logit q) / temperature), 0.2, 0.8)``, q ~ U(0, 1).

    The soft mask of UGOD (ICRA 2026). There a network predicts the uncertainty u of a Gaussian from its position,
    rotation, scale and the view; here it follows a rule: the same u for all, or, with ``by_size``, proportional to the
    rank of the largest scale, from about 0 for the smallest Gaussian to about 2 u for the largest, because large
    Gaussians are constrained by few pixels of few views. UGOD renders ``opacity * (1 - u) * omega``; the factor
    ``1 - u``, which is not random, is left to the opacity here.

    ``eval()``: the opacity times the mean of omega. UGOD draws at test time, too, as a module left in ``train()`` does.

    Args:
        u: the (mean) uncertainty, in (0, 1), with ``by_size`` in (0, 0.5]. UGOD has no such constant; 0.2 is the drop
            rate of the paper.
        by_size: whether the uncertainty grows with the rank of the size.
        temperature: above 0 and at most 1; 0.1 in UGOD's code, 0.2 for its results on Mip-NeRF 360.
        floor: the smallest omega; the largest is ``1 - floor``. 0.2 in UGOD.

    Raises:
        ValueError: if an argument is out of range.

    Example:
        >>> import torch
        >>> soft, opacity = SoftDropout(), torch.full((5,), 0.5)
        >>> bool(((soft(opacity) >= 0.1) & (soft.last.value != 0)).all())
        True
        >>> soft.eval()(opacity)
        tensor([0.3399, 0.3399, 0.3399, 0.3399, 0.3399])
    """

    def __init__(self, u: float = 0.2, *, by_size: bool = False, temperature: float = 0.1, floor: float = 0.2) -> None:
        super().__init__(temperature, floor=floor)
        if not 0 < u < 1 or (by_size and u > 0.5):
            raise ValueError(f"u must be in (0, {'0.5]' if by_size else '1)'}, got {u}.")
        self.u = u
        self.by_size = by_size

    @property
    def needs(self) -> tuple[str, ...]:  # type: ignore[override]
        """The scales, with ``by_size``."""
        return ("scales",) if self.by_size else ()

    def logits(self, x: Params) -> Rate:
        """Return the logits of the uncertainty."""
        if not self.by_size:
            return math.log(self.u / (1 - self.u))
        assert x.scales is not None, "checked by check_needs"
        ranks = x.scales.detach().amax(1).argsort(stable=True).argsort()
        return (2 * self.u * (ranks + 0.5) / len(ranks)).to(x.opacities.dtype).logit()
