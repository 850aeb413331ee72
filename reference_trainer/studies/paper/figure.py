"""The figure of the claims: the effect of a regularizer against its strength and the number of views."""

from __future__ import annotations

import math
from pathlib import Path

from reference_trainer.runs.figures import new_figure
from reference_trainer.studies.paper.claims import GAINS, Check
from reference_trainer.studies.paper.page import Kept, differences
from reference_trainer.studies.paper.verdict import interval

__all__ = ["gains_figure"]

_FIGURES = ("test psnr", "PSNR, dB more than without", 1.0), ("test ca_exact_half", "exact CA at 1/2, % more", 0.01)
_DASHES = ".-", ".--"


def gains_figure(kept: Kept, path: Path) -> None:
    """Draw what is kept of `GAINS`: differences in PSNR and in the exact score, with two standard errors, by scene.

    A scene has one color; lines of one scene differ by their dashes. A line needs at least three points, a column of
    panels at least one line. A single seed has no error bar.

    Args:
        kept: the rows.
        path: the PNG or SVG to write.

    Raises:
        ValueError: if there is no line to draw.
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
    """
    panels = {axis: [_lines(axis, of, unit, kept) for of, _, unit in _FIGURES] for axis in GAINS}
    panels = {axis: of for axis, of in panels.items() if any(of)}
    if not panels:
        raise ValueError(
            f"{kept.folder} has no setting at three strengths or numbers of views: there is no line to draw."
        )
    colors = {scene: f"C{number}" for number, scene in enumerate(kept.scenes)}
    with new_figure(path) as figure:
        figure.set_size_inches(1.5 + 4.5 * len(panels), 7)
        grid = figure.subplots(len(_FIGURES), len(panels), sharex="col", sharey="row", squeeze=False)
        for row, (_, title, _) in zip(grid, _FIGURES, strict=True):
            row[0].set_ylabel(title)
        for column, (axis, of) in zip(grid.T, panels.items(), strict=True):
            for ax, lines in zip(column, of, strict=True):
                ax.axhline(0, color="0.6", linewidth=0.8)
                for (scene, name), places in lines.items():
                    means, errors = zip(*places.values(), strict=True)
                    style = _DASHES[[*GAINS[axis]].index(name)]
                    label = f"{scene} {name}".strip()
                    ax.errorbar([*places], means, errors, fmt=style, color=colors[scene], label=label, capsize=2)
            ticks = sorted({x for lines in of for places in lines.values() for x in places})
            if ticks[0] > 0:  # numbers of views
                ax.set_xscale("log")
                ax.set_xticks(ticks, labels=[f"{x:g}" for x in ticks])
                ax.minorticks_off()
            ax.set_xlabel(axis)
            column[0].legend(fontsize="small")


def _lines(axis: str, of: str, unit: float, kept: Kept) -> dict[tuple[str, str], dict[float, tuple[float, float]]]:
    """Return the lines of a panel by scene and name: mean and two standard errors in ``unit``, by position."""
    lines = {}
    for name, pairs in GAINS[axis].items():
        for scene in kept.scenes:
            found = {x: differences(Check(of, *pair, relative=unit != 1), scene, kept) for x, pair in pairs.items()}
            ends = {x: interval(seeds) for x, seeds in found.items() if seeds}
            places = {
                x: (mean / unit, error / unit if math.isfinite(error) else 0.0) for x, (mean, error) in ends.items()
            }
            if len(places) > 2:
                lines[scene, name] = places
    return lines
