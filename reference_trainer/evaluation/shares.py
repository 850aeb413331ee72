"""Per-Gaussian attribution: weight in the renders, share of the exact score, and their quotient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ca_reg import CAResult, Reason, attribute
from ca_reg.attribution import total_effects
from reference_trainer.evaluation.pictures import heat_colors
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.render.densification import splat_weights
from reference_trainer.scenes.scene import Viewpoint

__all__ = [
    "PER_WEIGHT_SCALE", "Heat", "all_but_highest", "blend_weights", "colored_by", "concentration", "mean_effects",
    "mean_shares", "share_per_weight",
]  # fmt: skip

PER_WEIGHT_SCALE = (0.1, 10.0)
"""Ends of the color scale for shares per blend weight, in units of the mean."""

_TOP = (0.001, 0.01, 0.1)


@dataclass(frozen=True)
class Heat:
    """How much every Gaussian of a model co-adapts relative to its contribution to some views.

    Args:
        shares: from `mean_shares`, (N,).
        weights: from `blend_weights`, (N,).
        results: the exact score of every view.
    """

    shares: Tensor
    weights: Tensor
    results: Sequence[CAResult]

    @classmethod
    def of(cls, model: TrainedModel, views: Sequence[Viewpoint], *, drop_rate: float = 0.5) -> Heat:
        """Measure a model; arguments and errors are those of `mean_shares`, plus a ValueError if all scores are 0.

        If the test-time opacities depend on the camera, the weights are those of the plain opacities.
        """
        shares, results = mean_shares(model, views, drop_rate=drop_rate)
        if not shares.any():
            raise ValueError(f"the score at drop rate {drop_rate} is 0: there is nothing to attribute.")
        return cls(shares, blend_weights(model.without_camera, views), results)

    @property
    def values(self) -> Tensor:
        """The heat: `share_per_weight`, (N,)."""
        return share_per_weight(self.shares, self.weights)

    @property
    def mean(self) -> float:
        """The mean heat: the score over the sum of the weights."""
        return (self.shares.sum() / self.weights.sum()).item()

    @property
    def ranks(self) -> Tensor:
        """The fraction of Gaussians that precede each one by increasing heat, (N,), in [0, 1)."""
        return self.values.argsort().argsort() / len(self.shares)


def blend_weights(model: TrainedModel, views: Sequence[Viewpoint]) -> Tensor:
    """Return the weight of every Gaussian in the test-time renders, summed over all pixels and views.

    The image is linear in the colors, so these are exactly the gradient of its sum: sums of alpha times transmittance,
    shape (N,), float64. The views are on the model's device.
    """
    opacities = model.test_opacities
    total = torch.zeros_like(opacities, dtype=torch.float64)
    for view in views:
        splats = model.splats(opacities, view)
        total[splats.indices] += splat_weights(splats)
    return total


def share_per_weight(shares: Tensor, weights: Tensor) -> Tensor:
    """Return how much Gaussians co-adapt relative to what they contribute.

    Takes shares and `blend_weights`, (N,) each, and returns the quotients: 0 for a Gaussian without a share, infinite
    for one that is visible only when others are dropped.

    Example:
        >>> share_per_weight(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([4.0, 0.0, 0.0]))
        tensor([0.2500,    inf, 0.0000])
    """
    return torch.where(shares > 0, shares / weights, 0.0)


def all_but_highest(values: Tensor, fraction: float) -> Tensor:
    """Return a mask (N,) that excludes the ``fraction`` of all Gaussians with the highest values, (N,), if positive."""
    first = values.argsort(descending=True, stable=True)[: round(fraction * len(values))]
    keep = torch.ones_like(values, dtype=torch.bool)
    keep[first[values[first] > 0]] = False
    return keep


def colored_by(gaussians: Gaussians, values: Tensor, low: float, high: float) -> Gaussians:
    """Return the same Gaussians in view-independent colors that show a value each, see `heat_colors`."""
    colors = heat_colors(values, low, high).to(gaussians.sh_dc)
    return replace(gaussians, sh_dc=((colors - 0.5) / SH_C0)[:, None], sh_rest=torch.zeros_like(gaussians.sh_rest))


def mean_shares(
    model: TrainedModel, views: Sequence[Viewpoint], *, drop_rate: float = 0.5
) -> tuple[Tensor, list[CAResult]]:
    """Attribute the exact score of several views to the Gaussians.

    The views are on the model's device. Returns the shares, averaged over the views that have a score, shape (N,),
    float64, which add up to the mean score; and the result of every view.

    Raises:
        ValueError: if no view has a score.
    """
    score, opacities = model.exact_ca_score(drop_rate=drop_rate), model.gaussians.opacities
    return _mean_over_views(lambda view: attribute(score, model.shares, opacities, view), views)


def mean_effects(model: TrainedModel, views: Sequence[Viewpoint], *, drop_rate: float = 0.5) -> Tensor:
    """Return the total effects of the Gaussians, averaged as the shares in `mean_shares`."""
    score, opacities = model.exact_ca_score(drop_rate=drop_rate), model.gaussians.opacities
    return _mean_over_views(lambda view: total_effects(score, opacities, view), views)[0]


def concentration(shares: Tensor) -> dict[str, float]:
    """Return how concentrated the score is on few Gaussians.

    The shares are at least 0, not all 0, shape (N,). Under ``"top 1%"`` and the like stands the fraction of the score
    held by the Gaussians with the largest shares, under ``"half"`` the smallest fraction of the Gaussians that holds
    half of the score.

    Example:
        >>> shares = torch.ones(1000)
        >>> shares[:10] = 100.0
        >>> {name: round(part, 3) for name, part in concentration(shares).items()}
        {'top 0.1%': 0.05, 'top 1%': 0.503, 'top 10%': 0.548, 'half': 0.01}
    """
    held = shares.double().sort(descending=True).values.cumsum(0)
    held, n = held / held[-1], len(shares)
    found = {f"top {part:.1%}".replace(".0%", "%"): held[max(1, round(part * n)) - 1].item() for part in _TOP}
    return {**found, "half": (int((held < 0.5).sum()) + 1) / n}


def _mean_over_views(
    measure: Callable[[Viewpoint], tuple[Tensor, CAResult]], views: Sequence[Viewpoint]
) -> tuple[Tensor, list[CAResult]]:
    """Measure every view; return the mean over those that have a score, and all results."""
    total, results = torch.zeros(()), []
    for view in views:
        values, result = measure(view)
        results.append(result)
        total = total.to(values) + values  # values are 0 without a score
    count = sum(result.reason is Reason.OK for result in results)
    if count == 0:
        raise ValueError(
            f"none of the {len(views)} views has a score to attribute, because no pixel has an expected alpha above "
            "the threshold: choose the other split, or a lower drop rate."
        )
    return total / count, results
