"""The paper's noise on the scales."""

from __future__ import annotations

from torch import Tensor

from ca_reg.regularizers.parameter_noise import ParameterNoise
from ca_reg.schedules import Schedule

__all__ = ["ScaleNoise"]


class ScaleNoise(ParameterNoise):
    """Multiply each scale by ``1 + noise`` in training, ``noise ~ N(0, sigma^2)`` (paper, appendix, scale noise).

    ``eval()`` changes nothing, as in the paper. The three axes of a Gaussian are drawn independently, which the paper
    leaves open. Negative scales are replaced by their absolute values, which give the same covariance. The noise does
    not multiply alphas, so there is no exact multiplier.

    Args:
        sigma: standard deviation of the relative noise, at least 0, or a schedule of it. The paper tries 0.1 to 0.7:
            PSNR is best at 0.2, the default, co-adaptation lowest from 0.6 on.
        clip: clip the noise to [-sigma, sigma].

    Raises:
        TypeError, ValueError: as :class:`~ca_reg.OpacityNoise`.

    Example:
        >>> import torch
        >>> from ca_reg import Params
        >>> noise = ScaleNoise(0.2)
        >>> x = Params(torch.full((4,), 0.5), scales=torch.ones(4, 3))
        >>> torch.equal(noise(x).scales, (1 + noise.noise).abs())
        True
        >>> noise.eval()(x) is x
        True
    """

    needs = ("scales",)
    field = "scales"

    def __init__(self, sigma: float | Schedule = 0.2, *, clip: bool = False) -> None:
        super().__init__(sigma, clip=clip)

    def perturb(self, values: Tensor, noise: Tensor) -> Tensor:
        """Multiply, and take the absolute value."""
        return super().perturb(values, noise).abs()
