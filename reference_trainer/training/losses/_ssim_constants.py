"""The numbers of SSIM (Wang et al. 2004) for colors in [0, 1]."""

from __future__ import annotations

import math

__all__ = ["C1", "C2", "WEIGHTS"]

_SIGMA = 1.5
_SIDE = [math.exp(-(offset**2) / (2 * _SIGMA**2)) for offset in range(6)]

WEIGHTS = [weight / (2 * sum(_SIDE) - 1) for weight in _SIDE]
"""Of the window's center and of the pixels to one side of it, along one axis; those of all eleven add up to 1."""

C1 = 0.01**2
"""Added to the means."""

C2 = 0.03**2
"""Added to the variances."""
