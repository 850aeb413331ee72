"""Normal noise on a parameter of the Gaussians: the base class of all multiplicative noise."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from ca_reg import functional
from ca_reg._check import check_sigma, is_zero
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Regularizer
from ca_reg.schedules import Schedule

__all__ = ["ParameterNoise"]


class ParameterNoise(Regularizer):
    """Multiply each element of a parameter by ``1 + noise`` in training, ``noise ~ N(0, sigma^2)``.

    ``eval()`` changes nothing. A subclass names the parameter, and may override :meth:`perturb`, which applies noise.

    Args:
        sigma: standard deviation of the relative noise, at least 0, or a schedule of it.
        clip: clip the noise to [-sigma, sigma], as the paper's released code does for the opacities.

    Attributes:
        field: the field of :class:`~ca_reg.Params` that is perturbed.
        noise: the last draw, float32, the shape of the parameter; None if there was none.
        sigma: the standard deviation at the current step.

    Raises:
        TypeError: if ``sigma`` is neither a number nor callable.
        ValueError: if a constant ``sigma`` is negative or above 1e30; a schedule is checked at each use.

    Example:
        >>> class PositionShake(ParameterNoise):
        ...     needs = ("means",)
        ...     field = "means"
        >>> means = torch.ones(2, 3)
        >>> shake = PositionShake(0.1)
        >>> torch.equal(shake(Params(torch.full((2,), 0.5), means)).means, means * (1 + shake.noise))
        True
    """

    drops = False
    rate_name = "sigma"
    field: ClassVar[str]

    def __init__(self, sigma: float | Schedule, *, clip: bool = False) -> None:
        super().__init__(sigma)
        self.clip = clip

    def _check_rate(self, rate: float, name: str) -> None:
        check_sigma(rate, name)

    @property
    def sigma(self) -> float:
        """The standard deviation at the current step."""
        return self._present_rate()

    @property
    def noise(self) -> Tensor | None:
        """The last draw, float32, the shape of the parameter; None if there was none."""
        last = self.last
        return None if last is None else last.value

    def perturb(self, values: Tensor, noise: Tensor) -> Tensor:
        """Return the parameter with the noise, in its own dtype."""
        return (values * (1.0 + noise)).to(values.dtype)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw the relative noise."""
        sigma = self.rate_at(x.step)
        if is_zero(sigma):
            return Draw()
        values: Tensor = getattr(x, self.field)
        noise = functional.draw_opacity_noise(
            values.numel(), sigma, clip=self.clip, generator=generator, device=values.device
        )
        return Draw(noise.view(values.shape))

    def replay(self, x: Params, draw: Draw) -> Params:
        """Apply the noise."""
        if draw.value is None:
            return x
        changed: dict[str, Any] = {self.field: self.perturb(getattr(x, self.field), draw.value)}
        return x._replace(**changed)
