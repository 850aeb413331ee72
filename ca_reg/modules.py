"""The regularizers as modules: they hold the rate, the step and the last draw; the work is done in ``functional``."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg import functional
from ca_reg._check import check_finite, check_rate
from ca_reg._regularizer import Regularizer
from ca_reg.schedules import Schedule, as_schedule

__all__ = ["GaussianDropout", "OpacityNoise"]


class GaussianDropout(Regularizer):
    """Drop a random subset of Gaussians in training; scale the opacities in evaluation (paper, Gaussian dropout).

    ``train()``: ``opacity * keep``. ``eval()``: ``opacity * (1 - p)``, the mean over all masks. With ``compensate`` the
    survivors are multiplied by ``1 / (1 - p)`` in training instead, and evaluation leaves the opacities as they are.
    The two schemes are not equivalent: compositing is not linear in the opacities, and rasterizers clamp the alpha of
    survivors, so that Gaussians of an opacity above ``0.99 (1 - p)`` are more opaque in evaluation than the mean over
    all masks. The module has no
    parameters; put it between the activation of the opacities and the rasterizer.

    Dropped Gaussians must leave no trace in density control: pass the radii through :meth:`mask_radii`.

    Inside ``torch.compile`` one graph serves all steps, with ``fullgraph=True`` as well: the values of the opacities
    are then not looked at, and a schedule draws also where its rate is 0. Inside ``torch.utils.checkpoint`` draw
    without ``generator``, or outside and give ``keep``. :class:`OpacityNoise` does the same.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1). The first call checks this.

    Args:
        p: drop rate in [0, 1), or a schedule of it. The paper uses 0.2.
        compensate: scale the survivors in training rather than all opacities in evaluation.

    Attributes:
        keep: the last mask, True where the Gaussian stayed, (N,) bool; None if nothing was dropped.
        p: the rate at the present step.
        step: the training step, set with :meth:`set_step`; a module with a schedule saves it in ``state_dict``.

    Raises:
        TypeError: if ``p`` is neither a number nor callable.
        ValueError: if a constant ``p`` is outside [0, 1); a schedule is checked at each use.

    Example:
        >>> dropout = GaussianDropout(p=0.2)
        >>> opacity = torch.full((5,), 0.5)
        >>> in_training = dropout(opacity)
        >>> torch.equal(in_training, opacity * dropout.keep)
        True
        >>> torch.equal(dropout(opacity, keep=dropout.keep), in_training)  # replay
        True
        >>> dropout.eval()(opacity)
        tensor([0.4000, 0.4000, 0.4000, 0.4000, 0.4000])
    """

    keep: Tensor | None

    def __init__(self, p: float | Schedule, *, compensate: bool = False) -> None:
        if not callable(p):
            check_rate(p)
        super().__init__(as_schedule(p))
        self.compensate = compensate
        self.keep = None

    @property
    def p(self) -> float:
        """The drop rate at the present step."""
        return self._present_rate()

    def _present_rate(self) -> float:
        rate = self._schedule(self.step)
        check_rate(rate, f"p at step {self.step}")
        return rate

    def forward(
        self, opacity: Tensor, *, keep: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the opacities to render.

        Args:
            opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
            keep: a former mask to apply again instead of drawing one, shape (N,), bool; in training only.
            generator: source of the draw; the global state of the random numbers is then untouched.

        Returns:
            Opacities of the same shape and dtype; the very same tensor if there is nothing to do.

        Raises:
            TypeError: if ``opacity`` is not a floating-point tensor or ``keep`` not a bool one.
            ValueError: if a shape is wrong, ``opacity`` looks like logits, or ``keep`` is given in evaluation.
        """
        self._check(opacity)
        p = self._rate_to_apply()
        if not self.training:
            if keep is not None:
                raise ValueError("keep was given in eval(), where nothing is dropped; call train() or leave it out.")
            self.keep = None
            return opacity if self.compensate else functional.scale_opacity(opacity, p)
        if keep is not None:
            opacity = functional.apply_dropout(opacity, keep, p=p, compensate=self.compensate)
            self.keep = keep
            return opacity
        opacity, self.keep = functional.gaussian_dropout(opacity, p, compensate=self.compensate, generator=generator)
        return opacity

    def mask_radii(self, radii: Tensor) -> Tensor:
        """Zero the radii of the Gaussians that the last call dropped, so that density control does not count them.

        If they were counted as seen, their mean gradient would shrink by ``1 - p`` and the threshold in effect rise by
        ``1 / (1 - p)``.

        Args:
            radii: of all Gaussians as the rasterizer returned them, Gaussians first, shape (N,) or (N, ...).

        Returns:
            The same shape and dtype; the very same tensor if nothing was dropped.

        Raises:
            ValueError: if the number of Gaussians is not that of the last call.

        Example:
            >>> dropout = GaussianDropout(p=0.5)
            >>> _ = dropout(torch.full((4,), 0.5))
            >>> radii = torch.tensor([3, 1, 2, 5])
            >>> torch.equal(dropout.mask_radii(radii) > 0, dropout.keep)
            True
        """
        if self.keep is None:
            return radii
        if radii.shape[:1] != self.keep.shape:
            raise ValueError(
                f"radii must have the {self.keep.shape[0]} Gaussians of the last call as the first axis, got shape "
                f"{tuple(radii.shape)}; call mask_radii before Gaussians are added or removed."
            )
        return radii * self.keep.view(-1, *[1] * (radii.ndim - 1)).to(radii.device)

    def extra_repr(self) -> str:
        """Return the arguments, for ``print``."""
        return f"p={self._rate_repr()}, compensate={self.compensate}"


