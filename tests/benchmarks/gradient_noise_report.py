"""What the study of gradient noise shows: Markdown tables and a figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.gradient_noise_moments import CANDIDATES, LOSSES, GradientNoise, Moments
from reference_trainer.evaluation.tables import format_mean_std, markdown_table

__all__ = ["gradient_noise_figure", "gradient_noise_report", "gradient_noise_table"]

_HOW_TO_READ = """\
Gradients of one step at fixed parameters. `mu` is the expectation over the masks, g a sampled gradient, V its trace
variance; |mu|^2 is estimated without the upward bias V / K of the mean of K draws. Groups have different units, so each
row stands for itself; `all` is the plain concatenation, in which the group with the largest gradients prevails.
Mean ± deviation is over the training views.

First table, photometric loss, for a step that picks a view at random. `V / |mu|^2`: noise of the mask at one view.
The others are relative to the squared length of the gradient that is expected over the views too: `masks` is the mean
of V, `views` the variance between the expected gradients of the views, `sampled` their sum, `analytic` what is left
without masks. `share of masks` is masks / (masks + views). n/a: the squared length is not above 0 in so few draws.

Second table. `cosine`: between the analytic gradient and the mean of the draws. `ceiling`: what the true expectation
would reach on average, from the cosine r of two halves of the draws as sqrt(2 r / (1 + r)) (Spearman-Brown).
`length`: |analytic| / |mu| - 1. `error`: |analytic - mu|^2 / |mu|^2, unbiased, so around 0 (of either sign) if there
is none. `worth`: the number of draws whose average is as far from mu as the analytic gradient is, sum of V / sum of
|analytic - mu|^2 over the views; n/a if no distance was found. `control` is the plain loss of the render with scaled
opacities, without a variance term.

Third table, squared error, where the analytic gradient is the expectation: the distance of the mean of k draws from it,
in units of |mu|, falls as sqrt(V / k) if it is. The k are those of one growing average.
"""


def gradient_noise_report(results: Mapping[str, GradientNoise]) -> str:
    """Return how to read the tables, and a section for each run, in Markdown.

    Args:
        results: by the name of the run.
    """
    sections = [f"## {name}\n\n{gradient_noise_table(result)}" for name, result in results.items()]
    return "\n".join(["# What sampling costs the gradient\n", _HOW_TO_READ, *sections])


def gradient_noise_table(result: GradientNoise) -> str:
    """Return the three tables of one run, and the time of a step, in Markdown."""
    groups = result.groups()
    noise = [
        {
            "group": group,
            "V / |mu|^2": format_mean_std(m.relative_noise for m in result.over_views("photometric", group)),
            **result.steps["photometric"][group].relative(),
            "share of masks": f"{result.steps['photometric'][group].share_of_masks:.1%}",
        }
        for group in groups
    ]
    nearness: list[dict[str, object]] = []
    for loss in LOSSES:
        for group in groups:
            views = result.over_views(loss, group)
            row: dict[str, object] = {
                "loss, group": f"{loss}, {group}",
                "ceiling": format_mean_std(m.ceiling for m in views),
            }
            for what in CANDIDATES:
                row |= {
                    f"cosine {what}": format_mean_std(m.cosine(what) for m in views),
                    f"length {what}": format_mean_std(m.length(what) for m in views),
                    f"error {what}": format_mean_std(m.error(what) for m in views),
                    f"worth {what}": Moments.total(views).worth(what),
                }
            nearness.append(row)
    law = [
        {"group": group} | {f"k = {k}": f"{measured:.3g} ({exact:.3g})" for k, measured, exact in result.law(group)}
        for group in groups
    ]
    sampled, analytic = result.seconds()
    draws = result.over_views("squared", groups[0])[0].draws
    return "\n".join(
        [
            f"{result.gaussians} Gaussians, {len(result.views)} training views, dropout {result.dropout:g}, "
            f"K = {draws} draws.\n",
            markdown_table(noise, list(noise[0])),
            markdown_table(nearness, list(nearness[0])),
            "Measured distance (expected one if the analytic gradient is the expectation), mean over the views:\n",
            markdown_table(law, list(law[0])),
            f"- One step, forward and backward: sampled {sampled:.3g} s, analytic {analytic:.3g} s, ratio "
            f"{analytic / sampled:.2f}.",
            f"- Two evaluations of the analytic gradient {'agree' if result.repeats else 'do not agree'} bit by bit.",
            "",
        ]
    )


def gradient_noise_figure(results: Mapping[str, GradientNoise], figure: Any) -> None:
    """Draw the relative noise of a sampled and of an analytic step for every group, one panel per run.

    Args:
        results: by the title of the panel.
        figure: an empty one of matplotlib.
    """
    figure.set_size_inches(6 * len(results), 4.5)
    panels = figure.subplots(1, len(results), squeeze=False)[0]
    for axes, (name, result) in zip(panels, results.items(), strict=True):
        groups = result.groups()
        parts = [result.steps["photometric"][group].relative() for group in groups]
        # A variance that was estimated below 0 has no bar.
        masks, views, analytic = ([max(part[key], 0.0) for part in parts] for key in ("masks", "views", "analytic"))
        left, right = ([i + shift for i in range(len(groups))] for shift in (-0.2, 0.2))
        axes.bar(left, views, 0.38, color="C0", label="sampled: choice of the view")
        axes.bar(left, masks, 0.38, bottom=views, color="C1", label="sampled: masks")
        axes.bar(right, analytic, 0.38, color="C2", label="analytic: choice of the view")
        axes.set_xticks(range(len(groups)), groups, rotation=25, ha="right")
        axes.set(title=name, ylabel="variance / squared expectation of the gradient")
        axes.grid(axis="y", alpha=0.3)
    lines = dict(zip(*reversed(panels[-1].get_legend_handles_labels()), strict=True))
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize="small")
