"""Scores as tables: Markdown in files and pipes, fitted to the width of a terminal.

One co-adaptation score is for people: the exact one at drop rate 1/2, the same question for every model, called
"exact CA" and given in units of 1e-3. All other scores carry what they depend on in their titles.
"""

from __future__ import annotations

import math
import re
import shutil
import statistics
import sys
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, NamedTuple

__all__ = [
    "EXACT", "QUANTITIES", "comparison_table", "evaluation_table", "format_mean_std", "markdown_table", "mean_std",
    "print_table", "summary",
]  # fmt: skip

EXACT = "exact CA (1e-3)"
"""Title of the score for people: the exact score at drop rate 1/2, with two decimals."""

_ABSENT = "n/a"
_FIGURE = re.compile(r"[-+]?\d|-?$")  # also a dash or nothing in its place


class Quantity(NamedTuple):
    """How a quantity is shown."""

    title: str
    decimals: int  # the same down a column
    unit: float = 1.0
    highest_is_best: bool | None = None  # None where neither end is a merit

    def text(self, values: Iterable[float | None]) -> str:
        """Return mean and standard deviation, see `format_mean_std`; None is nan, which JSON does not have."""
        known = (math.nan if value is None else value for value in values)
        return format_mean_std(known, unit=self.unit, decimals=self.decimals)


QUANTITIES = {
    "psnr": Quantity("PSNR (dB)", 2, highest_is_best=True),
    "psnr_expected": Quantity("expected PSNR (dB)", 1),
    "psnr_low": Quantity("from", 1),
    "psnr_high": Quantity("to (80 %)", 1),
    "ssim": Quantity("SSIM", 3, highest_is_best=True),
    "lpips": Quantity("LPIPS", 3, highest_is_best=False),
    "ca_exact_half": Quantity(EXACT, 2, 1e-3, highest_is_best=False),
    "ca_exact": Quantity("exact CA{at} (1e-3)", 2, 1e-3),
    "ca_neutral": Quantity("neutral CA{at} (1e-3)", 2, 1e-3),
    "ca": Quantity("CA ({renders}) (1e-3)", 2, 1e-3),
    "ca_std_error": Quantity("its std error (1e-3)", 2, 1e-3),
    "visible": Quantity("visible", 3),
    "covered": Quantity("covered", 3),
    "cv": Quantity("CV", 4),
    "depth_abs_rel": Quantity("depth AbsRel", 4, highest_is_best=False),
    "depth_rmse": Quantity("depth RMSE", 4),
    "depth_mae": Quantity("depth MAE", 4),
    "depth_log10": Quantity("depth log10", 4),
    "gaussians": Quantity("Gaussians", 0),
    "seconds": Quantity("seconds", 0),
}
"""By name, in the order of the columns."""

_NOT_EVERYWHERE = re.compile("psnr|ssim|lpips|depth")
"""Beginnings of the quantities that need a photograph, a view that was not trained on, weights or a true depth."""


def evaluation_table(data: Mapping[str, Any]) -> str:
    """Return one row per view and the means of the splits, without quantities that no view has.

    The data are those of `Evaluation.as_dict`, or of a file that holds them, such as ``results.json``. Scores at
    another drop rate than 1/2 say so, if the data have ``ca_settings``.
    """
    rows = {f"{view['split']} {view['name']}": view for view in data["views"]}
    rows |= {f"mean {split}": mean for split, mean in data["mean"].items()}
    absent = {"gaussians", "seconds"}
    for name in filter(_NOT_EVERYWHERE.match, QUANTITIES):
        if all(math.isnan(x) for row in rows.values() if (x := row.get(name)) is not None):
            absent.add(name)
    settings = data.get("ca_settings") or {}
    if settings.get("drop_rate") == 0.5:
        absent.add("ca_exact")  # it is the score for people
    return _table("view", rows, [name for name in QUANTITIES if name not in absent], settings)


def summary(results: Mapping[str, Any]) -> str:
    """Return the means of ``results.json`` as a short table."""
    order = ["test", "train", "between", "around"]
    rows = {split: {**results, **mean} for split in order if (mean := results["mean"].get(split)) is not None}
    names = ["psnr", "ssim", "lpips", "ca_exact_half", "cv", "gaussians", "seconds"]
    if all(row.get("lpips") is None for row in rows.values()):
        names.remove("lpips")
    return _table("views", rows, names, {})


