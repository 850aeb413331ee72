"""Normal noise on one parameter of the Gaussians: opacities, scales, colors or positions."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from ca_reg import functional
from ca_reg._check import check_sigma, is_zero
from ca_reg.functional import Multiplier
from ca_reg.regularizer import Draw, Params, Regularizer
from ca_reg.regularizers.surroundings import Refreshed, mean_distances
from ca_reg.schedules import Schedule

__all__ = ["OpacityNoise", "ParameterNoise", "PositionNoise", "SHNoise", "ScaleNoise"]


class ParameterNoise(Regularizer):
    """Multiply each element of a parameter by ``1 + noise`` in training, ``noise ~ N(0, sigma^2)``.

    ``eval()`` changes nothing. A subclass names the parameter, and may override :meth:`perturb`, which applies noise.

    Args:
        sigma: standard deviation of the relative noise, from 0 to 1e30, or a schedule of it.
        clip: clip the noise to [-sigma, sigma], as the paper's released code does for the opacities.

    Attributes:
        field: the field of :class:`~ca_reg.Params` that is perturbed.

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
    _check_rate = staticmethod(check_sigma)
    field: ClassVar[str]

    def __init__(self, sigma: float | Schedule, *, clip: bool = False) -> None:
        super().__init__(sigma)
        self.clip = clip

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


class OpacityNoise(ParameterNoise):
    """Multiply opacities by random factors in training, change nothing in evaluation (paper, opacity noise).

    ``train()``: ``clamp(opacity * (1 + noise), 0, 1)``, ``noise ~ N(0, sigma^2)``. ``eval()``: the very same tensor.

    With ``scale``, which the paper does not have, ``eval()`` returns the mean over all draws instead,
    :func:`~ca_reg.functional.expected_opacity` at the current ``sigma``. The clamp makes that mean differ from the
    opacity (0.72 for an opacity of 1 at ``sigma = 0.8``), so ``scale`` raises the test PSNR by 0.3 to 0.7 dB on four
    scenes at ``sigma = 0.8``, see docs/results.md. Combine it with dropout in a :class:`~ca_reg.Chain`, which takes the
    joint mean in either order; an ``nn.Sequential`` with dropout first would hand scaled opacities to the noise.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1). The first call rejects negative ones as logits.

    Args:
        sigma: standard deviation of the relative noise, at least 0, or a schedule of it.
        clip: clip the noise to [-sigma, sigma], as the authors' released code does.
        scale: return the mean opacities in evaluation. This reads their values, which breaks a ``torch.compile`` graph.

    Example:
        >>> noise = OpacityNoise(sigma=0.8)
        >>> opacity = torch.full((5, 1), 0.5)
        >>> first = noise(opacity)
        >>> torch.equal(noise(opacity, drawn=noise.last), first)  # replay
        True
        >>> noise.eval()(opacity) is opacity
        True
        >>> OpacityNoise(sigma=0.8, scale=True).eval()(torch.tensor([0.1, 1.0]))
        tensor([0.1040, 0.7213])
    """

    drops = False  # Gaussians that the clamp sets to 0 still count as seen, as in the paper's code
    field = "opacities"

    def __init__(self, sigma: float | Schedule, *, clip: bool = False, scale: bool = False) -> None:
        super().__init__(sigma, clip=clip)
        self.scale = self.renders_mean = scale

    def perturb(self, values: Tensor, noise: Tensor) -> Tensor:
        """Multiply and clamp."""
        return functional.apply_opacity_noise(values, noise)

    def expected(self, x: Params) -> Params:
        """Return the mean over all draws with ``scale``, else ``x`` itself."""
        if not self.scale or is_zero(self.rate_at(x.step)):
            return x
        x, factor = self.alpha_factor(x)  # not expected_opacity: survivors of compensated dropout may exceed 1
        return x._replace(opacities=x.opacities * factor.mean)

    def alpha_factor(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the opacities, clamped to 1, and the moments of their clamped noise.

        See :meth:`~ca_reg.functional.Multiplier.clamped_noise` for what this leaves out.
        """
        sigma = self.rate_at(x.step)
        if is_zero(sigma):
            return x, Multiplier(1.0, 0.0)
        multiplier = Multiplier.clamped_noise(x.opacities, float(sigma), clip=self.clip)
        return x._replace(opacities=x.opacities.clamp(max=1.0)), multiplier


class ScaleNoise(ParameterNoise):
    """Multiply each scale by ``1 + noise`` in training, ``noise ~ N(0, sigma^2)`` (paper, appendix, scale noise).

    ``eval()`` changes nothing, as in the paper. The three axes of a Gaussian are drawn independently, which the paper
    leaves open. Negative scales are replaced by their absolute values, which give the same covariance.

    Args:
        sigma: of the relative noise, or a schedule of it. The paper tries 0.1 to 0.7: PSNR is best at 0.2,
            co-adaptation lowest from 0.6 on.
        clip: clip the noise to [-sigma, sigma].

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


class SHNoise(ParameterNoise):
    """Multiply each SH coefficient by ``1 + noise`` in training, ``noise ~ N(0, sigma^2)`` (paper, appendix, SH noise).

    ``eval()`` changes nothing, as in the paper. Each coefficient of each channel has its own noise, in all bands
    including the constant one, which the paper leaves open. The paper finds little effect on co-adaptation.

    Args:
        sigma: of the relative noise, or a schedule of it. The paper tries 0.1, 0.3 and 0.5: PSNR is best at 0.1.
        clip: clip the noise to [-sigma, sigma].

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


class PositionNoise(ParameterNoise):
    """Shift every center at random, in units of the distance to its nearest neighbor (paper, appendix, position noise).

    ``train()``: ``mean + sigma d n`` with ``n`` three standard normal numbers and ``d`` the distance; ``eval()``:
    unchanged. Coinciding Gaussians do not move.

    Args:
        sigma: standard deviation per axis in units of ``d``, at least 0, or a schedule of it. The paper tries 0.1, 0.3
            and 0.5, and finds that all of them blur the images.
        every: steps between neighbor searches; by default 3DGS's densification interval.

    Example:
        >>> means = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [5.0, 0, 0]])
        >>> shifted = PositionNoise(0.1).regularize(Params(torch.ones(3), means=means)).means
        >>> torch.equal(shifted[:2], means[:2]), torch.equal(shifted[2], means[2])
        (True, False)
    """

    needs = ("means",)
    field = "means"

    def __init__(self, sigma: float | Schedule, *, every: int = 100) -> None:
        super().__init__(sigma)
        self.distances = Refreshed(every)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw the shifts in world units, (N, 3)."""
        noise = super().draw(x, generator).value
        if noise is None:
            return Draw()
        return Draw(self.distances(x, lambda means: mean_distances(means, 1))[:, None] * noise)

    def perturb(self, values: Tensor, noise: Tensor) -> Tensor:
        """Shift the centers."""
        return values + noise.to(values.dtype)
