"""Scores as Markdown tables, for one evaluation, a run or a comparison. CA is in units of 1e-3."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from reference_trainer.evaluation.results import format_mean_std, markdown_table

__all__ = ["comparison_table", "evaluation_table", "summary"]

_TITLES = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "ca": "CA x1e-3",
    "ca_std_error": "CA std error x1e-3",
    "ca_exact": "exact CA x1e-3",
    "ca_exact_half": "exact CA at 1/2 x1e-3",
    "ca_neutral": "neutral CA x1e-3",
    "visible": "visible",
    "covered": "covered",
    "cv": "CV",
    "depth_abs_rel": "depth AbsRel",
    "depth_rmse": "depth RMSE",
    "depth_mae": "depth MAE",
    "depth_log10": "depth log10",
    "gaussians": "Gaussians",
}
_NOT_EVERYWHERE = ("psnr", "ssim", "lpips", "depth_abs_rel", "depth_rmse", "depth_mae", "depth_log10")


def evaluation_table(data: Mapping[str, Any]) -> str:
    """Return one row per view and the means of the splits, without quantities that no view has.

    The data are those of `Evaluation.as_dict`, or of a file that holds them, such as ``results.json``.
    """
    rows = {f"{view['split']} {view['name']}": view for view in data["views"]}
    rows |= {f"mean {split}": mean for split, mean in data["mean"].items()}
    left_out = {"ca_exact_half", "gaussians"} | {
        name
        for name in _NOT_EVERYWHERE
        if all(math.isnan(x) for row in rows.values() if (x := row.get(name)) is not None)
    }
    return _table("view", rows, [name for name in _TITLES if name not in left_out])


def summary(results: dict[str, Any]) -> str:
    """Return the means of ``results.json`` as a short table."""
    rows = {split: results | mean for split, mean in sorted(results["mean"].items())}
    return _table("views", rows, ["psnr", "ssim", "lpips", "ca", "ca_exact", "cv", "gaussians", "seconds"])


def comparison_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return one row per strategy with means and sample standard deviations over the seeds.

    CA follows the paper's protocol, whose drop rate depends on p; "exact CA at 1/2" is the limit of infinitely many
    samples at drop rate 1/2, whatever the model was trained with. Without test views, exact CA at, between and around
    the training views takes its place.

    Args:
        runs: for every strategy the content of ``results.json`` of each seed.
    """
    shown = {"test": ["psnr", "ssim", "lpips", "ca", "ca_exact_half", "cv", "depth_abs_rel"], "train": ["psnr", "ca"]}
    if not any("test" in run["mean"] for of in runs.values() for run in of):
        shown = {"train": ["psnr", "ca", "ca_exact"], "between": ["ca_exact"], "around": ["ca_exact"]}
    columns = {f"{split} {_TITLES[name]}": (split, name) for split, names in shown.items() for name in names}
    rows: list[dict[str, object]] = []
    for strategy, of in runs.items():
        row: dict[str, object] = {"strategy": strategy, "seeds": len(of)}
        for title, (split, name) in columns.items():
            values = [run["mean"].get(split, {}).get(name) for run in of]
            if known := [value for value in values if value is not None]:
                row[title] = format_mean_std(known, unit=_unit(name))
        row["Gaussians"] = format_mean_std([run["gaussians"] for run in of], unit=1e3) + "k"
        row["seconds"] = format_mean_std([run["seconds"] for run in of])
        rows.append(row)
    present = [title for title in columns if any(title in row for row in rows)]
    return markdown_table(rows, ["strategy", "seeds", *present, "Gaussians", "seconds"])


def _table(first: str, rows: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> str:
    """Return labeled rows of quantities in their units; None and nan become n/a."""
    cells: list[dict[str, object]] = []
    for label, row in rows.items():
        known = {_TITLES.get(name, name): row[name] / _unit(name) for name in names if row.get(name) is not None}
        cells.append({first: label} | known)
    return markdown_table(cells, [first, *(_TITLES.get(name, name) for name in names)])


def _unit(name: str) -> float:
    """Return the unit in which a quantity is shown."""
    return 1e-3 if name.startswith("ca") else 1.0
