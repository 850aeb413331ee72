"""Dropout of Gaussians independently of each other: the paper's, and the base class of those with other rates."""

from __future__ import annotations

import torch

from ca_reg import functional
from ca_reg._check import Rate, check_rate, is_zero
from ca_reg.functional import Multiplier
from ca_reg.functional.opacities import compensated, keep_mask
from ca_reg.regularizer import Draw, Params, Regularizer
from ca_reg.schedules import LinearRamp, Schedule

__all__ = ["DropGaussian", "GaussianDropout", "IndependentDropout"]


class IndependentDropout(Regularizer):
    """Drop each Gaussian at its own rate, independently of the others; a subclass defines the rates.

    ``train()``: ``opacity * keep``, with ``compensate`` times ``1 / (1 - p)``. ``eval()``: with ``scale``
    ``opacity * (1 - p)``, the mean over all masks; otherwise, and with ``compensate``, the opacities unchanged.

    Args:
        rate: in [0, 1), or a schedule of it, which ``self.rate_at(x.step)`` reads, for subclasses whose rates build on
            one.
        compensate: scale the survivors in training rather than all opacities in evaluation.
        scale: scale the opacities in evaluation, as the paper does; most published schemes do not.

    Attributes:
        bounded: whether the rates are in [0, 1) whatever ``x`` is. Others are checked at every draw, which waits for a
            card.

    Example:
        >>> class DropFaint(IndependentDropout):
        ...     rate_name = "rate"
        ...     def rates(self, x):
        ...         return self.rate_at(x.step) * (1 - x.opacities.detach())
        >>> DropFaint(0.4).eval()(torch.tensor([0.5, 1.0]))
        tensor([0.4000, 1.0000])
    """

    _check_rate = staticmethod(check_rate)
    bounded: bool = False

    def __init__(self, rate: float | Schedule | None = None, *, compensate: bool = False, scale: bool = True) -> None:
        super().__init__(rate)
        self.compensate = compensate
        self.scale = scale
        self.renders_mean = compensate or scale

    def rates(self, x: Params) -> Rate:
        """Return the drop rates in [0, 1) for ``x``: a number, or one for each Gaussian, shape (N,)."""
        raise NotImplementedError

    def test_rates(self, x: Params) -> Rate:
        """Return the rates by which :meth:`expected` scales."""
        return self.rates(x)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw which Gaussians are kept."""
        rates = self.rates(x)
        if is_zero(rates):
            return Draw()
        draw = keep_mask if self.bounded else functional.draw_keep_mask
        count, device = x.opacities.shape[0], x.opacities.device
        keep = draw(count, rates, generator=generator, device=device)
        return Draw(rates if self.compensate else None, keep)

    def replay(self, x: Params, draw: Draw) -> Params:
        """Set the opacities of dropped Gaussians to 0; if asked to, compensate the others for the rates of the draw."""
        if draw.keep is None:
            return x
        opacities = functional.apply_dropout(x.opacities, draw.keep)
        if self.compensate:
            opacities = compensated(opacities, self.rates(x) if draw.value is None else draw.value)
        return x._replace(opacities=opacities)

    def expected(self, x: Params) -> Params:
        """Scale by ``1 - p`` with ``scale`` and without ``compensate``."""
        if self.compensate or not self.scale:
            return x
        opacities = functional.scale_opacity(x.opacities, self.test_rates(x))
        return x if opacities is x.opacities else x._replace(opacities=opacities)

    def alpha_factor(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the survivors' opacities, and a factor of 0 or 1: exact even if the rasterizer clamps alpha."""
        return self._alpha_factor(x, self.rates(x))

    def test_alpha_factor(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the same at the test-time rates."""
        return self._alpha_factor(x, self.test_rates(x))

    def _alpha_factor(self, x: Params, rates: Rate) -> tuple[Params, Multiplier]:
        if self.compensate:
            # Survivors may exceed 1: the renderer's clamp must see them before the factor does.
            x = x._replace(opacities=compensated(x.opacities, rates))
        return x, Multiplier.dropout(rates)


class GaussianDropout(IndependentDropout):
    """Drop a random subset of Gaussians in training; scale the opacities in evaluation (paper, Gaussian dropout).

    ``train()``: ``opacity * keep``. ``eval()``: ``opacity * (1 - p)``, the mean over all masks. With ``compensate`` the
    survivors are multiplied by ``1 / (1 - p)`` in training instead, and evaluation leaves the opacities as they are.
    The two are not equivalent: rasterizers clamp the alpha of survivors, so that Gaussians of opacity above
    ``0.99 (1 - p)`` are more opaque in evaluation than in the mean over all masks.

    Dropped Gaussians must leave no trace in density control: pass the radii through
    :meth:`~ca_reg.Regularizer.mask_radii`.

    A draw comes from the global random state, or from a generator given to the call. Under ``torch.vmap`` draw the
    masks outside, and map :func:`~ca_reg.functional.apply_dropout` over them. Inside ``torch.compile`` one graph serves
    all steps, even with ``fullgraph=True``, and the next all numbers of Gaussians; the values of the opacities are then
    not checked, and a schedule draws even where its rate is 0. A CUDA graph draws anew at every replay; it refuses a
    schedule, whose rate it would keep. Inside ``torch.utils.checkpoint`` draw without ``generator``, or draw outside
    and pass ``drawn``. The same holds for :class:`OpacityNoise`.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1). The first call rejects negative ones as logits.

    Args:
        p: drop rate in [0, 1), or a schedule of it. The paper uses 0.2.
        compensate: scale the survivors in training rather than all opacities in evaluation.

    Raises:
        TypeError: if ``p`` is neither a number nor callable.
        ValueError: if a constant ``p`` is outside [0, 1); a schedule is checked at each use.

    Example:
        >>> dropout = GaussianDropout(p=0.2)
        >>> opacity = torch.full((5,), 0.5)
        >>> in_training = dropout(opacity)
        >>> torch.equal(in_training, opacity * dropout.keep)
        True
        >>> torch.equal(dropout(opacity, drawn=dropout.last), in_training)  # replay
        True
        >>> dropout.eval()(opacity)
        tensor([0.4000, 0.4000, 0.4000, 0.4000, 0.4000])
    """

    rate_name = "p"

    def __init__(self, p: float | Schedule, *, compensate: bool = False) -> None:
        super().__init__(p, compensate=compensate)

    @property
    def p(self) -> float:
        """The drop rate at the current step."""
        return self._present_rate()

    def rates(self, x: Params) -> Rate:
        """Return the rate at the step."""
        return self.rate_at(x.step)


class DropGaussian(GaussianDropout):
    """Drop all Gaussians at the rate ``p t / steps`` at step t, and multiply survivors by ``1 / (1 - rate)``.

    DropGaussian (CVPR 2025): :class:`~ca_reg.GaussianDropout` with ``compensate`` and a ramp. No factor at test time;
    survivors may exceed 1, which the renderer clamps.

    Args:
        p: rate at the end of the ramp, in [0, 1); 0.2 in the source.
        steps: length of the ramp; the source trains for 10,000 steps, shorter trainings should pass their own length.

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
