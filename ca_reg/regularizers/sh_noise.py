"""The paper's noise on the spherical harmonics."""

from __future__ import annotations

from ca_reg.regularizers.parameter_noise import ParameterNoise
from ca_reg.schedules import Schedule

__all__ = ["SHNoise"]


class SHNoise(ParameterNoise):
    """Multiply each SH coefficient by ``1 + noise`` in training, ``noise ~ N(0, sigma^2)`` (paper, appendix, SH noise).

    ``eval()`` changes nothing, as in the paper. Each coefficient of each channel has its own noise, in all bands
    including the constant one, which the paper leaves open. Colors do not affect occlusion: the paper finds little
    effect on co-adaptation. The noise does not multiply alphas, so there is no exact multiplier.

    Args:
        sigma: standard deviation of the relative noise, at least 0, or a schedule of it. The paper tries 0.1, 0.3 and
            0.5: PSNR is best at 0.1, the default.
        clip: clip the noise to [-sigma, sigma].

    Raises:
        TypeError, ValueError: as :class:`~ca_reg.OpacityNoise`.

    Example:
        >>> import torch
        >>> from ca_reg import Params
        >>> noise = SHNoise(0.1)
        >>> x = Params(torch.full((4,), 0.5), sh=torch.ones(4, 9, 3))
        >>> torch.equal(noise(x).sh, 1 + noise.noise)
        True
    """

    needs = ("sh",)
    field = "sh"

    def __init__(self, sigma: float | Schedule = 0.1, *, clip: bool = False) -> None:
        super().__init__(sigma, clip=clip)
