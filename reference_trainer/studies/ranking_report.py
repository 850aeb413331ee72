"""What a ranking study shows: scores, what the protocol differs from its limit by, correlations, disagreements."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from reference_trainer.evaluation.rank_correlation import kendall, spearman
from reference_trainer.evaluation.results import markdown_table, mean_std
from reference_trainer.files import replacing
from reference_trainer.studies.ranking_scores import VARIANTS, Ranking, RunScores

__all__ = ["correlations", "disagreements", "group_labels", "ranking_figure", "ranking_report"]

_FIVE_OF_LIMIT = 0.8
"""What a population variance of 5 renders is of the variance in expectation; exact scores know no such factor."""

_HOW_TO_READ = """\
Scores are in units of 1e-3, means over the views that have a value ("2/3": two of three views have one, the others no
visible pixel). Correlations are over the runs of one scene; more than a few runs are needed for them to mean anything.

`drop rate` is exact / exact_half: what the protocol's drop rate, which depends on the training, does to the score.
`sampling` is unconditioned / exact_half, the sampling error alone: its expectation is 1. `region` is
limit_conditioned / exact_half: the same exact variance over the pixels that all five renders cover. `selection` is
protocol_half / limit_conditioned: on these pixels, five renders that leave no hole against all. `region` x `selection`
is what the protocol makes of its limit at drop rate 1/2. `neutral` is neutral_half / exact_half: what remains of the
score when holes show no background. The factor (K - 1)/K of the population variance is taken out of all of them.
"""


def group_labels(runs: Sequence[RunScores]) -> list[str]:
    """Name what each run of a scene shares with its other seeds: strategy, views, and settings in which runs differ.

    Args:
        runs: of one scene.

    Returns:
        One label per run; equal for runs that differ in their seed only.

    Example:
        >>> runs = [RunScores("", "fern", "noise 0.8", 3, 0, {"iterations": n}, 9, []) for n in (1000, 2000)]
        >>> group_labels(runs)[1], group_labels(runs[:1])
        ('noise 0.8, 3 views, iterations 2000', ['noise 0.8, 3 views'])
    """
    names = dict.fromkeys(name for run in runs for name in run.settings)
    differ = [name for name in names if len({json.dumps(run.settings.get(name)) for run in runs}) > 1]
    labels = []
    for run in runs:
        # What is off or left to the program needs no word; the others of the scene have one.
        said = {name: value for name in differ if (value := run.settings.get(name)) not in (False, None, "auto")}
        words = [name if value is True else f"{name} {value}" for name, value in said.items()]
        labels.append(", ".join([run.strategy, f"{run.training_views} views", *words]))
    return labels


def correlations(runs: Sequence[RunScores]) -> dict[str, dict[str, float | None]]:
    """Return the rank correlations of every variant with ``exact_half``, ``protocol`` and the test-time PSNR.

    Args:
        runs: of one scene.

    Returns:
        By variant: ``"rho WHAT"`` (Spearman) and ``"tau WHAT"`` (Kendall's tau-b) over the runs that have both values,
        None where there is no order to compare.
    """
    out: dict[str, dict[str, float | None]] = {}
    for variant in VARIANTS:
        out[variant] = {}
        for reference in ("exact_half", "protocol", "psnr"):
            pairs = [(run.mean(variant), run.mean(reference)) for run in runs]
            known = [pair for pair in pairs if all(map(math.isfinite, pair))]
            x, y = [a for a, _ in known], [b for _, b in known]
            out[variant][f"rho {reference}"] = spearman(x, y) if known else None
            out[variant][f"tau {reference}"] = kendall(x, y) if known else None
    return out


def disagreements(runs: Sequence[RunScores]) -> list[dict[str, str]]:
    """Return the pairs of strategies that not all variants order in the same way, by their means over seeds.

    Args:
        runs: of one scene.

    Returns:
        For each pair its name under ``"A / B"`` and by variant the ratio of the means of A and B, in bold where every
        seed of the one is below every seed of the other (given two seeds each); ``"n/a"`` without a value.
    """
    members: dict[str, list[RunScores]] = {}
    for label, run in zip(group_labels(runs), runs, strict=True):
        members.setdefault(label, []).append(run)
    rows = []
    for (one, first), (other, second) in itertools.combinations(members.items(), 2):
        row, signs = {"A / B": f"{one} / {other}"}, set()
        for variant in VARIANTS:
            scores = ([run.mean(variant) for run in group] for group in (first, second))
            a, b = ([x for x in of if math.isfinite(x)] for of in scores)
            ratio = _ratio(mean_std(a)[0], mean_std(b)[0])
            if not math.isfinite(ratio):
                row[variant] = "n/a"
                continue
            signs.add((ratio > 1) - (ratio < 1))
            apart = min(len(a), len(b)) > 1 and (max(a) < min(b) or max(b) < min(a))
            row[variant] = f"**{ratio:.3g}**" if apart else f"{ratio:.3g}"
        if len(signs) > 1:
            rows.append(row)
    return rows


def ranking_report(ranking: Ranking) -> str:
    """Return all tables in Markdown, a section for each scene.

    Args:
        ranking: the measurements.
    """
    variants = list(VARIANTS)
    parts = [
        f"# How the variants of the CA score rank the same models ({ranking.split} views)",
        "\n".join(f"- `{name}`: {text}" for name, text in VARIANTS.items()),
        _HOW_TO_READ.strip(),
    ]
    for scene, runs in ranking.scenes().items():
        labels = [f"{label}, seed {run.seed}" for label, run in zip(group_labels(runs), runs, strict=True)]
        scores = [
            {"run": label, "PSNR": run.mean("psnr"), "Gaussians": run.gaussians}
            | {variant: _score_cell(run, variant) for variant in variants}
            for label, run in zip(labels, runs, strict=True)
        ]
        reasons = [{"run": label, **_reasons(run)} for label, run in zip(labels, runs, strict=True)]
        correlation = [{"variant": name, **row} for name, row in correlations(runs).items()]
        counts = sorted({len(run.views) for run in runs})
        parts += [
            f"## {scene}: {len(runs)} runs, {' or '.join(map(str, counts))} views",
            _table(scores),
            "Why the protocol differs from its limit:",
            _table(reasons),
            "Rank correlations (rho: Spearman, tau: Kendall's tau-b):",
            _table(correlation),
        ]
        if different := disagreements(runs):
            parts += [
                "Strategies that the variants order differently: score of A over score of B, means over seeds; bold "
                "where no two seeds contradict it:",
                _table(different),
            ]
        else:
            parts.append("All variants order the means of the strategies in the same way.")
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def ranking_figure(ranking: Ranking, path: Path) -> None:
    """Draw the protocol and the neutral score against the exact one, all at drop rate 1/2; a row for each scene.

    Args:
        ranking: the measurements.
        path: the PNG to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    scenes = ranking.scenes()
    figure = Figure(figsize=(11, 4.2 * len(scenes)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(scenes), 2, squeeze=False)
    for row, (scene, runs) in zip(grid, scenes.items(), strict=True):
        labels = group_labels(runs)
        order = {label: i for i, label in enumerate(sorted(set(labels)))}
        for ax, (quantity, share) in zip(row, (("protocol_half", _FIVE_OF_LIMIT), ("neutral_half", 1.0)), strict=True):
            for label, i in order.items():
                group = [run for run, name in zip(runs, labels, strict=True) if name == label]
                x, y = ([run.mean(name) * 1e3 for run in group] for name in ("exact_half", quantity))
                ax.scatter(x, y, color=f"C{i % 10}", marker="osD^vP*X<>p"[i % 11], label=label)
            ax.set(xscale="log", yscale="log", title=scene, xlabel="exact_half x1e-3", ylabel=f"{quantity} x1e-3")
            ax.axline(
                (1, share),
                (2, 2 * share),
                color="0.7",
                linewidth=1,
                zorder=0,
                label=f"{share:g} x limit" if share < 1 else "equal",
            )
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 4, 5, 7)))
                axis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axis.set_minor_locator(NullLocator())
            ax.grid(linewidth=0.3)
        row[0].legend(*([x[-1]] for x in row[0].get_legend_handles_labels()), loc="upper left", fontsize=8)
        row[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    with replacing(path) as place:
        figure.savefig(place, dpi=110, format="png")


def _score_cell(run: RunScores, variant: str) -> str | None:
    """Write a score in units of 1e-3, and how many views have one if not all do."""
    value, missing, views = run.mean(variant), run.missing(variant), len(run.views)
    if not math.isfinite(value):
        return None
    return f"{value * 1e3:.4g}" + (f" ({views - missing}/{views})" if missing else "")


def _reasons(run: RunScores) -> dict[str, float]:
    """Return the regions and the factors between the protocol, its limit and the neutral score, at drop rate 1/2."""
    exact = run.mean("exact_half")
    return {
        "visible protocol": run.mean("visible protocol"),
        "visible protocol_half": run.mean("visible protocol_half"),
        "visible exact_half": run.mean("visible exact_half"),
        "drop rate": _ratio(run.mean("exact"), exact),
        "sampling": _ratio(run.mean("unconditioned"), exact * _FIVE_OF_LIMIT),
        "region": _ratio(run.mean("limit_conditioned"), exact),
        "selection": _ratio(run.mean("protocol_half"), run.mean("limit_conditioned") * _FIVE_OF_LIMIT),
        "neutral": _ratio(run.mean("neutral_half"), exact),
    }


def _ratio(a: float, b: float) -> float:
    """Divide two scores; nan where there is no ratio."""
    return a / b if b > 0 else math.nan


def _table(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows of equal columns as a Markdown table."""
    return markdown_table(rows, list(rows[0]))
