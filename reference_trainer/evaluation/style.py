"""One style for all figures: a strategy has one color everywhere, readable names, and text that is legible at 700 px.

A figure is at most `WIDTH` inches wide, so that its text, of 10 points, has 12 pixels where a page shows it 700 wide.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reference_trainer.files import replacing

if TYPE_CHECKING:  # an extra
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = ["COLORS", "STRATEGIES", "WIDTH", "color", "in_thousandths", "new_figure", "readable"]

WIDTH = 8.5
"""Inches."""

STRATEGIES = {"baseline": "#0072B2", "dropout": "#E69F00", "noise": "#009E73", "both": "#AA3377"}
"""The color of each strategy of `compare`; people with any color vision can tell them apart (Okabe and Ito, Tol)."""

COLORS = "#56B4E9", "#D55E00", "#555555", "#8C6BB1", "#997700"
"""The colors of what is no strategy, such as scenes, in order."""

_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True, "axes.edgecolor": "0.5", "axes.grid": True, "axes.spines.right": False,
    "axes.spines.top": False, "axes.titlesize": 11, "axes.titleweight": "bold", "figure.constrained_layout.use": True,
    "font.size": 10, "grid.color": "0.9", "legend.fontsize": 10, "legend.frameon": False, "lines.markersize": 5,
    "xtick.color": "0.3", "ytick.color": "0.3",
}  # fmt: skip

_NAMES = {
    "3dgs": "3DGS", "absgs": "AbsGS", "binocular": "Binocular3DGS", "corgs": "CoR-GS", "dngaussian": "DNGaussian",
    "fsgs": "FSGS", "inria": "3DGS (INRIA)", "mvgs": "MVGS", "segs": "SE-GS",
    "plain": "without a regularizer", "dropout": "dropout", "noise": "opacity noise", "both": "dropout and noise",
    "soft": "soft dropout", "concrete": "binary concrete", "clustered": "dropout of neighbors",
    "density": "dropout by density", "geometry": "dropout by geometry", "depth": "dropout by depth",
    "drop_gaussian": "DropGaussian", "drop_anchors": "DropAnSH-GS", "drop_sh": "dropout of color bands",
    "d2gs": "D²GS", "position_noise": "position noise", "scale_noise": "scale noise", "sh_noise": "color noise",
    "consistency": "consistency loss", "opacity_decay": "opacity decay", "analytic": "expectation",
    "fern": "Fern", "synthetic": "built-in scene", "herz-jesu": "Herz-Jesu", "fountain": "Fountain", "lego": "Lego",
    "dtu-scan24": "DTU scan24", "dtu-scan65": "DTU scan65", "sceaux": "Sceaux", "cape": "Cape",
}  # fmt: skip


def readable(label: str) -> str:
    """Return a readable name of a strategy, a setting or a scene: without schedules, with a single number at most.

    Example:
        >>> readable("dngaussian, dropout(0.2)"), readable("d2gs(ramp(0.05, 0.3, 0, 10_000))"), readable("both/seed_0")
        ('DNGaussian, dropout 0.2', 'D²GS', 'dropout and noise')
        >>> readable("loss=photometric + consistency(0.4, 0.2)"), readable("opacity_decay=0.999"), readable("my_scene")
        ('consistency loss', 'opacity decay 0.999', 'my_scene')
    """
    plain = re.sub(r"/seed_\d+$", "", label).replace("loss=photometric + ", "")
    words = []
    for part in re.split(r", (?![^(]*\))", plain):
        found = re.fullmatch(r"([\w-]+)(?:\((.*)\)|=(.*)| (.*))?", part)
        if found is None or found[1] not in _NAMES:
            words.append(part)
            continue
        numbers = found[2] or found[3] or found[4] or ""
        only = re.match(r"[\d.]+(?=$|, 10_000$)", numbers)
        words.append(f"{_NAMES[found[1]]} {only[0] if only else ''}".strip())
    return ", ".join(words)


def color(label: str, number: int) -> str:
    """Return the color of the strategy that a label such as "dropout/seed_0" names, else the ``number``-th of `COLORS`.

    Example:
        >>> color("dropout/seed_0", 0) == color("dropout", 3) != color("my run", 0)
        True
    """
    name = re.split(r"[/ ,(]", label)[0]
    return STRATEGIES.get(name) or COLORS[number % len(COLORS)]


def in_thousandths(axis: Axis, name: str) -> None:
    """Label an axis with a name and the unit 10⁻³, and its ticks with multiples of that."""
    axis.set_label_text(f"{name} (10⁻³)")
    axis.set_major_formatter(lambda x, position: f"{x * 1e3:g}")


@contextmanager
def new_figure(path: Path) -> Iterator[Figure]:
    """Yield an empty figure in this style; on exit it is saved in the format of ``path``'s extension, PNG or SVG.

    Raises ImportError if matplotlib is missing; it comes with ``ca_reg[plot]``.
    """
    import matplotlib
    from cycler import cycler
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE | {"axes.prop_cycle": cycler(color=[*STRATEGIES.values(), *COLORS])}):
        figure = Figure(layout="constrained")
        yield figure
        with replacing(path) as place:
            figure.savefig(place, dpi=125, format=path.suffix[1:])
