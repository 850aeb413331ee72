"""Mean and variance of the random factor that a regularizer puts on the alpha of a splat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ca_reg._check import Rate, check_finite, check_floating, check_opacity_range, check_rates

__all__ = ["Multiplier"]

# Beyond this many standard deviations a normal tail is zero in float64, so a cut there has no effect.
_FAR = 40.0


@dataclass(frozen=True, eq=False)
class Multiplier:
    """Mean ``m`` and variance ``v`` of the factor ``xi`` in ``alpha -> xi alpha``, drawn independently per splat.

    Dropout and opacity noise both have this form, and the mean and variance of a pixel depend on nothing else of it:

    =============================== ======================= ==================
    regularizer                     mean                    variance
    =============================== ======================= ==================
    dropout                         ``1 - p``               ``p (1 - p)``
    dropout, survivors compensated  ``1``                   ``p / (1 - p)``
    opacity noise                   ``1``                   ``sigma^2``
    opacity noise, clipped draw     ``1``                   ``0.516 sigma^2``
    =============================== ======================= ==================

    Args:
        mean: at least 0; a number for all splats, or a tensor with one value per splat or Gaussian, which is checked
            and thereby synchronizes a GPU, but not inside ``torch.compile``.
        variance: at least 0, likewise.

    Example:
        >>> both = Multiplier.dropout(0.5) * Multiplier.opacity_noise(1.0)
        >>> both.mean, both.variance
        (0.5, 0.75)
    """

    mean: float | Tensor
    variance: float | Tensor

    def __post_init__(self) -> None:
        for name, x in (("mean", self.mean), ("variance", self.variance)):
            if not isinstance(x, Tensor):
                check_finite(x, f"the {name} of a multiplier", minimum=0.0)
            elif not torch.compiler.is_compiling() and not bool(((x >= 0) & x.isfinite()).all()):
                raise ValueError(f"the {name} of a multiplier must be finite and at least 0, got a value that is not.")

    def __mul__(self, other: Multiplier) -> Multiplier:
        """Return the multiplier of both factors applied in turn, drawn independently."""
        # (v1 + m1^2)(v2 + m2^2) - m1^2 m2^2, expanded to avoid cancellation.
        variance = (
            self.variance * other.variance
            + self.variance * (other.mean * other.mean)
            + other.variance * (self.mean * self.mean)
        )
        return Multiplier(self.mean * other.mean, variance)

    @classmethod
    def dropout(cls, p: Rate, *, compensate: bool = False) -> Multiplier:
        """Return the multiplier of :func:`~ca_reg.functional.gaussian_dropout` (paper, Eq. dropout_train).

        Exact even for renderers that clamp alpha, because a factor of 0 or 1 commutes with the clamp. With
        ``compensate`` it is exact only where ``alpha <= 0.99 (1 - p)``: survivors above that are clamped by the
        renderer but not here. To be exact at any alpha, give the renderer the survivors' opacities,
        ``opacity / (1 - p)``, and use the multiplier *without* ``compensate``.

        ``p`` is a number in [0, 1) or a tensor (N,) of such.
        """
        check_rates(p)
        return cls(1.0, p / (1.0 - p)) if compensate else cls(1.0 - p, p * (1.0 - p))

    @classmethod
    def opacity_noise(cls, sigma: float, *, clip: bool = False) -> Multiplier:
        """Return the multiplier ``1 + eps`` of opacity noise, eps normal, without the clamp of the opacity to [0, 1].

        A good approximation while few draws reach the clamp, that is for ``sigma`` well below 1 and opacities well
        below ``1 / (1 + sigma)``; :meth:`clamped_noise` includes the clamp. With ``clip`` the draw is clipped to
        [-sigma, sigma], which leaves 0.516 of its variance.
        """
        check_finite(sigma, "sigma", minimum=0.0)
        unit = 2.0 * _upper_half(torch.tensor(1.0, dtype=torch.float64))[1].item() if clip else 1.0
        return cls(1.0, unit * sigma * sigma)

    @classmethod
    def clamped_noise(cls, opacity: Tensor, sigma: float, *, clip: bool = False) -> Multiplier:
        """Return the multiplier of :func:`~ca_reg.functional.opacity_noise`, including the clamp to [0, 1].

        Per Gaussian, ``xi = clamp(o (1 + eps), 0, 1) / o`` is one plus ``sigma`` times a standard normal number clamped
        to ``[-1 / sigma, (1 / o - 1) / sigma]``, whose moments have a closed form. Differentiable in ``opacity``.

        After compensated dropout the noise acts on the survivors' opacities, ``o / (1 - p)``, which may exceed 1: pass
        those. The result is then the factor on ``min(o, 1)``, which the renderer must be given; its product with
        ``Multiplier.dropout(p)``, without ``compensate``, covers both.

        The renderer's treatment of the noisy alpha is not modeled. With R the range of the colors and the background,
        its clamp at 0.99 moves the mean and the standard deviation of a pixel by at most ``R / 99``, whatever the
        length of the list; its cut-off at 1/255 moves a sampled color by at most ``R / 255`` for each splat that
        crosses it.

        Args:
            opacity: activated opacities ``o``, at least 0, any shape.
            sigma: standard deviation of the relative noise, at least 0.
            clip: the draw is clipped to [-sigma, sigma] before it is applied.

        Returns:
            Mean and variance per Gaussian of ``clamp(o (1 + eps), 0, 1) / min(o, 1)``, shape and dtype of ``opacity``.
            At ``o = 0`` it is the limit of small opacities.

        Example:
            >>> noise = Multiplier.clamped_noise(torch.tensor([0.01, 1.0]), 0.2)
            >>> noise.mean, noise.variance
            (tensor([1.0000, 0.9202]), tensor([0.0400, 0.0136]))
        """
        check_floating(opacity, "opacity")
        check_opacity_range(opacity, upper=math.inf)
        check_finite(sigma, "sigma", minimum=0.0)
        if sigma == 0:
            return cls(torch.ones_like(opacity), torch.zeros_like(opacity))
        cut = 1.0 if clip else _FAR
        # Above 1 the variance is a small difference of larger terms, hence float64.
        raised = opacity.double() if bool((opacity > 1).any()) else opacity
        # Up to twice this floor the upper cut is ``cut`` anyway; it keeps 0 * inf out of the gradient at o = 0.
        raised = raised.clamp(min=0.5 / (1.0 + cut * sigma))
        highest = ((1.0 - raised) / (sigma * raised)).clamp(max=cut)
        # A clipped draw may leave a survivor's opacity always at 1: the two cuts then coincide.
        lowest = (-highest).clamp(min=min(1.0 / sigma, cut))
        (up, up_square), (down, down_square) = _upper_half(highest), _upper_half(lowest)
        # Not clamp, whose gradient at 1 is in torch 2.13 that from above, of survivors, and another in torch 2.15.
        shift, over = up - down, torch.where(raised > 1.0, raised, 1.0)
        variance = (sigma * over).square() * (up_square + down_square - shift.square()).clamp(min=0.0)
        return cls((over * (1.0 + sigma * shift)).to(opacity.dtype), variance.to(opacity.dtype))


def _upper_half(x: Tensor) -> tuple[Tensor, Tensor]:
    """``x^k Q(x)`` plus the integral of ``t^k phi(t)`` over [0, x] for k = 1, 2; sums of positive terms for x >= 0.

    For x >= 0 these are the mean and the mean square of ``min(max(z, 0), x)``, z standard normal. Clamped to [-a, b],
    z has the mean ``first(b) - first(a)`` and the mean square ``second(b) + second(a)``, for any ``b >= -a``.
    """
    tail = 0.5 * torch.erfc(x / math.sqrt(2.0))
    half_square = 0.5 * x.square()
    first = x * tail - torch.expm1(-half_square) / math.sqrt(2.0 * math.pi)
    # Twice the integral of t^2 phi(t) over [0, x]; the form with erf would cancel for small x.
    gamma = torch.special.gammainc(torch.full_like(x, 1.5), half_square)
    return first, x.square() * tail + 0.5 * torch.copysign(gamma, x)