def comparison_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return one row per strategy with means and sample standard deviations over the seeds.

    Without test views, the exact CA at, between and around the training views takes the place of what is measured at
    test views. ``runs`` holds for every strategy the content of ``results.json`` of each seed.
    """
    shown = {
        "test": ["psnr", "ssim", "lpips", "ca_exact_half", "cv", "depth_abs_rel"],
        "train": ["psnr", "ca_exact_half"],
    }
    if not any("test" in run["mean"] for of in runs.values() for run in of):
        exact = ["ca_exact_half"]
        shown = {"train": ["psnr", *exact], "between": exact, "around": exact}
    columns = {f"{split} {QUANTITIES[name].title}": (split, name) for split, names in shown.items() for name in names}
    rows: list[dict[str, object]] = []
    for strategy, of in runs.items():
        row: dict[str, object] = {"strategy": strategy, "seeds": len(of)}
        for title, (split, name) in columns.items():
            row[title] = QUANTITIES[name].text(run["mean"].get(split, {}).get(name) for run in of)
        for name in ("gaussians", "seconds"):
            row[QUANTITIES[name].title] = QUANTITIES[name].text([run[name] for run in of])
        rows.append(row)
    present = [title for title in columns if any(row[title] != _ABSENT for row in rows)]
    return markdown_table(rows, ["strategy", "seeds", *present, "Gaussians", "seconds"])


def mean_std(values: Iterable[float]) -> tuple[float, float]:
    """Return mean and sample standard deviation (n - 1) of the finite values; nan if there are too few.

    Example:
        >>> mean_std([1.0, 3.0, math.nan])
        (2.0, 1.4142135623730951)
    """
    finite = [float(value) for value in values if math.isfinite(value)]
    mean = statistics.fmean(finite) if finite else math.nan
    return mean, statistics.stdev(finite) if len(finite) > 1 else math.nan


def format_mean_std(values: Iterable[float], *, unit: float = 1.0, decimals: int | None = None) -> str:
    """Return mean and standard deviation as text: two digits of the deviation, the mean to the same place.

    Values that are not finite are left out, and the text says how many remain; a mean without a deviation has four
    digits, and no value at all gives ``"n/a"``. Values are in units of ``unit``: with 1e-3, 0.0023 is written 2.3.
    With ``decimals`` both have that many, so that a column reads from top to bottom.

    Example:
        >>> format_mean_std([20.39, 20.51, 20.63])
        '20.51 ± 0.12'
        >>> format_mean_std([0.00221, 0.00231, 0.00241], unit=1e-3)
        '2.31 ± 0.10'
        >>> format_mean_std([20.39, 20.63, math.nan], decimals=1)
        '20.5 ± 0.2 (2 of 3)'
    """
    if not unit > 0:
        raise ValueError(f"unit must be positive, got {unit}.")
    scaled = [value / unit for value in values]
    mean, std = mean_std(scaled)
    count = sum(map(math.isfinite, scaled))
    note = f" ({count} of {len(scaled)})" if 0 < count < len(scaled) else ""
    if not count:
        return _ABSENT
    if decimals is None:
        if not std > 0:
            return f"{_number(mean)}{' ± 0' if std == 0 else ''}{note}"
        # Round first: a deviation of 0.0999 becomes 0.10, with one decimal less.
        decimals = max(0, 1 - math.floor(math.log10(float(f"{std:.1e}"))))
    spread = "" if math.isnan(std) else f" ± {std:.{decimals}f}"
    return f"{mean:.{decimals}f}{spread}{note}"


def markdown_table(rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> str:
    """Return rows, mappings from column to content, as a Markdown table that ends with a line break.

    Text is kept, floats get four digits; what is missing, None or not finite becomes ``n/a``. The columns, at least
    one, are also the headers. Columns of words are left-aligned, as is the first; columns of figures right-aligned.

    Example:
        >>> print(markdown_table([{"run": "baseline", "PSNR": 19.36}, {"run": "dropout"}], ["run", "PSNR"]), end="")
        | run | PSNR |
        |:---|---:|
        | baseline | 19.36 |
        | dropout | n/a |
    """
    if not columns:
        raise ValueError("a table needs at least one column.")
    lines = [[_cell(row.get(column)) for column in columns] for row in rows]
    words = {place for line in lines for place, cell in enumerate(line) if cell != _ABSENT and not _FIGURE.match(cell)}
    rule = [":---" if place in {0, *words} else "---:" for place in range(len(columns))]
    text = [f"| {' | '.join(line)} |" for line in [[_cell(column) for column in columns], *lines]]
    return "\n".join([text[0], f"|{'|'.join(rule)}|", *text[1:], ""])


def print_table(markdown: str) -> None:
    """Print a Markdown table; to a terminal as one that fits its width, with the best models and strategies in bold.

    A table that is too wide is turned around if that helps: many quantities of few strategies are read as rows.
    Else its columns go on below.
    """
    if not sys.stdout.isatty():
        print(markdown, flush=True)
        return
    width = shutil.get_terminal_size().columns
    head, rule, *rows = [
        [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in markdown.strip().splitlines()
    ]
    figures = [not cell.startswith(":") for cell in rule]
    bold = {(i + 1, j) for i, j in (_best(head, rows) if head[0] in ("strategy", "model") else ())}
    lines: list[Sequence[str]] = [head, *rows]
    turned: list[Sequence[str]] = list(zip(*lines, strict=True))
    if _room(map(_widest, turned)) > width >= _room(map(_widest, lines)) and all(figures[1:]):
        lines, figures, bold = turned, [False, *[True] * len(rows)], {(j, i) for i, j in bold}
    columns = [
        _Column(cells, of_figures, {i for i, k in bold if k == j}, whole=of_figures or (j == 0 and len(head) > 2))
        for j, (cells, of_figures) in enumerate(zip(zip(*lines, strict=True), figures, strict=True))
    ]
    while columns:
        # What is too wide even so goes on below, with the first column again.
        shown = columns
        while len(shown) > 2 and _room((column.least for column in shown), 1) > width:
            shown = shown[:-1]
        _print_columns(shown, width)
        rest = columns[len(shown) :]
        columns = [columns[0], *rest] if rest else []
        print("\n" * bool(rest), end="", flush=True)


@dataclass(frozen=True)
class _Column:
    """A column of a table in the terminal.

    Args:
        cells: its texts, the title first.
        figures: whether they are figures, which are aligned to the right.
        bold: positions of the cells in bold.
        whole: whether no cell but the title may be broken into lines.
    """

    cells: Sequence[str]
    figures: bool
    bold: Collection[int]
    whole: bool

    @property
    def least(self) -> int:
        """The least width, with lines broken between words where they may be."""
        title, *body = self.cells
        return _widest([*title.split(), *(body if self.whole else " ".join(body).split()), ""])


def _print_columns(columns: Sequence[_Column], width: int) -> None:
    """Print columns side by side, as wide as they need or as they may."""
    widths, least = [_widest(column.cells) for column in columns], [column.least for column in columns]
    gap = 2 if _room(least) <= width else 1
    while _room(widths, gap) > width and widths != least:
        widths[max(range(len(widths)), key=lambda j: (widths[j] > least[j], widths[j]))] -= 1
    for i in range(len(columns[0].cells)):
        parts = [textwrap.wrap(column.cells[i], w, break_long_words=False, break_on_hyphens=False)
                 for column, w in zip(columns, widths, strict=True)]  # fmt: skip
        for texts in zip_longest(*parts, fillvalue=""):
            line = []
            for text, column, w in zip(texts, columns, widths, strict=True):
                style = "2" if i == 0 else "1" if i in column.bold else ""
                styled, space = f"\x1b[{style}m{text}\x1b[0m" if style and text else text, " " * (w - len(text))
                line.append(space + styled if column.figures else styled + space)
            print((" " * gap).join(line).rstrip())


def _widest(cells: Iterable[str]) -> int:
    return max(map(len, cells))


def _room(widths: Iterable[int], gap: int = 2) -> int:
    """Return the width of a table with columns of these widths."""
    return sum(width + gap for width in widths) - gap


def _best(head: Sequence[str], rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """Return row and column of the best figure of every column at unseen views; all that share it."""
    found = set()
    for j, title in enumerate(head):
        highest = next((of.highest_is_best for of in QUANTITIES.values() if title.endswith(of.title)), None)
        if highest is None or title.startswith("train"):
            continue  # at training views the best fit is no merit
        figures = {i: float(row[j].split()[0]) for i, row in enumerate(rows) if row[j] != _ABSENT}
        best = (max if highest else min)(figures.values(), default=None)
        found |= {(i, j) for i, figure in figures.items() if figure == best}
    return found


def _table(first: str, rows: Mapping[str, Mapping[str, Any]], names: Sequence[str], settings: Mapping[str, Any]) -> str:
    """Return labeled rows of quantities in their units; None and nan become n/a."""
    rate = settings.get("drop_rate")
    drawn = "by its regularizer" if rate is None and settings else f"drop rate {rate:g}" if rate is not None else ""
    renders = ", ".join(filter(None, [f"{settings.get('samples') or 5} renders", drawn]))
    at = f" at {drawn}" if rate is not None else " at its own drop rate"
    titles = {name: QUANTITIES[name].title.format(at=at, renders=renders) for name in names}
    cells: list[dict[str, object]] = []
    for label, row in rows.items():
        cells.append({first: label})
        for name, title in titles.items():
            if (x := row.get(name)) is not None and math.isfinite(x):
                cells[-1][title] = f"{x / QUANTITIES[name].unit:.{QUANTITIES[name].decimals}f}"
    return markdown_table(cells, [first, *titles.values()])


def _cell(value: object) -> str:
    """Return one table cell; a bar or a line break inside would split it."""
    text = _number(value) if isinstance(value, float) else _ABSENT if value is None else str(value)
    return " ".join(text.split()).replace("|", "\\|")


def _number(value: float) -> str:
    """Return a number with four significant digits, but with all digits before the decimal point."""
    if not math.isfinite(value):
        return _ABSENT
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
