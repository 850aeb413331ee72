"""DropGaussian: dropout at a rate that grows during training, with compensated survivors."""

from __future__ import annotations

from ca_reg._check import check_rate
from ca_reg.regularizers.dropout import GaussianDropout
from ca_reg.schedules import LinearRamp

__all__ = ["DropGaussian"]


class DropGaussian(GaussianDropout):
    """Drop all Gaussians at the rate ``p t / steps`` at step t, and multiply survivors by ``1 / (1 - rate)``.

    DropGaussian (CVPR 2025): uniform over all N Gaussians, no factor at test time. Survivors may exceed 1, which the
    renderer clamps. It is :class:`~ca_reg.GaussianDropout` with ``compensate`` and a ramp, and has the same exact
    multiplier.

    Args:
        p: rate at the end of the ramp, in [0, 1); 0.2 in the source.
        steps: length of the ramp, after which the rate is constant; the source trains for 10,000 steps. Shorter
            trainings should pass their own length: 3,000 steps of the default reach 0.06.

    Raises:
        TypeError: if ``p`` is not a number or ``steps`` not an integer.
        ValueError: if ``p`` is outside [0, 1) or ``steps`` below 1.

    Example:
        >>> import torch
        >>> dropout = DropGaussian()
        >>> dropout.set_step(5_000)
        >>> opacity = torch.full((4,), 0.5)
        >>> torch.allclose(dropout(opacity), opacity * dropout.keep / 0.9)
        True
        >>> dropout.eval()(opacity) is opacity
        True
    """

    def __init__(self, p: float = 0.2, steps: int = 10_000) -> None:
        check_rate(p)
        super().__init__(LinearRamp(0.0, p, 0, steps), compensate=True)
