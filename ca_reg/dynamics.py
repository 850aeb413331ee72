"""The training-dynamics figure of the paper: co-adaptation and PSNR against the step, from the logs of a monitor."""

from __future__ import annotations

import os
from collections.abc import Mapping
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
        in order of the steps; nan where a line has no value. Columns of text are left out.

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
    runs: str | os.PathLike[str] | Mapping[str, str | os.PathLike[str]], *, ax: Axes | None = None
) -> tuple[Axes, Axes]:
    """Draw co-adaptation (left axis, solid) and PSNR (right axis, dotted) against the step.

    One color per run and group of views; nan leaves a gap. The runs are one log or log directory, or several by label;
    they are drawn on ``ax``, by default in a new figure. Returns the axes of co-adaptation and those of PSNR.

    Raises:
        ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
        FileNotFoundError: if a log is missing.
        ValueError: if there is no run, or a log is empty.
    """
    labelled = runs if isinstance(runs, Mapping) else {"": runs}
    if not labelled:
        raise ValueError("runs must hold at least one log, got an empty mapping.")
    columns = {label: read_dynamics(path) for label, path in labelled.items()}
    ca_axes = new_axes() if ax is None else ax
    psnr_axes = ca_axes.twinx()
    color = 0
    for label, column in columns.items():
        for group in (key.removeprefix("ca/") for key in column if key.startswith("ca/")):
            name = f"{label} {group}".strip()
            style: dict[str, Any] = {"color": f"C{color}", "marker": ".", "markersize": 4}
            ca_axes.plot(column["step"], column[f"ca/{group}"], label=name, **style)
            if f"psnr/{group}" in column:
                psnr_axes.plot(column["step"], column[f"psnr/{group}"], linestyle=":", **style)
            color += 1
    ca_axes.set_xlabel("iteration")
    ca_axes.set_ylabel("co-adaptation score CA (solid)")
    psnr_axes.set_ylabel("PSNR in dB (dotted)")
    ca_axes.set_ylim(bottom=0.0)
    # Above the axes: inside, the curves of the other axis would run through it.
    ca_axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    return ca_axes, psnr_axes
