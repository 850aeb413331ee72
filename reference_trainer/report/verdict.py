"""What a report says first: natural names for the runs, the table of their scores, and a verdict made from its rows."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

from reference_trainer.evaluation.style import COLORS, STRATEGIES
from reference_trainer.evaluation.tables import QUANTITIES, Quantity, mean_std
from reference_trainer.training.config import TrainConfig

__all__ = [
    "FEWEST_SEEDS", "Rows", "differences", "natural_name", "natural_order", "run_colors", "score_columns",
    "unique_names", "verdict",
]  # fmt: skip

_USUAL = TrainConfig()
_COLUMNS = (
    ("test", "psnr"), ("test", "psnr_expected"), ("test", "ssim"), ("test", "lpips"), ("test", "ca_exact_half"),
    ("between", "psnr_expected"), ("around", "psnr_expected"), ("between", "ca_exact_half"),
    ("around", "ca_exact_half"), ("train", "psnr"), ("train", "ca_exact_half"), ("", "gaussians"), ("", "seconds"),
)  # fmt: skip
"""Split and quantity, in order."""

FEWEST_SEEDS = 3
"""Of each of two runs, to say whether they can be told apart."""


def natural_name(config: TrainConfig) -> str:
    """Return what people call a run: what it is regularized with, and a loss or density control of its own.

    Example:
        >>> natural_name(TrainConfig()), natural_name(TrainConfig(dropout=0.2, noise=0.8, analytic=True))
        ('Baseline', 'Analytic dropout 0.2 + noise 0.8')
    """
    name = re.sub(r"\b(dropout|noise)\(([\d.e-]+)\)", r"\1 \2", config.regularizers) or "baseline"
    parts = ["analytic " * config.analytic + name]
    parts += [x for x, usual in ((config.loss, _USUAL.loss), (config.density, _USUAL.density)) if x != usual]
    return (text := ", ".join(parts))[:1].upper() + text[1:]


def natural_order(config: TrainConfig) -> tuple[int, bool]:
    """Return a key that sorts runs: baseline, dropout, noise, both, anything else; the analytic ones after the drawn.

    Example:
        >>> natural_order(TrainConfig(noise=0.8)) < natural_order(TrainConfig(dropout=0.2, noise=0.8))
        True
    """
    # Without their arguments, which may be schedules with arguments of their own.
    kinds = set(re.sub(r"\((?:[^()]|\([^()]*\))*\)", "", config.regularizers).replace("+", " ").split())
    order = [set(), {"dropout"}, {"noise"}, {"dropout", "noise"}, kinds]
    other = (config.loss, config.density) != (_USUAL.loss, _USUAL.density)
    # `kinds` itself closes the list: any other combination gets its index.
    return 4 if other else order.index(kinds), config.analytic


def unique_names(configs: Sequence[TrainConfig], paths: Sequence[str]) -> list[str]:
    """Return a name for each run: the natural one, with its path where several share it."""
    names = [natural_name(config) for config in configs]
    shared = Counter(names)
    return [name if shared[name] == 1 else f"{name} ({path})" for name, path in zip(names, paths, strict=True)]


def run_colors(configs: Sequence[TrainConfig]) -> list[str]:
    """Return a color for each run: that of its strategy for the first of each, one of its own for all others.

    Example:
        >>> run_colors([TrainConfig(), TrainConfig(dropout=0.2), TrainConfig(dropout=0.4)])
        ['#0072B2', '#E69F00', '#56B4E9']
    """
    of_strategies, others = [*STRATEGIES.values(), ""], cycle(COLORS)
    found: list[str] = []
    for config in configs:
        of = of_strategies[natural_order(config)[0]]
        found.append(of if of and of not in found else next(others))
    return found


@dataclass(frozen=True)
class Rows:
    """The rows of a strategy that a verdict is made from."""

    name: str
    baseline: bool  # whether it is one without a regularizer
    results: Sequence[Mapping[str, Any]]  # content of ``results.json`` of each of its seeds
    color: str = ""  # that the page shows it in

    def values(self, split: str, key: str) -> list[float]:
        """Return a mean over the views of a split, of every seed that has it."""
        found = [(of["mean"].get(split, {}) if split else of).get(key) for of in self.results]
        return [float(x) for x in found if x is not None and math.isfinite(x)]

    def mean(self, split: str, key: str) -> float:
        """Return the mean of `values`; nan without any."""
        return mean_std(self.values(split, key))[0]

    def text(self, split: str, key: str) -> str:
        """Return mean and standard deviation of `values` as tables show them."""
        return QUANTITIES[key].text(self.values(split, key))


def _shown(split: str, key: str) -> Quantity:
    """Return how a quantity is shown at the views of a split; at training views neither end is a merit."""
    return QUANTITIES[key]._replace(highest_is_best=None) if split == "train" else QUANTITIES[key]


def _difference(rows: Rows, reference: Rows, split: str, key: str) -> tuple[float, float] | None:
    """Return the difference of two means and two standard errors of it, nan with a single seed; None without values."""
    values, others = rows.values(split, key), reference.values(split, key)
    if not values or not others:
        return None
    (mean, std), (other, spread) = mean_std(values), mean_std(others)
    # Variances of independent means add up. With one seed the standard deviation, and so the margin, is nan.
    return mean - other, 2 * math.sqrt(std**2 / len(values) + spread**2 / len(others))


def differences(first: Rows, second: Rows) -> list[dict[str, object]]:
    """Return a row for every score that both have: both scores, the difference, and whether seeds tell them apart.

    The difference is that of the means, with two of its standard errors. Below `FEWEST_SEEDS` of either, the spread is
    not known well enough to tell anything apart.
    """
    rows: list[dict[str, object]] = []
    for split, key in _COLUMNS:
        if (found := _difference(second, first, split, key)) is None:
            continue
        title, decimals, unit, highest = _shown(split, key)
        delta, margin = (x / unit for x in found)
        known = min(len(of.values(split, key)) for of in (first, second)) >= FEWEST_SEEDS
        said = "no" if known else "unknown"
        if known and abs(delta) > margin:
            said = "yes" if highest is None else "yes, better" if (delta > 0) == highest else "yes, worse"
        rows.append({
            "score": f"{split} {title}".strip(),
            first.name: first.text(split, key),
            second.name: second.text(split, key),
            "difference": f"{delta:+.{decimals}f}" + f" ± {margin:.{decimals}f}" * known,
            "told apart": said,
        })  # fmt: skip
    return rows


def score_columns(strategies: Sequence[Rows]) -> list[dict[str, Any]]:
    """Return the columns of the scores: ``split``, ``title``, ``cells`` of ``text``, ``best``, ``delta``, ``better``.

    ``delta`` is the difference to the first strategy as text, ``better`` whether that is an improvement (None where
    neither direction is one). In a column that has a best figure, it is marked, and so are all that share it. A cell of
    the expected PSNR also has the ``interval`` of a view: the means of its two ends.
    """
    columns = []
    unseen = {split for of in strategies for run in of.results for split in run["mean"]}
    for split, key in _COLUMNS:
        title, decimals, unit, highest = _shown(split, key)
        means = [of.mean(split, key) / unit for of in strategies]
        if (split and split not in unseen) or all(map(math.isnan, means)):
            continue
        # Compared as they are shown: two figures that read the same must not be ranked.
        rounded = [round(mean, decimals) for mean in means]
        known = [mean for mean in rounded if not math.isnan(mean)]
        best = None if highest is None or len(known) < 2 else max(known) if highest else min(known)
        cells: list[dict[str, Any]] = []
        for i, (of, mean) in enumerate(zip(strategies, rounded, strict=True)):
            cell = {"text": of.text(split, key), "best": mean == best}
            if key == "psnr_expected" and not math.isnan(mean):
                low, high = of.mean(split, "psnr_low"), of.mean(split, "psnr_high")
                cell["interval"] = f"{low:.{decimals}f} to {high:.{decimals}f}"
            if i and highest is not None and math.isfinite(delta := mean - rounded[0]):
                cell["delta"] = f"{delta:+.{decimals}f}".replace("-", "\N{MINUS SIGN}")
                cell["better"] = None if not round(delta, decimals) else (delta > 0) == highest
            cells.append(cell)
        columns.append({"split": split, "title": title, "cells": cells})
    return columns


def verdict(strategies: Sequence[Rows], other: Sequence[str] = ()) -> tuple[str, list[str]]:
    """Return one sentence on what the rows show, and its evidence: the other strategies, the rule, what limits it.

    Strategies, which have scores, are compared with the first. Two means are told apart if their difference exceeds two
    of its standard errors, by the spread over seeds; with one seed no spread is known, and the evidence says so, as it
    does if ``other`` settings than the regularizers differ between the runs.
    """
    if not strategies:
        return "No verdict: no run has been trained to its end.", []
    reference, *rest = strategies
    runs = [run for rows in strategies for run in rows.results]
    tested = [sum(view["split"] == "test" for view in run["views"]) for run in runs]
    split = "test" if all(tested) else "around"
    where = f"on the {tested[0]} test view{'s' * (tested[0] != 1)}" if all(tested) else "around the training views"
    limits = [] if all(tested) else ["Without test views, nothing is known about the quality at unseen views."]
    # Cameras around the training views have numbers alone, and stand elsewhere if those differ.
    kind, done = ("test", "tested") if any(tested) else ("train", "trained")
    if len({frozenset(view["name"] for view in run["views"] if view["split"] == kind) for run in runs}) > 1:
        where = "each on its own test views" if all(tested) else where
        limits += [f"The runs were not {done} on the same views, so these scores cannot be compared."]
    if not rest:
        psnr, ca = (reference.mean(split, key) for key in ("psnr", "ca_exact_half"))
        found = [f"PSNR {psnr:.2f} dB"] * math.isfinite(psnr) + [f"exact CA {ca * 1e3:.2f}e-3"] * math.isfinite(ca)
        text = f"{reference.name}: {' and '.join(found) or 'nothing was measured'} {where}."
        return text, [*limits, "Nothing stands beside it: add a second run to compare it with."]
    said = [_said(rows, reference, split) for rows in rest]
    sign, key = (1, "psnr") if split == "test" else (-1, "ca_exact_half")
    measured = [i for i, rows in enumerate(rest) if rows.values(split, key)] or [0]
    best = max(measured, key=lambda i: sign * rest[i].mean(split, key))
    merit = "highest PSNR" if split == "test" else "least co-adaptation"
    differs, than = said[best]
    text = f"{rest[best].name}{f' (the {merit} of {len(rest)})' * (len(rest) > 1)}: "
    text += f"{differs} {than} " if differs else "no score in common with "
    text += f"{reference.name if not reference.baseline else 'the baseline'} {where}."
    evidence = [f"{rows.name}: {said[i][0] or 'no score in common'}." for i, rows in enumerate(rest) if i != best]
    seeds = {len(rows.results) for rows in strategies}
    if min(seeds) > 1:
        evidence.append(
            f"{min(seeds)} {'or more ' * (len(seeds) > 1)}seeds each. Two means are told apart if they differ by more "
            "than two standard errors of the difference, by the spread over the seeds."
        )
    else:
        evidence.append("One seed: no spread is known, and another seed may turn a small difference around.")
    if other:
        evidence.append(f"The runs differ in {', '.join(other)} too, so this is not the regularizer's effect alone.")
    return text, evidence + limits


def _said(rows: Rows, reference: Rows, split: str) -> tuple[str, str]:
    """Return how a strategy differs from the reference in PSNR and co-adaptation, and the word before its name.

    Both are empty if the two share no score.
    """
    parts = []
    if split == "test" and (found := _difference(rows, reference, split, "psnr")):
        parts.append(_part("PSNR", found, f"{abs(found[0]):.2f} dB", ("lower", "higher")))
    if found := _difference(rows, reference, split, "ca_exact_half"):
        delta, usual = abs(found[0]), reference.mean(split, "ca_exact_half")
        size = f"{100 * delta / usual:.0f} %" if usual else f"{delta * 1e3:.2f}e-3"
        parts.append(_part("co-adaptation", found, size, ("less", "more")))
    return " and ".join(text for text, _ in parts), parts[-1][1] if parts else ""


def _part(score: str, found: tuple[float, float], size: str, words: tuple[str, str]) -> tuple[str, str]:
    """Return a difference in one score, of this size and in this direction, and the word that follows it."""
    delta, margin = found
    text = f"{size} {words[delta > 0]}"
    if abs(delta) <= margin:  # nan with a single seed
        return f"a {score} that cannot be told apart ({text})", "from"
    return (f"{text} {score}", "than") if float(size.split()[0]) else (f"the same {score}", "as")
