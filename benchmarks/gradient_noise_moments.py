"""Moments of sampled gradients and what follows from them: noise, and how near an exact gradient is to their mean."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor

__all__ = [
    "ALL",
    "CANDIDATES",
    "LOSSES",
    "Candidate",
    "DrawMoments",
    "GradientNoise",
    "Gradients",
    "Moments",
    "StepNoise",
    "dot",
]

LOSSES = ("photometric", "squared")
"""What is differentiated: the loss of the training, and the mean squared error."""
ALL = "all"
"""Name of the concatenation of all groups."""

Gradients = dict[str, Tensor]
Candidate = Literal["analytic", "control"]
CANDIDATES: tuple[Candidate, ...] = ("analytic", "control")
"""The gradient in expectation, and the plain one of the render with scaled opacities."""


@dataclass(frozen=True)
class Moments:
    """Sums over the parameters of a group, at one view. They add up over groups, and over views.

    Args:
        draws: number of sampled gradients K.
        variance: unbiased variance of one of them, summed over the parameters.
        squared: squared length of their mean.
        halves: scalar product of the means of two halves of the draws, and the squared length of each.
        analytic: squared length of the analytic gradient, and its scalar product with the mean of the draws.
        control: likewise, of the plain loss of the scaled render.
        distances: squared distances of the analytic gradient from the mean of the first 2, 4, 8, ..., K draws.
    """

    draws: int
    variance: float
    squared: float
    halves: tuple[float, float, float]
    analytic: tuple[float, float]
    control: tuple[float, float]
    distances: tuple[float, ...]

    @property
    def signal(self) -> float:
        """Unbiased estimate of the squared length of the expected gradient; may fall below 0 by chance."""
        return self.squared - self.variance / self.draws

    @property
    def relative_noise(self) -> float:
        """Trace variance of one sampled gradient by the squared length of the expected one."""
        return _ratio(self.variance, self.signal)

    @property
    def ceiling(self) -> float:
        """Cosine that the true expectation would have with the mean of the draws, from two halves; nan if unknown."""
        product, first, second = self.halves
        r = _ratio(product, math.sqrt(first * second))
        return math.sqrt(2 * r / (1 + r)) if r > 0 else math.nan

    def cosine(self, what: Candidate) -> float:
        """Return the cosine with the mean of the draws."""
        squared, product = getattr(self, what)
        return _ratio(product, math.sqrt(squared * self.squared))

    def length(self, what: Candidate) -> float:
        """Return the relative difference of the length from that of the expected gradient."""
        return math.sqrt(_ratio(getattr(self, what)[0], self.signal)) - 1

    def error(self, what: Candidate) -> float:
        """Return the distance by the squared length of the expected gradient."""
        return _ratio(self.distance(what), self.signal)

    def worth(self, what: Candidate) -> float:
        """Return the number of draws whose average is as far from the expectation; nan if no distance was found."""
        return _ratio(self.variance, self.distance(what))

    def law(self) -> list[tuple[int, float, float]]:
        """Return k, the measured relative distance of the mean of k draws, and the one if analytic is exact."""
        unit = self.signal
        return [
            (k, math.sqrt(_ratio(d, unit)), math.sqrt(_ratio(self.variance / k, unit)))
            for k, d in zip(_powers(self.draws), self.distances, strict=True)
        ]

    def distance(self, what: Candidate) -> float:
        """Return the squared distance from the expected gradient, unbiased: may fall below 0 by chance."""
        squared, product = getattr(self, what)
        return float(squared - 2 * product + self.signal)

    @classmethod
    def total(cls, groups: Sequence[Moments]) -> Moments:
        """Return the moments of the concatenation of groups or of views."""
        names = ("halves", "analytic", "control", "distances")
        sums: dict[str, Any] = {
            name: tuple(map(sum, zip(*(getattr(g, name) for g in groups), strict=True))) for name in names
        }
        return cls(groups[0].draws, sum(g.variance for g in groups), sum(g.squared for g in groups), **sums)


@dataclass(frozen=True)
class StepNoise:
    """Variance of a step that picks one of the views at random. The parts add up over groups.

    Args:
        masks: trace variance due to the masks, mean over the views.
        views: variance between the expected gradients of the views, unbiased; may fall below 0 by chance.
        signal: squared length of the expected gradient of the step, unbiased.
        analytic_views: variance between the analytic gradients of the views.
        analytic_signal: squared length of their mean.
    """

    masks: float
    views: float
    signal: float
    analytic_views: float
    analytic_signal: float

    @classmethod
    def of(cls, views: Sequence[Moments], squared: float, analytic_squared: float) -> StepNoise:
        """Combine the views.

        Args:
            views: moments of one group at every view, whose draws are independent of each other.
            squared: squared length of the mean over views of the means of the draws.
            analytic_squared: squared length of the mean over views of the analytic gradients.
        """
        n = len(views)
        masks = sum(m.variance for m in views) / n
        left = masks / views[0].draws  # variance of the mean of the draws
        spread = sum(m.squared for m in views) / n - squared
        analytic_spread = sum(m.analytic[0] for m in views) / n - analytic_squared
        return cls(masks, spread - left * (1 - 1 / n), squared - left / n, analytic_spread, analytic_squared)

    @classmethod
    def total(cls, groups: Sequence[StepNoise]) -> StepNoise:
        """Return the variance of the concatenation of groups."""
        return cls(*(sum(getattr(g, field.name) for g in groups) for field in fields(cls)))

    @property
    def share_of_masks(self) -> float:
        """What part of the variance of a sampled step is due to the masks."""
        return _ratio(self.masks, self.masks + self.views)

    def relative(self) -> dict[str, float]:
        """Return each part by the squared length of the expected gradient; nan if that is not above 0."""
        masks, views = (_ratio(x, self.signal) for x in (self.masks, self.views))
        analytic = _ratio(self.analytic_views, self.analytic_signal)
        return {"masks": masks, "views": views, "sampled": masks + views, "analytic": analytic}


@dataclass(frozen=True)
class GradientNoise:
    """All measurements at one model.

    Args:
        gaussians: size of the model.
        dropout: drop rate of the masks.
        views: by name of the view, by loss and by group.
        steps: by loss and by group.
        repeats: whether two evaluations of every analytic gradient agreed bit by bit.
        sampled_seconds: forward and backward of a sampled step, by view; in turns with
        analytic_seconds: those of an analytic one.
    """

    gaussians: int
    dropout: float
    views: dict[str, dict[str, dict[str, Moments]]]
    steps: dict[str, dict[str, StepNoise]]
    repeats: bool
    sampled_seconds: list[list[float]]
    analytic_seconds: list[list[float]]

    def groups(self) -> list[str]:
        """Return the names of the groups, the concatenation of all last."""
        return list(self.steps[LOSSES[0]])

    def over_views(self, loss: str, group: str) -> list[Moments]:
        """Return the moments of a group at every view."""
        return [losses[loss][group] for losses in self.views.values()]

    def law(self, group: str) -> list[tuple[int, float, float]]:
        """Return `Moments.law` of the squared error, mean over the views."""
        laws = [moments.law() for moments in self.over_views("squared", group)]
        means = ([statistics.fmean(x) for x in zip(*entries, strict=True)] for entries in zip(*laws, strict=True))
        return [(int(k), measured, exact) for k, measured, exact in means]

    def seconds(self) -> tuple[float, float]:
        """Return the times of a sampled and of an analytic step: medians, averaged over the views."""
        sampled, analytic = (
            statistics.fmean(map(statistics.median, x)) for x in (self.sampled_seconds, self.analytic_seconds)
        )
        return sampled, analytic

    def summary(self) -> dict[str, Any]:
        """Return what follows from the sums, for JSON: over the views together, by loss and by group."""

        def of(loss: str, group: str) -> dict[str, float]:
            views, step = Moments.total(self.over_views(loss, group)), self.steps[loss][group]
            row = {"relative_noise": views.relative_noise, "share_of_masks": step.share_of_masks, **step.relative()}
            for what in CANDIDATES:
                row |= {f"error_{what}": views.error(what), f"worth_{what}": views.worth(what)}
            return row

        sampled, analytic = self.seconds()
        return {
            **{loss: {group: of(loss, group) for group in self.groups()} for loss in LOSSES},
            "seconds": {"sampled": sampled, "analytic": analytic, "ratio": analytic / sampled},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> GradientNoise:
        """Return what `dataclasses.asdict` wrote, after a way through JSON; unknown entries are ignored."""

        def moments(entry: Mapping[str, Any]) -> Moments:
            values: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in entry.items()}
            return Moments(**values)

        known: dict[str, Any] = {field.name: data[field.name] for field in fields(cls)}
        known["views"] = {
            view: {loss: {name: moments(m) for name, m in groups.items()} for loss, groups in losses.items()}
            for view, losses in data["views"].items()
        }
        known["steps"] = {
            loss: {name: StepNoise(**s) for name, s in groups.items()} for loss, groups in data["steps"].items()
        }
        return cls(**known)


class DrawMoments:
    """Running moments of sampled gradients: two means in float64 and a few numbers, however many draws there are.

    Args:
        analytic: the gradient in expectation, by group; distances are measured from it.

    Example:
        >>> draws = DrawMoments({"x": torch.tensor([2.0])})
        >>> for value in (1.0, 2.0, 4.0, 5.0):
        ...     draws.add({"x": torch.tensor([value])})
        >>> result = draws.result({"x": torch.tensor([0.0])})["x"]
        >>> round(result.variance, 6), result.squared, result.distances  # of 1, 2, 4, 5; the mean is 1.5, then 3
        (3.333333, 9.0, (0.25, 1.0))
    """

    def __init__(self, analytic: Gradients) -> None:
        self.analytic = analytic
        self.count = 0
        self._means = [{name: torch.zeros_like(x, dtype=torch.float64) for name, x in analytic.items()} for _ in "ab"]
        self._scatter = {name: torch.zeros((), dtype=torch.float64, device=x.device) for name, x in analytic.items()}
        self._distances: dict[str, list[float]] = {name: [] for name in analytic}

    def add(self, gradients: Gradients) -> None:
        """Add a draw; the draws go to the two halves in turns."""
        means, n = self._means[self.count % 2], self.count // 2 + 1
        for name, x in gradients.items():
            deviation = x.double() - means[name]
            self._scatter[name] += deviation.square().sum() * ((n - 1) / n)
            means[name] += deviation / n
        self.count += 1
        if self.count > 1 and self.count & (self.count - 1) == 0:
            for name, mean in self.mean().items():
                self._distances[name].append((mean - self.analytic[name]).square().sum().item())

    def mean(self) -> Gradients:
        """Return the mean of an even number of draws, float64."""
        first, second = self._means
        return {name: (x + second[name]) / 2 for name, x in first.items()}

    def result(self, control: Gradients) -> dict[str, Moments]:
        """Return the moments by group, after a power of two of at least 4 draws.

        Args:
            control: another gradient to compare with the mean of the draws.
        """
        k, out = self.count, {}
        for name, mean in self.mean().items():
            first, second = (means[name] for means in self._means)
            scatter = self._scatter[name].item() + k / 4 * dot(first - second, first - second)
            out[name] = Moments(
                draws=k,
                variance=scatter / (k - 1),
                squared=dot(mean, mean),
                halves=(dot(first, second), dot(first, first), dot(second, second)),
                analytic=(dot(self.analytic[name], self.analytic[name]), dot(self.analytic[name], mean)),
                control=(dot(control[name], control[name]), dot(control[name], mean)),
                distances=tuple(self._distances[name]),
            )
        return out


def dot(a: Tensor, b: Tensor) -> float:
    """Return the scalar product of two tensors of one shape, summed in float64."""
    return (a.double() * b.double()).sum().item()


def _ratio(a: float, b: float) -> float:
    """Divide; nan unless the divisor is above 0."""
    return a / b if b > 0 else math.nan


def _powers(draws: int) -> list[int]:
    """Return 2, 4, 8, ... up to a power of two."""
    return [1 << i for i in range(1, draws.bit_length())]
