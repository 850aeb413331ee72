"""The paper's multiplicative noise on the opacities."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg import functional
from ca_reg._check import is_zero
from ca_reg.functional import Multiplier
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Given
from ca_reg.regularizers.parameter_noise import ParameterNoise
from ca_reg.schedules import Schedule

__all__ = ["OpacityNoise"]


class OpacityNoise(ParameterNoise):
    """Multiply opacities by random factors in training, change nothing in evaluation (paper, opacity noise).

    ``train()``: ``clamp(opacity * (1 + noise), 0, 1)`` with ``noise ~ N(0, sigma^2)`` per Gaussian. ``eval()``: the
    very same tensor.

    With ``scale``, which the paper does not have, ``eval()`` returns the mean over all draws instead,
    :func:`~ca_reg.functional.expected_opacity` at the current ``sigma``; training is the same. The clamp makes that
    mean differ from the opacity (0.72 for an opacity of 1 at ``sigma = 0.8``), so without ``scale`` the model is
    evaluated at opacities other than those it was fitted with: ``scale`` raises the test PSNR by 0.3 to 0.7 dB on four
    scenes at ``sigma = 0.8``, see docs/results.md. To combine it with dropout use
    ``Chain(OpacityNoise(0.8, scale=True), GaussianDropout(0.2))``, whose order does not matter: in training a factor of
    0 or 1 commutes with the clamp, and in evaluation :class:`~ca_reg.Chain` takes the joint mean. An ``nn.Sequential``
    with dropout first would hand opacities to the noise that are scaled already.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1). The first call rejects negative ones as logits.

    Args:
        sigma: standard deviation of the relative noise, at least 0, or a schedule of it.
        clip: clip the noise to [-sigma, sigma], as the authors' released code does.
        scale: return the mean opacities in evaluation. This reads their values, which breaks a ``torch.compile`` graph.

    Attributes:
        noise: the last draw, (N,) float32; None if there was none.
        sigma: the standard deviation at the current step.
        step: the training step, set with :meth:`set_step`; a module with a schedule saves it in ``state_dict``.

    Raises:
        TypeError: if ``sigma`` is neither a number nor callable.
        ValueError: if a constant ``sigma`` is negative or above 1e30; a schedule is checked at each use.

    Example:
        >>> noise = OpacityNoise(sigma=0.8)
        >>> opacity = torch.full((5, 1), 0.5)
        >>> first = noise(opacity)
        >>> torch.equal(noise(opacity, noise=noise.noise), first)  # replay
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

    def forward(  # type: ignore[override]
        self, opacity: Given, *, noise: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Given:
        """Return the opacities to render.

        As :meth:`Regularizer.forward <ca_reg.Regularizer.forward>`; ``noise``, (N,), is an earlier draw to replay
        instead of a new one, in training only. With ``scale``, opacities above 1 raise a ValueError in evaluation.
        """
        return super().forward(opacity, drawn=None if noise is None else Draw(noise), generator=generator)

    def perturb(self, values: Tensor, noise: Tensor) -> Tensor:
        """Multiply and clamp."""
        return functional.apply_opacity_noise(values, noise)

    def expected(self, x: Params) -> Params:
        """Return the mean over all draws with ``scale``, else ``x`` itself."""
        sigma = self.rate_at(x.step)
        if not self.scale or is_zero(sigma):
            return x
        return x._replace(opacities=functional.expected_opacity(x.opacities, float(sigma), clip=self.clip))

    def multiplied(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the opacities, clamped to 1, and the moments of their clamped noise.

        The renderer's clamp and cut-off of the noisy alphas are not modeled, see
        :meth:`~ca_reg.functional.Multiplier.clamped_noise`.
        """
        sigma = self.rate_at(x.step)
        if is_zero(sigma):
            return x, Multiplier(1.0, 0.0)
        multiplier = Multiplier.clamped_noise(x.opacities, float(sigma), clip=self.clip)
        return x._replace(opacities=x.opacities.clamp(max=1.0)), multiplier
