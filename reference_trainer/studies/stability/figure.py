"""The picture of the stability study: errors by case and quantity, and against the magnitude where something ends."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reference_trainer.files import replacing
from reference_trainer.studies.stability.quantities import SCENE_QUANTITIES
from reference_trainer.studies.stability.report import of_engine, worst_errors

__all__ = ["stability_figure"]

_GROUPS = {
    "image, alpha": ("image", "alpha"),
    "gradients": tuple(name for name in SCENE_QUANTITIES if name.startswith("d ") and name != "d variance"),
    "mean, variance, CA": ("mean", "variance", "d variance", "CA"),
    "dropout, noise": ("dropout", "noise"),
}
_FLOOR, _CEILING = 1e-9, 1.0


def stability_figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw the errors as a heat map for each engine, and as lines for the cases that have an onset.

    Args:
        report: what `study_stability` returns.
        path: the PNG to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cases = [case for case in report["cases"] if worst_errors(case)]
    sweeps = [case for case in cases if case["magnitudes"] and case["onset"] is not None]
    engines = report["engines"]
    rows = max(len(of_engine(cases, engine)) for engine in engines)
    figure: Any = Figure(figsize=(6.5 * len(engines) + 7, max(4.0, 0.2 * rows + 2)), layout="constrained")
    FigureCanvasAgg(figure)
    *left, right = figure.subfigures(1, len(engines) + 1)
    for part, engine in zip(left, engines, strict=True):
        _heat(part, engine, of_engine(cases, engine))
    if sweeps:
        panels = right.subplots(math.ceil(len(sweeps) / 2), 2, squeeze=False).flat
        for panel, case in zip(panels, sweeps, strict=False):
            _lines(panel, case)
        if len(sweeps) % 2:
            right.axes[-1].set_visible(False)
    with replacing(path) as place:
        figure.savefig(place, dpi=110, format="png")


def _heat(figure: Any, engine: str, cases: Sequence[Mapping[str, Any]]) -> None:
    """Draw the largest error of every quantity over the magnitudes at which all are right."""
    table = np.full((len(cases), len(SCENE_QUANTITIES)), math.nan)
    for i, case in enumerate(cases):
        for name, error in worst_errors(case).items():
            table[i, SCENE_QUANTITIES.index(name)] = math.log10(max(error, _FLOOR))
    axes = figure.subplots()
    axes.set_facecolor("0.9")
    picture = axes.imshow(table, cmap="viridis", vmin=math.log10(_FLOOR), vmax=-2, aspect="auto")
    axes.set_xticks(range(len(SCENE_QUANTITIES)), SCENE_QUANTITIES, rotation=60, ha="right", fontsize=7)
    axes.set_yticks(range(len(cases)), [_label(case) for case in cases], fontsize=6.5)
    for i in range(1, len(cases)):
        if cases[i]["family"] != cases[i - 1]["family"]:
            axes.axhline(i - 0.5, color="white", linewidth=2)
    axes.set_title(f"{engine}: largest error where all is right (grey: not part of the case)", fontsize=9)
    bar = figure.colorbar(picture, ax=axes, shrink=0.4, aspect=30)
    bar.set_label("log10 of the relative error", fontsize=7)


def _label(case: Mapping[str, Any]) -> str:
    """Return the name of a case, to where it was pushed, and from where on it ends."""
    if not case["magnitudes"]:
        return str(case["name"])
    end = f"; ends at {case['onset']:.2g}" if case["onset"] is not None else f" (to {case['magnitudes'][1]:.0e})"
    return f"{case['name']}{end}"


def _lines(panel: Any, case: Mapping[str, Any]) -> None:
    """Draw the errors of one case against the magnitude; a cross is an infinity, a grey area what is refused."""
    for color, (label, names) in enumerate(_GROUPS.items()):
        curve = {
            point["magnitude"]: max(point["errors"][name] for name in names if name in point["errors"])
            for point in case["points"]
            if any(name in point["errors"] for name in names)
        }
        finite = {x: min(max(y, _FLOOR), _CEILING) for x, y in curve.items() if math.isfinite(y)}
        if finite:
            panel.plot(finite.keys(), finite.values(), ".-", color=f"C{color}", label=label, linewidth=1, markersize=4)
        infinite = [x for x, y in curve.items() if not math.isfinite(y)]
        panel.plot(infinite, [_CEILING] * len(infinite), "x", color=f"C{color}", markersize=5)
    refused = [point["magnitude"] for point in case["points"] if point["status"] == "refused"]
    if refused:
        panel.axvspan(min(refused), max(refused), color="0.8")
    panel.axvline(case["onset"], color="red", linewidth=0.8)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_ylim(_FLOOR / 2, _CEILING * 3)
    panel.tick_params(labelsize=6)
    panel.set_title(f"{case['name']}, {case['engine'] or 'any engine'} ({case['ending']})", fontsize=7)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=5, loc="lower right")