class OpacityNoise(Regularizer):
    """Multiply opacities by random factors in training, change nothing in evaluation (paper, opacity noise).

    ``train()``: ``clamp(opacity * (1 + noise), 0, 1)`` with ``noise ~ N(0, sigma^2)`` per Gaussian. ``eval()``: the
    very same tensor. With dropout it comes second: ``nn.Sequential(GaussianDropout(0.2), OpacityNoise(0.8))``.

    With ``scale``, which the paper does not have, ``eval()`` returns the mean over all draws instead,
    :func:`~ca_reg.functional.expected_opacity` at the present ``sigma``. The clamp makes that mean differ from the
    opacity (0.72 for an opacity of 1 at ``sigma = 0.8``), so the model was fitted with other opacities than those of
    ``eval()`` without it. Of models that were trained at ``sigma = 0.8`` it raises the test PSNR by 0.47 dB on fern and
    0.50 dB on lego, see docs/results.md. The training is the same. Then the noise comes first,
    ``nn.Sequential(OpacityNoise(0.8, scale=True), GaussianDropout(0.2))``: in training the order of the two does not
    matter, because a factor of 0 or 1 commutes with the clamp; in evaluation the noise must see the plain opacities.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1). The first call checks this.

    Args:
        sigma: standard deviation of the relative noise, at least 0, or a schedule of it.
        clip: clip the noise to [-sigma, sigma], as the authors' released code does.
        scale: return the mean opacities in evaluation. That looks at their values, which ends a graph of
            ``torch.compile``.

    Attributes:
        noise: the last draw, (N,) float32; None if there was none.
        sigma: the standard deviation at the present step.
        step: the training step, set with :meth:`set_step`; a module with a schedule saves it in ``state_dict``.

    Raises:
        TypeError: if ``sigma`` is neither a number nor callable.
        ValueError: if a constant ``sigma`` is negative or not finite; a schedule is checked at each use.

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

    noise: Tensor | None

    def __init__(self, sigma: float | Schedule, *, clip: bool = False, scale: bool = False) -> None:
        if not callable(sigma):
            check_finite(sigma, "sigma", minimum=0.0)
        super().__init__(as_schedule(sigma))
        self.clip = clip
        self.scale = scale
        self.noise = None

    @property
    def sigma(self) -> float:
        """The standard deviation at the present step."""
        return self._present_rate()

    def _present_rate(self) -> float:
        sigma = self._schedule(self.step)
        check_finite(sigma, f"sigma at step {self.step}", minimum=0.0)
        return sigma

    def forward(
        self, opacity: Tensor, *, noise: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the opacities to render.

        Args:
            opacity: activated opacities in [0, 1], shape (N,) or (N, 1).
            noise: a former draw to apply again instead of drawing one, shape (N,); in training only.
            generator: source of the draw; the global state of the random numbers is then untouched.

        Returns:
            Opacities of the same shape and dtype; the very same tensor if there is nothing to do.

        Raises:
            TypeError: if ``opacity`` is not a floating-point tensor.
            ValueError: if a shape is wrong, ``opacity`` looks like logits, or ``noise`` is given in evaluation; with
                ``scale`` in evaluation also if an opacity is above 1.
        """
        self._check(opacity)
        if not self.training:
            if noise is not None:
                raise ValueError("noise was given in eval(), where none is added; call train() or leave it out.")
            self.noise = None
            return functional.expected_opacity(opacity, self.sigma, clip=self.clip) if self.scale else opacity
        if noise is not None:
            opacity = functional.apply_opacity_noise(opacity, noise)
            self.noise = noise
            return opacity
        opacity, self.noise = functional.opacity_noise(
            opacity, self._rate_to_apply(), clip=self.clip, generator=generator
        )
        return opacity

    def extra_repr(self) -> str:
        """Return the arguments, for ``print``."""
        return f"sigma={self._rate_repr()}, clip={self.clip}, scale={self.scale}"
