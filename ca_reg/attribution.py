"""Which Gaussians co-adapt, by two attributions of the exact score, and which hang where no photograph was taken.

*Shares* (:func:`attribute`) add up to the score, as :func:`ca_reg.functional.contributions` add up to the variance of a
pixel; the interaction of two Gaussians counts entirely for the one behind.

*Total effects* (:func:`total_effects`) do not depend on an order. The score is linear in the variance ``v_i`` of each
Gaussian's factor, so ``v_i dV/dv_i`` is exactly how much the score would fall if this factor were fixed at its mean
(Sobol's total index, times the variance). Interactions count for each Gaussian involved, so no total effect is below
the share.

Both refer to the visible pixels of the score, and both remove only the randomness of a Gaussian: deleting it would also
change the mean.

Shares at cameras that nobody took tell which Gaussians *hang* there (:func:`hanging`).
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from ca_reg.regularizer import Params
from ca_reg.result import CAResult, Reason
from ca_reg.score import CAScore, ExactScore, ExactView
from ca_reg.types import read_moments

__all__ = ["CAAttribution", "CATotalEffects", "SharesFn", "attribute", "hanging", "total_effects"]


class SharesFn(Protocol):
    """A renderer that attributes the variance: ``shares_fn(opacity, view, multiplier, background, weights)``.

    It takes the arguments of :class:`~ca_reg.types.MomentsFn` and weights of the pixels, (H, W) in float64. It returns,
    (N,), the :func:`~ca_reg.functional.contributions` of every Gaussian, averaged over RGB and summed over the pixels
    with these weights, as :meth:`ca_reg.lists.ListMoments.shares` does; 0 if the view does not see it.

    Example:
        >>> from ca_reg.functional import contributions
        >>> def shares_fn(
        ...     opacity: Tensor, view: Tensor, multiplier: Multiplier, background: Tensor | None, weights: Tensor
        ... ) -> Tensor:  # every pixel shows the same Gaussians, in the order of their index
        ...     return contributions(opacity, view, multiplier, background=background).mean(-1) * weights.sum()
    """

    def __call__(
        self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None, weights: Tensor, /
    ) -> Tensor:
        """Return the shares of a weighted sum of the variance, one per Gaussian."""


class CAAttribution(NamedTuple):
    """The score of a view, split over the Gaussians.

    The shares, (N,) float64, at least 0, sum to ``result.value``; all are 0 if the score has no value.
    """

    shares: Tensor
    result: CAResult


class CATotalEffects(NamedTuple):
    """How much the score of a view would fall if one Gaussian's factor were fixed at its mean, for each Gaussian.

    The effects are (N,) float64, at least 0; all are 0 if the score has no value.
    """

    effects: Tensor
    result: CAResult


def attribute(score: CAScore, shares_fn: SharesFn, opacity: Tensor | Params, view: Any) -> CAAttribution:
    """Measure a view exactly and split the score over the Gaussians.

    Costs the score and one call of ``shares_fn``.

    Args:
        score: an exact :class:`~ca_reg.CAScore`, neutral or not.
        shares_fn: of the same renderer as the moments of the score.
        opacity: activated opacities or :class:`~ca_reg.Params`, as for a call of the score.
        view: passed on to both callables.

    Raises:
        TypeError: as for a call of the score.
        ValueError: as for a call of the score, if the score is not exact, or ``shares_fn`` returns another shape.

    Example:
        A red Gaussian in front of a blue one, over black:

        >>> from ca_reg.lists import ListMoments, PixelLists
        >>> def lists_fn(opacity: Tensor, view: None) -> PixelLists:
        ...     both = torch.tensor([0, 1])
        ...     return PixelLists(both, torch.zeros(2, dtype=torch.int64), opacity, torch.eye(3)[[0, 2]], 1, 1)
        >>> moments = ListMoments(lists_fn)
        >>> score = CAScore.exact(moments, threshold=0.5)
        >>> shares, result = attribute(score, moments.shares, torch.tensor([0.5, 0.8]), None)
        >>> shares, round(result.value, 6)
        (tensor([0.0242, 0.0333], dtype=torch.float64), 0.0575)
    """
    _, (result, opacity, multiplier, background) = _measure(score, opacity, view, "attribute")
    if result.reason is not Reason.OK:
        return CAAttribution(opacity.new_zeros(len(opacity), dtype=torch.float64), result)
    # The score is the mean over the visible pixels: with these weights the shares add up to it.
    weights = result.visible.to(torch.float64) / result.visible.sum()
    with torch.no_grad():
        shares = shares_fn(opacity.clone(), view, multiplier, background, weights)
    if shares.shape != opacity.shape[:1]:
        raise ValueError(
            f"shares_fn must return one share per Gaussian, shape ({opacity.shape[0]},), got {tuple(shares.shape)}; "
            "put zeros where the view does not see a Gaussian."
        )
    return CAAttribution(shares.to(torch.float64), result)


def hanging(
    shares: Tensor, there: Tensor, here: Tensor, *, ratio: float = 16.0, together: float = 0.05, alone: float = 0.003
) -> Tensor:
    """Find the Gaussians that hang where no photograph was taken: veils and blobs before and beside the cameras.

    Training with dropout can leave opaque Gaussians where no training camera looks, so that no photograph shows them. A
    Gaussian is suspect if its weight at cameras that nobody took exceeds ``ratio`` times its weight at the training
    cameras. If all suspects together hold at most the share ``together`` of the score there, nothing hangs: every
    training leaves as much beside its pictures. Otherwise each suspect that holds more than ``alone`` hangs. Remove
    these, measure again, and stop when none is found. Use it for models that were trained with dropout or noise: in
    others, Gaussians need each other. For the cameras, the numbers and the gain, see benchmarks/guard.md.

    Args:
        shares: from :func:`attribute`, averaged over cameras that nobody took, at least 0, shape (N,).
        there: blend weights (alpha times transmittance, summed over the pixels) at these cameras, averaged over them,
            shape (N,). A picture is linear in the colors, so they are the gradient of its sum in a color channel.
        here: the same at the training cameras, shape (N,).
        ratio: at least 0.
        together: share of the score that all suspects must hold, in [0, 1).
        alone: share of the score that each of them must hold, in [0, 1).

    Returns:
        Which Gaussians hang, bool, shape (N,).

    Raises:
        ValueError: if the shapes differ, or a number is out of range.

    Example:
        The second Gaussian is seen beside the training cameras only; the third too, but hardly matters.

        >>> hanging(torch.tensor([0.5, 0.4, 0.001]), torch.tensor([9.0, 5.0, 1.0]), torch.tensor([9.0, 0.2, 0.0]))
        tensor([False,  True, False])
    """
    if not shares.ndim == 1 or not shares.shape == there.shape == here.shape:
        raise ValueError(
            "shares and weights must have one value per Gaussian each, shape (N,), got "
            f"{tuple(shares.shape)}, {tuple(there.shape)} and {tuple(here.shape)}."
        )
    if not ratio >= 0 or not 0 <= together < 1 or not 0 <= alone < 1:
        raise ValueError(
            f"ratio must be at least 0, together and alone in [0, 1), got {ratio}, {together} and {alone}."
        )
    suspect, total = there > ratio * here, shares.sum()
    return suspect & (shares > alone * total) & (shares[suspect].sum() > together * total)


@torch.inference_mode(False)  # it would record no gradient
def total_effects(score: CAScore, opacity: Tensor | Params, view: Any) -> CATotalEffects:
    """Measure a view exactly and find how much the score would fall if one Gaussian's factor were fixed at its mean.

    Costs the score, and a forward and backward pass of its moments callable, which must be differentiable in the
    variance of the multiplier, a tensor (N,). The arguments are those of :func:`attribute`.

    Raises:
        TypeError: as for a call of the score.
        ValueError: as for a call of the score, if the score is not exact, or its moments are not differentiable.

    Example:
        The scene of :func:`attribute`; the interaction now counts for the Gaussian in front as well.

        >>> from ca_reg.lists import ListMoments, PixelLists
        >>> def lists_fn(opacity: Tensor, view: None) -> PixelLists:
        ...     both = torch.tensor([0, 1])
        ...     return PixelLists(both, torch.zeros(2, dtype=torch.int64), opacity, torch.eye(3)[[0, 2]], 1, 1)
        >>> total_effects(CAScore.exact(ListMoments(lists_fn), threshold=0.5), torch.tensor([0.5, 0.8]), None).effects
        tensor([0.0275, 0.0333], dtype=torch.float64)
    """
    exact, (result, opacity, multiplier, background) = _measure(score, opacity, view, "total_effects")
    if result.reason is not Reason.OK:
        return CATotalEffects(opacity.new_zeros(len(opacity), dtype=torch.float64), result)
    opacity = opacity.clone()
    # One variance per Gaussian, also where the multiplier has one for all: each needs a gradient of its own.
    spread = (multiplier.variance * opacity.new_ones(opacity.shape[:1])).requires_grad_()
    gradient = None
    with torch.enable_grad():
        answer = exact.moments_fn(opacity, view, Multiplier(multiplier.mean, spread), background)
        variance = read_moments(answer, layout=score.layout).variance
        if variance.requires_grad:
            value = variance.mean(0)[result.visible.to(variance.device)].mean()
            (gradient,) = torch.autograd.grad(value, spread, allow_unused=True)
    if gradient is None:
        raise ValueError(
            "the moments callable of the score returned a variance without a gradient in multiplier.variance; it must "
            "compute it from that tensor with autograd on (no torch.no_grad, detach or numpy in it). If it cannot, use "
            "attribute, which takes no gradient."
        )
    return CATotalEffects((gradient * spread.detach()).to(torch.float64), result)


def _measure(score: CAScore, opacity: Tensor | Params, view: Any, name: str) -> tuple[ExactScore, ExactView]:
    """Measure with an exact score, and return it with the inputs of its moments; raise if it is not exact."""
    if not isinstance(score, ExactScore):
        raise ValueError(
            f"{name} needs an exact score, got the method {score.settings.method!r}; make it with "
            "CAScore.exact(moments_fn). A renderer without moments that can list the Gaussians of its pixels has them "
            "by ca_reg.lists.ListMoments."
        )
    return score, score.measure(opacity, view)
