"""The picture of the claims: what a regularizer changes, by its strength and by the number of views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reference_trainer.runs.figures import new_figure
from reference_trainer.studies.paper.claims import GAINS, Check
from reference_trainer.studies.paper.page import Kept, differences
from reference_trainer.studies.paper.verdict import interval

if TYPE_CHECKING:  # an extra
    from matplotlib.axes import Axes

__all__ = ["gains_figure"]

_FIGURES = ("test psnr", "PSNR, dB more than without", 1.0), ("test ca_exact_half", "exact CA at 1/2, % more", 0.01)


def gains_figure(kept: Kept, path: Path) -> None:
    """Draw what is kept of `GAINS`: differences of PSNR and of the exact score, with two standard errors, by scene.

    A line needs three places; at strength 0 there is no difference. A single seed has no error bar.

    Args:
        kept: the rows.
        path: the PNG or SVG to write.

    Raises:
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
    """
    with new_figure(path) as figure:
        figure.set_size_inches(12, 6.5)
        panels = figure.subplots(len(_FIGURES), len(GAINS), sharex="col", sharey="row")
        for row, (of, title, unit) in zip(panels, _FIGURES, strict=True):
            row[0].set_ylabel(title)
            for ax, lines in zip(row, GAINS.values(), strict=True):
                ax.axhline(0, color="0.6", linewidth=0.8)
                for style, (name, places) in zip(("-", "--"), lines.items(), strict=False):
                    for color, scene in enumerate(kept.scenes):
                        checks = {x: Check(of, *pair, relative=unit != 1) for x, pair in places.items()}
                        label = f"{scene} {name}".strip()
                        _line(ax, checks, scene, kept, unit, label=label, color=f"C{color}", linestyle=style)
        for ax, (axis, lines) in zip(panels[-1], GAINS.items(), strict=True):
            ax.set_xlabel(axis)
            ticks = sorted({x for places in lines.values() for x in places})
            if ticks[0] > 0:  # numbers of views
                ax.set_xscale("log")
                ax.set_xticks(ticks, labels=[f"{x:g}" for x in ticks])
                ax.minorticks_off()
            if ax.get_legend_handles_labels()[0]:
                ax.legend(fontsize="small")


def _line(ax: Axes, checks: Mapping[float, Check], scene: str, kept: Kept, unit: float, **style: Any) -> None:
    """Draw the mean differences of one scene in units, those that are measured."""
    found = {x: differences(check, scene, kept) for x, check in checks.items()}
    drawn = {x: interval(seeds) for x, seeds in found.items() if seeds}
    if len(drawn) > 2:
        means, errors = ([y / unit for y in of] for of in zip(*drawn.values(), strict=True))
        bars = [error if math.isfinite(error) else 0.0 for error in errors]
        ax.errorbar([*drawn], means, bars, marker=".", capsize=2, **style)
