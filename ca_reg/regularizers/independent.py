"""Dropout of Gaussians independently of each other: the base class of dropouts that only define the rates."""

from __future__ import annotations

import torch

from ca_reg import functional
from ca_reg._check import Rate, check_rate, is_zero, rate_like
from ca_reg.functional import Multiplier
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Regularizer
from ca_reg.schedules import Schedule

__all__ = ["IndependentDropout"]


class IndependentDropout(Regularizer):
    """Drop each Gaussian at its own rate, independently of the others; a subclass defines the rates.

    ``train()``: ``opacity * keep``, with ``compensate`` times ``1 / (1 - p)``. ``eval()``: with ``scale``
    ``opacity * (1 - p)``, the mean over all masks; otherwise, and with ``compensate``, the opacities unchanged.

    Args:
        rate: in [0, 1), or a schedule of it, which ``self.rate_at(x.step)`` reads, for subclasses whose rates build on
            one.
        compensate: scale the survivors in training rather than all opacities in evaluation.
        scale: scale the opacities in evaluation, as the paper does; most published schemes do not.

    Example:
        >>> class DropFaint(IndependentDropout):
        ...     rate_name = "rate"
        ...     def rates(self, x):
        ...         return self.rate_at(x.step) * (1 - x.opacities.detach())
        >>> DropFaint(0.4).eval()(torch.tensor([0.5, 1.0]))
        tensor([0.4000, 1.0000])
    """

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
        count, device = x.opacities.shape[0], x.opacities.device
        keep = functional.draw_keep_mask(count, rates, generator=generator, device=device)
        return Draw(keep=keep)

    def replay(self, x: Params, draw: Draw) -> Params:
        """Set the opacities of dropped Gaussians to 0; if asked to, compensate the others for the rates of ``x``."""
        if draw.keep is None:
            return x
        rates = self.rates(x) if self.compensate else 0.0
        opacities = functional.apply_dropout(x.opacities, draw.keep, p=rates, compensate=self.compensate)
        return x._replace(opacities=opacities)

    def expected(self, x: Params) -> Params:
        """Scale by ``1 - p`` with ``scale`` and without ``compensate``."""
        if self.compensate or not self.scale:
            return x
        opacities = functional.scale_opacity(x.opacities, self.test_rates(x))
        return x if opacities is x.opacities else x._replace(opacities=opacities)

    def multiplied(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the survivors' opacities, and a factor of 0 or 1: exact even if the rasterizer clamps alpha."""
        return self._multiplied(x, self.rates(x))

    def test_multiplied(self, x: Params) -> tuple[Params, Multiplier]:
        """Return the same at the test-time rates."""
        return self._multiplied(x, self.test_rates(x))

    def _multiplied(self, x: Params, rates: Rate) -> tuple[Params, Multiplier]:
        if self.compensate:
            x = x._replace(opacities=x.opacities / (1.0 - rate_like(rates, x.opacities)))
        return x, Multiplier.dropout(rates)

    def _check_rate(self, rate: float, name: str) -> None:
        check_rate(rate, name)
