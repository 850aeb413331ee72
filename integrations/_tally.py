"""Counts of what a hook did: renders it changed, and renders it left alone by reason."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

__all__ = ["Skip", "Tally"]


class Skip(StrEnum):
    """Why a render was left alone."""

    FURTHER_VIEW = (
        "render of another place in the script, after the first of its iteration (scope main); if it is a training "
        "view like the first: --scope all"
    )
    CONSTANT_OPACITY = "opacities that are not trained, such as a depth render with constant ones"
    DETACHED_MEANS = "positions that are not trained, such as a depth render for the opacities"
    RATE_ZERO = "training render at a step where the rate is 0"
    NOTHING_TO_SCALE = "test render of a regularizer that scales nothing"
    SCORE = "render of a co-adaptation score"


@dataclass
class Tally:
    """Counts of rasterizer calls.

    Args:
        regularized: training renders whose Gaussians were dropped or perturbed.
        scaled: renders without gradients, or for a viewer, with test-time values.
        skipped: renders left alone, by reason.
        first_step: step of the first regularized render; None if there was none.
        last_step: step of the last regularized render; None if there was none.
        lost: training steps without a render that could be regularized.
    """

    regularized: int = 0
    scaled: int = 0
    skipped: Counter[Skip] = field(default_factory=Counter)
    first_step: int | None = None
    last_step: int | None = None
    lost: int = 0

    def count_regularized(self, step: int) -> None:
        """Count a regularized render."""
        self.regularized += 1
        self.first_step = step if self.first_step is None else self.first_step
        self.last_step = step

    def shortfall(self, optimizer_steps: int) -> str | None:
        """Describe how a run fell short of being regularized; None if it did not.

        Training counts as regularized if some render was, and renders that were, or had a rate of 0, outnumber lost
        steps nine to one. A script that only renders, without optimizer steps of Gaussians, needs a test render.
        """
        rendered = self.regularized + self.skipped[Skip.RATE_ZERO]
        if not (rendered or optimizer_steps or self.lost):
            tested = self.scaled or self.skipped[Skip.NOTHING_TO_SCALE]
            return None if tested else "No render was regularized or scaled."
        if not self.regularized:
            return "The training was not regularized."
        if self.lost > rendered / 9:
            return f"{self.lost} training steps had no render that could be regularized."
        return None

    def as_dict(self) -> dict[str, Any]:
        """Return the counts for JSON."""
        return vars(self) | {"skipped": {reason.name.lower(): count for reason, count in self.skipped.items()}}

    def lines(self) -> list[str]:
        """Return the counts in words, one per line."""
        steps = "" if self.first_step is None else f", steps {self.first_step} to {self.last_step}"
        lines = [f"{self.regularized} renders regularized{steps}", f"{self.scaled} renders scaled for evaluation"]
        lines += [f"{count} renders left alone: {reason.value}" for reason, count in self.skipped.most_common()]
        if self.lost:
            lines.append(f"{self.lost} training steps without a render that could be regularized")
        if not self.regularized + self.scaled:
            lines.append("NOTHING was regularized or scaled")
        return lines
