"""Dropout training without sampling: the expected render, and the exact co-adaptation as a term of the loss."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor

from ca_reg._check import check_callable
from ca_reg.functional import Multiplier
from ca_reg.schedules import Schedule, Scheduled
from ca_reg.types import Layout, MomentsFn, check_layout, read_moments

__all__ = ["CAPenalty", "PenalizedRender"]


class PenalizedRender(NamedTuple):
    """What :class:`CAPenalty` returns.

    ``image`` and ``variance``, (3, H, W), are the mean and the variance of the pixels over the random factors;
    ``penalty``, a scalar to add to the loss, is the weight times the mean of the variance.
    """

    image: Tensor
    variance: Tensor
    penalty: Tensor


class CAPenalty(Scheduled):
    """Render the mean of what dropout training samples, and penalize its variance.

    For the mean squared error, the expected loss of dropout training is the loss of the expected render plus the mean
    variance of its pixels, exactly:

        E mse(sample, target) = mse(image, target) + penalty        (weight 1)

    so two lines replace the sampled render and its loss, and no gradient carries sampling noise:

        image, variance, penalty = ca_penalty(gaussians.get_opacity, view)
        loss = mse(image, target) + penalty

    For the absolute error take ``loss = expected_absolute_error(image, variance, target).mean()``
    (:mod:`ca_reg.functional`), without ``penalty``. With any other loss, ``penalty`` is a separate regularizer, whose
    weight is a free choice.

    ``image`` is also the test-time render, with all opacities multiplied by the mean of the multiplier, up to the
    renderer's treatment of large and small alphas: its clamp at 0.99, before the factor here and after it there, moves
    a color by at most ``R / 99``, R being the range of the colors and the background; its cut-off at 1/255 by at most
    ``R / 255`` for each splat. ``train()`` and ``eval()`` make no difference. No Gaussian is dropped, so density
    control needs no masked radii.

    Limits: the factors must be independent, one per Gaussian. The clamp and the cut-off of alphas that a factor changed
    are not modeled, see :class:`~ca_reg.functional.Multiplier`; plain dropout is exact but for the early termination of
    a sampled render. So is compensated dropout if the call gets the opacities of survivors, ``opacity / (1 - p)``, and
    ``multiplier`` is ``Multiplier.dropout(p)``; ``image`` is then not the test-time render where opacities exceed
    ``0.99 (1 - p)``.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1), neither dropped nor scaled; images are (3, H, W).
    The first call checks that no opacity is negative.

    Args:
        moments_fn: the renderer, differentiable, ``moments_fn(opacity, view, multiplier, background)``; see
            :class:`ca_reg.types.MomentsFn`.
        multiplier: moments of the factor, such as ``Multiplier.dropout(0.2)``; or a callable that computes them from
            the opacities, (N,), at every call, such as ``lambda o: Multiplier.clamped_noise(o, 0.8)``, with gradients.
        weight: factor of the penalty, at least 0, or a schedule of it.
        layout: order of the axes of the images that ``moments_fn`` returns, ``"CHW"`` or ``"HWC"``.

    Raises:
        TypeError: if an argument is of the wrong type.
        ValueError: if ``weight`` is negative or not finite, or ``layout`` is unknown.

    Example:
        One white splat over black that half of the draws leave out: a pixel is 0 or 0.8.

        >>> import torch
        >>> from ca_reg.functional import alpha_moments
        >>> def moments_fn(
        ...     opacity: Tensor, view: None, multiplier: Multiplier, background: Tensor | None
        ... ) -> dict[str, Tensor]:
        ...     mean, variance = (x.expand(3, 4, 4) for x in alpha_moments(opacity, multiplier))
        ...     return {"mean": mean, "variance": variance, "alpha_mean": mean[0]}
        >>> ca_penalty = CAPenalty(moments_fn, Multiplier.dropout(0.5))
        >>> image, variance, penalty = ca_penalty(torch.tensor([0.8]), None)
        >>> torch.nn.functional.mse_loss(image, torch.full((3, 4, 4), 0.7)) + penalty  # (0.7^2 + 0.1^2) / 2
        tensor(0.2500)
    """

    rate_name = "weight"

    def __init__(
        self,
        moments_fn: MomentsFn,
        multiplier: Multiplier | Callable[[Tensor], Multiplier],
        *,
        weight: float | Schedule = 1.0,
        layout: Layout = "CHW",
    ) -> None:
        check_callable(moments_fn, "moments_fn", "opacity, view, multiplier, background")
        if not isinstance(multiplier, Multiplier) and not callable(multiplier):
            raise TypeError(
                "multiplier must be a Multiplier, such as Multiplier.dropout(0.2), or a callable that makes one from "
                f"the opacities, got {type(multiplier).__name__}."
            )
        check_layout(layout)
        super().__init__(weight)
        self.moments_fn = moments_fn
        self.multiplier = multiplier
        self.layout: Layout = layout

    @property
    def weight(self) -> float:
        """The factor of the penalty at the current step."""
        return self._present_rate()

    def forward(self, opacity: Tensor, view: Any, background: Tensor | None = None) -> PenalizedRender:
        """Render the moments of one view, with gradients.

        View and background are passed on as they are: None for the model's own background, one color (3,), or an image.
        Raises TypeError or ValueError for opacities, a multiplier or moments of the wrong type, shape or range.
        """
        self._check(opacity)
        multiplier = self.multiplier
        if not isinstance(multiplier, Multiplier):
            multiplier = multiplier(opacity.reshape(-1))
            if not isinstance(multiplier, Multiplier):
                raise TypeError(f"the multiplier callable must return a Multiplier, got {type(multiplier).__name__}.")
        moments = read_moments(self.moments_fn(opacity, view, multiplier, background), layout=self.layout)
        # In a graph the weight is a float64 scalar, which would promote the product to float64.
        penalty = (self.rate_at(self.step) * moments.variance.mean()).to(moments.variance.dtype)
        return PenalizedRender(moments.mean, moments.variance, penalty)

    def extra_repr(self) -> str:
        """Return the arguments, for ``print``."""
        made = self.multiplier if isinstance(self.multiplier, Multiplier) else getattr(self.multiplier, "__name__", "?")
        return f"multiplier={made}, {super().extra_repr()}"
