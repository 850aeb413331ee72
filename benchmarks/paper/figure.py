"""Figures of the claims: gains by strength and number of views, settings ranked by their gain, courses of trainings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.cells import SIXTHS
from benchmarks.paper.claims import CLAIMS, GAINS, Check
from benchmarks.paper.comparison import RowStore, differences, interval, ranked, tested
from benchmarks.paper.rows import Row, value
from reference_trainer.evaluation.style import COLORS, WIDTH, new_figure, readable

__all__ = ["course_figure", "gains_figure", "ranking_figure"]

_FIGURES = ("test psnr", "gain in PSNR (dB)", 1.0), ("test ca_exact_half", "change of exact CA (%)", 0.01)
_DASHES = ".-", ".--"
_COURSE = ("path", "CA (1e-3)", 1e-3), ("course psnr/test", "PSNR (dB)", 1.0)


def gains_figure(store: RowStore, path: Path) -> None:
    """Plot what is kept of `GAINS`: differences in PSNR and in the exact score, with two standard errors, by scene.

    A scene has one color; lines of one scene differ by their dashes. A line needs at least three points, a column of
    panels at least one line. A single seed has no error bar.

    Args:
        store: the rows.
        path: the PNG or SVG to write.

    Raises:
        ValueError: if there is no line to plot.
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
    """
    panels = {axis: [_lines(axis, of, unit, store) for of, _, unit in _FIGURES] for axis in GAINS}
    panels = {axis: of for axis, of in panels.items() if any(of)}
    if not panels:
        raise ValueError(
            f"{store.folder} has no setting at three strengths or numbers of views: there is no line to plot."
        )
    colors = _colors(store)
    with new_figure(path) as figure:
        figure.set_size_inches(WIDTH, 5.6)
        grid = figure.subplots(len(_FIGURES), len(panels), sharex="col", sharey="row", squeeze=False)
        for row, (_, title, _) in zip(grid, _FIGURES, strict=True):
            row[0].set_ylabel(title)
        for column, (axis, of) in zip(grid.T, panels.items(), strict=True):
            for ax, lines in zip(column, of, strict=True):
                ax.axhline(0, color="0.6", linewidth=0.8)
                for (scene, name), places in lines.items():
                    means, errors = zip(*places.values(), strict=True)
                    style = _DASHES[[*GAINS[axis]].index(name)]
                    label = ", ".join(map(readable, filter(None, (scene, name))))
                    ax.errorbar([*places], means, errors, fmt=style, color=colors[scene], label=label, capsize=2)
            ticks = sorted({x for lines in of for places in lines.values() for x in places})
            if ticks[0] > 0:  # numbers of views
                ax.set_xscale("log")
                ax.set_xticks(ticks, labels=[f"{x:g}" for x in ticks])
                ax.minorticks_off()
            ax.set_xlabel(axis)
            lowest = [ax for ax, lines in zip(column, of, strict=True) if lines][-1]
            lowest.legend(loc="upper right", bbox_to_anchor=(1.0, 0.93), fontsize=9)


def ranking_figure(store: RowStore, names: Sequence[str], path: Path) -> None:
    """Plot the settings of claims, the best first: difference in PSNR with two standard errors, and in the exact score.

    Args:
        store: the rows.
        names: of the claims, each with a row of two panels.
        path: the PNG or SVG to write.

    Raises:
        ValueError: if nothing is known of a claim.
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
    """
    ranks = {name: ranked(name, store) for name in names}
    if unknown := [name for name, rank in ranks.items() if not rank]:
        raise ValueError(f"{store.folder} has no two seeds of the settings of claim {unknown[0]}: nothing to rank.")
    colors, sizes = _colors(store), [len(rank) for rank in ranks.values()]
    with new_figure(path) as figure:
        figure.set_size_inches(WIDTH, 0.5 * len(sizes) + 0.27 * sum(sizes))
        grid = figure.subplots(len(sizes), 2, sharex="col", sharey="row", squeeze=False, height_ratios=sizes)
        for row, rank in zip(grid, ranks.values(), strict=True):
            scenes = sorted({scene for _, _, gains in rank for scene in gains})
            for number, scene in enumerate(scenes):
                known = [(place, gains[scene]) for place, (_, _, gains) in enumerate(rank) if scene in gains]
                # The scenes of a setting stand below each other, so that their bars do not cover each other.
                heights = [place + 0.5 * (number / max(1, len(scenes) - 1) - 0.5) for place, _ in known]
                style = {"fmt": ".", "color": colors[scene], "label": readable(scene), "capsize": 2}
                row[0].errorbar([x.psnr for _, x in known], heights, xerr=[x.error for _, x in known], **style)
                row[1].plot([100 * x.score for _, x in known], heights, ".", color=colors[scene])
            for panel in row:
                panel.axvline(0, color="0.6", linewidth=0.8)
            row[0].set_yticks(range(len(rank)), labels=[readable(named) for named, _, _ in rank])
            row[0].set_ylim(len(rank) - 0.5, -0.5)
        for panel, (_, title, _) in zip(grid[-1], _FIGURES, strict=True):
            panel.set_xlabel(title)
        _legend_below(figure, grid[:, 0])


def course_figure(store: RowStore, names: Sequence[str], path: Path) -> None:
    """Plot CA and PSNR of test views at every sixth of the steps, with two standard errors, by claim and scene.

    Args:
        store: the rows.
        names: of claims about the course of trainings. A scene with a single seed is left out.
        path: the PNG or SVG to write.

    Raises:
        ValueError: if a claim has no scene with two seeds.
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
    """
    columns = list[tuple[str, list[list[Row]]]]()
    for name in names:
        claim, before = CLAIMS[name], len(columns)
        system = readable(str(claim.settings[0].get("recipe", store.recipe)))
        for scene in tested(claim, store):
            rows = [[*store.of(scene, setting).values()] for setting in claim.settings]
            if min(map(len, rows)) > 1:
                columns.append((f"{readable(scene)}\n{system}", rows))
        if len(columns) == before:
            raise ValueError(f"{store.folder} has no two seeds of the settings of claim {name}: nothing to plot.")
    # Settings are told apart by their regularizers: what else they have stands above the panels.
    labels = [readable(str(x.get("regularizer", "plain"))) for x in CLAIMS[names[0]].settings]
    sixths = range(1, SIXTHS + 1)
    with new_figure(path) as figure:
        figure.set_size_inches(max(WIDTH, 1.8 * len(columns)), 4.6)
        grid = figure.subplots(len(_COURSE), len(columns), sharex=True, squeeze=False)
        for column, (title, rows) in zip(grid.T, columns, strict=True):
            column[0].set_title(title)
            column[-1].set_xlabel("sixths of the steps")
            for panel, (of, _, unit) in zip(column, _COURSE, strict=True):
                for label, seeds, color in zip(labels, rows, COLORS, strict=False):
                    ends = [interval([value(row, f"{of} {sixth}") / unit for row in seeds]) for sixth in sixths]
                    means, errors = zip(*ends, strict=True)
                    panel.errorbar(sixths, means, errors, fmt=".-", color=color, label=label, capsize=2)
                panel.set_xticks(sixths)
        for row, (_, title, _) in zip(grid, _COURSE, strict=True):
            row[0].set_ylabel(title)
        _legend_below(figure, grid[0])


def _colors(store: RowStore) -> dict[str, str]:
    """Return the color of every scene, the same in all figures and that of no strategy."""
    return {scene: COLORS[number % len(COLORS)] for number, scene in enumerate(store.scenes)}


def _legend_below(figure: Any, panels: Iterable[Any]) -> None:
    """Put one legend for several panels below the figure, each of its lines once."""
    lines = {text: line for ax in panels for line, text in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend([*lines.values()], [*lines], loc="outside lower center", ncols=min(4, len(lines)))


def _lines(axis: str, of: str, unit: float, store: RowStore) -> dict[tuple[str, str], dict[float, tuple[float, float]]]:
    """Return the lines of a panel by scene and name: mean and two standard errors in ``unit``, by position."""
    lines = {}
    for name, pairs in GAINS[axis].items():
        for scene in store.scenes:
            found = {x: differences(Check(of, *pair, relative=unit != 1), scene, store) for x, pair in pairs.items()}
            ends = {x: interval(seeds) for x, seeds in found.items() if seeds}
            places = {
                x: (mean / unit, error / unit if math.isfinite(error) else 0.0) for x, (mean, error) in ends.items()
            }
            if len(places) > 2:
                lines[scene, name] = places
    return lines
