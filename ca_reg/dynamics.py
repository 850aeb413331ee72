"""The paper's training-dynamics figure: co-adaptation and PSNR against the step, from the logs of a monitor."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ca_reg._log import read_log
from ca_reg.monitor import LOG_NAME
from ca_reg.result import new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_dynamics", "read_dynamics"]


def read_dynamics(path: str | os.PathLike[str]) -> dict[str, npt.NDArray[np.float64]]:
    """Read the log of a :class:`ca_reg.CAMonitor`.

    Args:
        path: the log, or the directory that holds it.

    Returns:
        Every numeric column by name (``step``, ``gaussians``, ``ca/test``, ``psnr/test``, ...), shape (lines,) each,
        sorted by step; nan where a line has no value. Text columns are left out.

    Raises:
        FileNotFoundError: if there is no log.
        ValueError: if it holds no complete line, or a damaged one.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     lines = '{"step": 500, "ca/test": 0.01}', '{"step": 1000, "ca/test": null}'
        ...     _ = Path(folder, "ca.jsonl").write_text(chr(10).join(lines))
        ...     columns = read_dynamics(folder)
        >>> columns["step"], columns["ca/test"]
        (array([ 500., 1000.]), array([0.01,  nan]))
    """
    file = Path(path)
    file = file / LOG_NAME if file.is_dir() else file
    if not file.exists():
        raise FileNotFoundError(f"there is no log of a CAMonitor at {file}; give the file or the log_dir it was given.")
    records = [record for _, record in read_log(file)]
    if not records:
        raise ValueError(f"{file} holds no measurement yet; a CAMonitor writes the first at a multiple of `every`.")
    records.sort(key=lambda record: record["step"])
    texts = {key for record in records for key, x in record.items() if isinstance(x, str)}
    keys = dict.fromkeys(key for record in records for key in record if key not in texts)
    return {key: np.array([record.get(key) for record in records], dtype=np.float64) for key in keys}


def plot_dynamics(
    runs: str | os.PathLike[str] | Mapping[str, str | os.PathLike[str]], *, axes: Sequence[Axes] | None = None
) -> tuple[Axes, Axes]:
    """Plot co-adaptation and PSNR against the step, each on its own axes.

    ``runs`` is one log or log directory, or several by label. Each run has one color; its last group of views (test) is
    solid, the others are dotted or dashed; nan leaves a gap. Draws on two ``axes``, by default side by side in a new
    figure, and returns them: co-adaptation, PSNR.

    Raises:
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
        FileNotFoundError: if a log is missing.
        ValueError: if there is no run, or a log is empty.
    """
    labelled = runs if isinstance(runs, Mapping) else {"": runs}
    if not labelled:
        raise ValueError("runs must hold at least one log, got an empty mapping.")
    columns = {label: read_dynamics(path) for label, path in labelled.items()}
    ca_axes, psnr_axes = new_axes(2) if axes is None else axes
    for number, (label, column) in enumerate(columns.items()):
        groups = [key.removeprefix("ca/") for key in column if key.startswith("ca/")]
        lines = [*islice(cycle(("-", ":", "--", "-.")), len(groups))][::-1]
        for group, line in zip(groups, lines, strict=True):
            style: dict[str, Any] = {"color": f"C{number}", "linestyle": line, "marker": ".", "markersize": 4}
            ca_axes.plot(column["step"], column[f"ca/{group}"], label=f"{label} {group}".strip(), **style)
            if f"psnr/{group}" in column:
                psnr_axes.plot(column["step"], column[f"psnr/{group}"], **style)
    for drawn, quantity in ((ca_axes, "co-adaptation score CA"), (psnr_axes, "PSNR in dB")):
        drawn.set_xlabel("iteration")
        drawn.set_ylabel(quantity)
    ca_axes.set_ylim(bottom=0.0)
    psnr_axes.legend(handles=[*ca_axes.lines], loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return ca_axes, psnr_axes
