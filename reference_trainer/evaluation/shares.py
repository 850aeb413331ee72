"""Per-Gaussian attribution: weights in renders, shares of the exact score, and what hangs where nobody was."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ca_reg import CAResult, Reason, attribute
from ca_reg.attribution import hanging
from reference_trainer.evaluation.pictures import heat_colors
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.render.densification import splat_weights
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.scenes.virtual_cameras import amid_views, unseen_views

__all__ = [
    "PER_WEIGHT_SCALE", "Guard", "Heat", "all_but_highest", "blend_weights", "colored_by", "concentration", "guard",
    "mean_shares", "share_per_weight", "unseen_shares", "where_it_shows",
]  # fmt: skip

PER_WEIGHT_SCALE = (0.1, 10.0)
"""Ends of the color scale for shares per blend weight, in units of the mean."""

_TOP = (0.001, 0.01, 0.1)
_TOLD = 5  # places that a sentence names


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


@dataclass(frozen=True)
class Guard:
    """What the `guard` found.

    Args:
        keep: which Gaussians do not hang, (N,), bool.
        where: how many hang at which camera, the one where their share is highest.
        scores: the mean exact score at the cameras that nobody took, at first and after each round.
    """

    keep: Tensor
    where: Counter[str]
    scores: tuple[float, ...]

    def __str__(self) -> str:
        if not self.where:
            return "No Gaussian hangs where nobody took a photograph."
        told = self.where.most_common(_TOLD)
        others = self.where.total() - sum(count for _, count in told)
        places = "; ".join([f"{count} {name}" for name, count in told] + [f"{others} elsewhere"] * bool(others))
        before, after = self.scores[0] * 1e3, self.scores[-1] * 1e3
        total = f"{self.where.total()} of {len(self.keep)} Gaussians hang where nobody took a photograph: {places}"
        return f"{total}. Without them the exact score there is {after:.2f}e-3, for {before:.2f}e-3."


@torch.no_grad()
def guard(model: TrainedModel, scene: Scene, views: Sequence[Viewpoint] | None = None, *, rounds: int = 3) -> Guard:
    """Find the Gaussians that hang where nobody took a photograph, see `ca_reg.attribution.hanging`.

    What hangs is left out and the rest measured again, because it may have hidden more, until nothing hangs or
    ``rounds`` are over. All `unseen_views` are judged together. With many training cameras each of `amid_views` is
    also judged separately, because what hangs at one of many places is little in the mean over all. Scores are at the
    drop rate of the training, at 0.2 if that is 0. No photograph is looked at. ``views`` are cameras that nobody took
    in the place of all `unseen_views`. Costs about four renders per camera and round.

    Raises:
        ValueError: if the model was trained without anything that drops or is noisy, whose Gaussians need each other,
            or the scene has fewer than two training cameras.
    """
    if not len(model.chain):
        raise ValueError(
            "a model that was trained without dropout or noise is not guarded: its Gaussians need each other, and "
            "without those of high shares it is worse everywhere."
        )
    together = [view.to(model.background.device) for view in (unseen_views(scene) if views is None else views)]
    places = [together, *([view.to(model.background.device)] for view in amid_views(scene))]
    taken = [view.to(model.background.device) for view in scene.train]
    keep = torch.ones(len(model.gaussians), dtype=torch.bool, device=model.background.device)
    where, scores = Counter[str](), list[float]()
    for number in range(rounds + 1):
        rest = replace(model, gaussians=model.gaussians[keep])
        plain, hang, of_views = rest.without_camera, torch.zeros_like(keep[keep]), list[float]()
        here = blend_weights(plain, taken)
        for of in places:
            shares, where_highest, score = unseen_shares(rest, of)
            of_views += [score] * len(of)
            if number < rounds:
                # At a single place divided by 3, not by all: what many photographs show is then rarely suspected.
                mean = here / (len(taken) if of is together else 3)
                found = hanging(shares, blend_weights(plain, of) / len(of), mean) & ~hang
                where.update(of[i].name for i in where_highest[found].tolist())
                hang |= found
        scores.append(sum(of_views) / len(of_views))
        if not bool(hang.any()):
            break
        keep[keep.clone()] = ~hang
    return Guard(keep, where, tuple(scores))


@torch.no_grad()
def where_it_shows(model: TrainedModel, scene: Scene, found: Guard) -> tuple[Viewpoint, Tensor, Tensor]:
    """Return the camera at which what hangs shows most, and its renders with it and without, (3, H, W) in [0, 1].

    That is the camera, of those where something hangs, whose picture changes most, in the mean square.

    Raises:
        ValueError: if nothing hangs.
    """
    freed = replace(model, gaussians=model.gaussians[found.keep])
    shown = list[tuple[float, Viewpoint, Tensor, Tensor]]()
    for view in [*unseen_views(scene), *amid_views(scene)]:
        if view.name in found.where:
            at = view.to(model.background.device)
            before, after = (each.test_rendering(at).image.clamp(0, 1) for each in (model, freed))
            shown.append(((before - after).square().mean().item(), view, before, after))
    if not shown:
        raise ValueError("nothing hangs where nobody took a photograph: there is nothing to show.")
    return max(shown, key=lambda one: one[0])[1:]


def unseen_shares(model: TrainedModel, views: Sequence[Viewpoint]) -> tuple[Tensor, Tensor, float]:
    """Return the mean share of every Gaussian, the position of the view where it is highest, and the mean score.

    Shares (N,), float64, are 0 at a view without a score, which the mean score leaves out; positions (N,) are 0 for a
    Gaussian without a share.
    """
    score, opacities = model.exact_ca_score(drop_rate=model.dropout or 0.2), model.gaussians.opacities
    total = torch.zeros_like(opacities, dtype=torch.float64)
    highest, where, values = torch.zeros_like(total), torch.zeros_like(total, dtype=torch.int64), list[float]()
    # Added up: of a hundred photographs, the shares of all views would take gigabytes.
    for number, view in enumerate(views):
        shares, result = attribute(score, model.shares, opacities, view)
        total += shares
        where.masked_fill_(shares > highest, number)
        highest = torch.maximum(highest, shares)
        if result.reason is Reason.OK:
            values.append(result.value)
    return total / len(views), where, sum(values) / max(1, len(values))


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
    total, results = torch.zeros_like(opacities, dtype=torch.float64), []
    for view in views:
        shares, result = attribute(score, model.shares, opacities, view)
        results.append(result)
        total += shares  # 0 without a score
    count = sum(result.reason is Reason.OK for result in results)
    if count == 0:
        raise ValueError(
            f"none of the {len(views)} views has a score to attribute, because no pixel has an expected alpha above "
            "the threshold: choose the other split, or a lower drop rate."
        )
    return total / count, results


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
