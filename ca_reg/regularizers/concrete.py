"""Soft masks from the binary concrete distribution, which dim Gaussians instead of dropping them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from ca_reg._check import Rate, check_finite
from ca_reg._random import draw_numbers
from ca_reg.functional import Multiplier
from ca_reg.regularizer import Draw, Learned, Params, Regularizer

__all__ = ["BinaryConcrete", "ConcreteDropout", "SoftDropout", "concrete_moments"]


class BinaryConcrete(Regularizer):
    """Multiply each opacity by its own soft mask ``1 - z``; a subclass defines the logits of the drop rates.

    With ``u ~ U(0, 1)`` and the rate ``p`` of the Gaussian,

        z = sigmoid((logit p + logit u) / temperature)

    has the binary concrete distribution (Maddison et al. 2017); as the temperature tends to 0, ``1 - z`` tends to a
    dropout mask. ``train()``: ``opacity * clamp(1 - z, floor, 1 - floor)``. ``eval()``: the opacity times the mean of
    that factor, :func:`concrete_moments`. No Gaussian is dropped, so density control counts all as seen.

    Args:
        temperature: above 0 and at most 1.
        floor: smallest factor, in [0, 0.5); the largest is ``1 - floor``.

    Example:
        >>> class DimFaint(BinaryConcrete):
        ...     def logits(self, x):
        ...         return -torch.logit(x.opacities.detach())
        >>> DimFaint(0.1).eval()(torch.tensor([0.2, 0.5, 0.8]))
        tensor([0.0403, 0.2500, 0.6388])
    """

    drops: ClassVar[bool] = False
    renders_mean = True

    def __init__(self, temperature: float, *, floor: float = 0.0) -> None:
        super().__init__()
        if not 0 < temperature <= 1:
            raise ValueError(f"the temperature must be above 0 and at most 1, got {temperature}: 0.1 is usual.")
        if not 0 <= floor < 0.5:
            raise ValueError(f"the least factor must be in [0, 0.5), got {floor}: the largest is 1 minus it.")
        self.temperature = temperature
        self.floor = floor

    def logits(self, x: Params) -> Rate:
        """Return ``log(p / (1 - p))`` of the drop rates for ``x``: a number, or one for each Gaussian, shape (N,)."""
        raise NotImplementedError

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw ``logit u`` of every Gaussian, float32."""
        return Draw(draw_numbers(torch.rand, len(x.opacities), generator, x.opacities.device).logit())

    def replay(self, x: Params, draw: Draw) -> Params:
        """Multiply by the soft mask."""
        factor = torch.sigmoid((self.logits(x) + draw.value.to(x.opacities.dtype)) / -self.temperature)
        if self.floor:
            factor = factor.clamp(self.floor, 1.0 - self.floor)
        return x._replace(opacities=(x.opacities * factor).to(x.opacities.dtype))

    def expected(self, x: Params) -> Params:
        """Multiply by the mean of the soft mask."""
        return x._replace(opacities=(x.opacities * self.alpha_factor(x)[1].mean).to(x.opacities.dtype))

    def alpha_factor(self, x: Params) -> tuple[Params, Multiplier]:
        """Return ``x`` and the moments of the soft mask; exact up to the renderer's clamp and cut-off of alphas."""
        return x, Multiplier(*concrete_moments(self.logits(x), self.temperature, self.floor))


def concrete_moments(logits: Rate, temperature: float, floor: float = 0.0) -> tuple[Rate, Rate]:
    """Return mean and variance of ``y = clamp(1 - z, floor, 1 - floor)``, z as in :class:`BinaryConcrete`.

    ``y`` exceeds a level s between the two bounds if ``logit u < -temperature logit s - logit p``, that is with
    probability ``T(s) = sigmoid(-temperature logit s - logit p)``. Integrated over s from bound to bound,

        E y = floor + integral T(s) ds,     E (y - floor)^2 = integral 2 (s - floor) T(s) ds

    which double-exponential quadrature evaluates up to rounding, for rates above 1/2, and mirrored, ``y -> 1 - y``, for
    those below, so that nothing cancels at either end. The logits, ``log(p / (1 - p))``, are a number or a tensor of
    any shape; so are mean and variance, which are differentiable.

    Example:
        >>> mean, variance = concrete_moments(torch.tensor([-2.0, 0.0, 2.0]), 0.1)
        >>> mean, variance  # of dropout at the same rates: 0.88, 0.5, 0.12 and 0.105, 0.25, 0.105
        (tensor([0.8795, 0.5000, 0.1205]), tensor([0.0954, 0.2252, 0.0954]))
    """
    if not isinstance(logits, Tensor):
        mean, variance = concrete_moments(torch.tensor(logits, dtype=torch.float64), temperature, floor)
        return float(mean), float(variance)
    # Up to where the weights fall below rounding; on the device of the logits, as a copy would wait for a card.
    t = torch.linspace(-3.25, 3.25, 53, dtype=torch.float64, device=logits.device)
    y = math.pi * t.sinh()
    s, complement = torch.sigmoid(y), torch.sigmoid(-y)
    span = 1.0 - 2.0 * floor
    weights = span * s * complement * math.pi * t.cosh() * (t[1] - t[0])
    excess = span * s  # over the floor
    level = y if floor == 0 else (floor + excess).logit()
    weights, excess, level = (q.to(logits).view(-1, *[1] * logits.ndim) for q in (weights, excess, level))
    above = torch.sigmoid(-temperature * level - logits.abs())
    low = (weights * above).sum(0)
    variance = (2.0 * weights * excess * above).sum(0) - low.square()
    return torch.where(logits > 0, floor + low, 1.0 - floor - low), variance.clamp(min=0.0)


class ConcreteDropout(BinaryConcrete):
    """Multiply opacities by ``1 - z``, z binary concrete with a rate per Gaussian that is learned (paper, appendix).

    The paper does not say what it renders at test time; ``eval()`` is that of :class:`BinaryConcrete`. The logit of p
    is a parameter of the Gaussian, ``Params.learned["dropout_logits"]``, cloned, split, pruned and saved with it.

    Nothing keeps the rates up: a loss that only fits the photographs lowers them, and the paper finds more
    co-adaptation than without a regularizer (test CA 0.0053 against 0.0020).

    Args:
        p: initial rate of each Gaussian, in (0, 1). The paper does not give it; Gal et al. 2017 start at 0.1.
        rate: learning rate of the logits, by default that of the opacity logits; the paper does not give it.
        temperature: 0.1 in the paper.

    Example:
        >>> import torch
        >>> dropout = ConcreteDropout(p=0.1)
        >>> x = Params(torch.full((3,), 0.5), learned={"dropout_logits": torch.tensor([-2.2, 0.0, 2.2])})
        >>> bool((dropout(x).opacities < 0.5).any())
        True
        >>> dropout.eval()(x).opacities
        tensor([0.4495, 0.2500, 0.0505])
    """

    def __init__(self, p: float = 0.1, rate: float = 0.05, temperature: float = 0.1) -> None:
        super().__init__(temperature)
        if not 0 < p < 1:
            raise ValueError(f"p must be in (0, 1), got {p}: its logit is learned.")
        check_finite(rate, "rate", minimum=0.0)
        self.p, self.rate = p, rate

    @property
    def learns(self) -> Mapping[str, Learned]:  # type: ignore[override]
        """The logits of the rates."""
        return {"dropout_logits": Learned(math.log(self.p / (1 - self.p)), self.rate)}

    def logits(self, x: Params) -> Tensor:
        """Return the learned logits."""
        assert x.learned is not None, "checked by check_needs"
        return x.learned["dropout_logits"]


class SoftDropout(BinaryConcrete):
    """Multiply opacities by ``omega = clamp(1 - sigmoid((logit u + logit q) / temperature), 0.2, 0.8)``, q ~ U(0, 1).

    The soft mask of UGOD (ICRA 2026), whose network predicts the uncertainty u of a Gaussian from its position,
    rotation, scale and the view. Here u is the same for all, or, with ``by_size``, proportional to the rank of the
    largest scale, because large Gaussians are constrained by few pixels of few views. UGOD's other factor, ``1 - u``,
    which is not random, is left to the opacity here. ``eval()``: the opacity times the mean of omega; UGOD draws at
    test time, too, as a module left in ``train()`` does.

    Args:
        u: the (mean) uncertainty, in (0, 1), with ``by_size`` in (0, 0.5]; 0.2 is the drop rate of the paper.
        by_size: whether the uncertainty grows with the rank of the size.
        temperature: above 0 and at most 1; 0.1 in UGOD's code, 0.2 for its results on Mip-NeRF 360.
        floor: the smallest omega; the largest is ``1 - floor``. 0.2 in UGOD.

    Example:
        >>> import torch
        >>> soft, opacity = SoftDropout(), torch.full((5,), 0.5)
        >>> bool(((soft(opacity) >= 0.1) & (soft.last.value != 0)).all())
        True
        >>> soft.eval()(opacity)
        tensor([0.3399, 0.3399, 0.3399, 0.3399, 0.3399])
    """

    def __init__(self, u: float = 0.2, *, by_size: bool = False, temperature: float = 0.1, floor: float = 0.2) -> None:
        super().__init__(temperature, floor=floor)
        if not 0 < u < 1 or (by_size and u > 0.5):
            raise ValueError(f"u must be in (0, {'0.5]' if by_size else '1)'}, got {u}.")
        self.u = u
        self.by_size = by_size

    @property
    def needs(self) -> tuple[str, ...]:  # type: ignore[override]
        """The scales, with ``by_size``."""
        return ("scales",) if self.by_size else ()

    def logits(self, x: Params) -> Rate:
        """Return the logits of the uncertainty."""
        if not self.by_size:
            return math.log(self.u / (1 - self.u))
        assert x.scales is not None, "checked by check_needs"
        # The rank, not the size: one huge Gaussian would otherwise leave the rest without dropout.
        ranks = x.scales.detach().amax(1).argsort(stable=True).argsort()
        return (2 * self.u * (ranks + 0.5) / len(ranks)).to(x.opacities.dtype).logit()
