"""Log co-adaptation during training, read the log back, and plot the training dynamics."""

from __future__ import annotations

import json
import logging
import math
import os
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import partial
from itertools import count, cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ca_reg._check import check_callable, check_count, check_opacity
from ca_reg.functional import scale_opacity
from ca_reg.regularizer import Params
from ca_reg.result import new_axes, summarize
from ca_reg.score import CAScore
from ca_reg.sinks import Sinks, check_sinks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["LOG_NAME", "CAMonitor", "plot_dynamics", "read_dynamics", "read_log"]

LOG_NAME = "ca.jsonl"
"""Name of the log inside the log directory."""

_log = logging.getLogger(__name__)


class CAMonitor(AbstractContextManager["CAMonitor"]):
    """Log co-adaptation and PSNR of groups of views at regular steps (the paper's training dynamics).

    Each measurement becomes one line of ``ca.jsonl``, on disk when the call returns: ``step``, ``gaussians``, the
    settings of the score, and for each group of views ``ca/<group>``, ``ca_std_error/<group>``, ``ca_reason/<group>``,
    ``ca_empty_views/<group>`` and ``psnr/<group>``; null is a missing value. Where tensorboard is installed, and in
    the ``sinks``, ``gaussians``, ``ca/<group>`` and ``psnr/<group>`` become scalars as well; an exact score at drop
    rate 1/2 stands there as ``exact CA (1e-3)/<group>``, times a thousand. :func:`plot_dynamics` plots the file.

    As long as the number of Gaussians stays the same, every measurement of a view uses the same masks: sampling noise
    does not disturb the comparison of steps.

    Args:
        score: how to measure. Its ``p`` is also the rate by which opacities are scaled for ``psnr``.
        log_dir: directory of the log and the TensorBoard events; made if it does not exist.
        views: non-empty groups of views by name, usually ``{"train": [...], "test": [...]}``, passed on as they are.
        every: number of steps between measurements, at least 1.
        last_step: the last step of the training, measured in any case.
        psnr: ``psnr(opacity, view)`` returns the PSNR in dB of the view rendered with these opacities, already scaled
            by ``1 - p`` for test time. Called without gradients. Views where it is not finite, such as one that a mask
            leaves no pixel of, do not count. None leaves PSNR out.
        details: ``details(opacity, view)`` returns, by name, what TensorBoard shows of the first view of each group
            besides the curves: images (3, H, W) in [0, 1], and numbers (N,) as histograms. Called without gradients.
        sinks: where the same goes besides TensorBoard, such as :class:`ca_reg.sinks.WandbSink`; closed at the end.
        resume_step: None for a new run, which replaces an existing log; else the step of the checkpoint, after which
            the lines of the log are dropped.

    Attributes:
        backends: ``("jsonl",)`` or ``("jsonl", "tensorboard")``, and the classes of the sinks.
        writer: of TensorBoard and all sinks, for curves of one's own; None where there is neither.

    Raises:
        TypeError: if ``views`` is not a mapping or an argument is of the wrong type.
        ValueError: if there are no views, a group is empty, a number is out of range, or a line of the log is damaged.
        OSError: if the log cannot be written, such as on a full disk; its earlier lines stay intact. A BlockingIOError
            if another monitor has the directory open.

    Example:
        >>> import tempfile
        >>> score = CAScore(lambda opacity, view: (view * opacity.mean(), torch.ones(4, 4)))
        >>> views = {"train": [torch.rand(3, 4, 4)], "test": [torch.rand(3, 4, 4)]}
        >>> with tempfile.TemporaryDirectory() as folder, CAMonitor(score, folder, views=views, every=100) as monitor:
        ...     for step in range(1, 201):
        ...         record = monitor(step, torch.full((50,), 0.5))
        >>> record["step"], sorted(record)[:4]
        (200, ['ca/test', 'ca/train', 'ca_empty_views/test', 'ca_empty_views/train'])
    """

    def __init__(
        self,
        score: CAScore,
        log_dir: str | os.PathLike[str],
        *,
        views: Mapping[str, Iterable[Any]],
        every: int = 500,
        last_step: int | None = None,
        psnr: Callable[[Tensor, Any], float] | None = None,
        details: Callable[[Tensor, Any], Mapping[str, Tensor]] | None = None,
        sinks: Sequence[Any] = (),
        resume_step: int | None = None,
    ) -> None:
        if not isinstance(score, CAScore):
            raise TypeError(f"score must be a CAScore, such as CAScore(render_fn), got {type(score).__name__}.")
        check_count(every, "every", minimum=1)
        for name, step in (("last_step", last_step), ("resume_step", resume_step)):
            if step is not None:
                check_count(step, name, minimum=0)
        for name, fn in (("psnr", psnr), ("details", details)):
            if fn is not None:
                check_callable(fn, name)
        check_sinks(sinks)
        if not isinstance(views, Mapping):
            raise TypeError(f"views must be a mapping from names to views, got {type(views).__name__}.")
        self.views = {name: list(group) for name, group in views.items()}
        if not self.views or not all(self.views.values()):
            raise ValueError(
                f"views must name at least one group and none may be empty, got "
                f"{ {name: len(group) for name, group in self.views.items()} }; leave out groups without views."
            )
        self.score = score
        self.every = every
        self.last_step = last_step
        self.psnr = psnr
        self.details = details

        folder = Path(log_dir)
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / LOG_NAME
        self._unlock = weakref.finalize(self, _lock(folder))
        try:
            self._logged = _keep_lines(self.path, resume_step)
            board = _summary_writer(folder, resume_step)
            self._file = self.path.open("ab", buffering=0)
        except BaseException:
            self._unlock()
            raise
        self.writer = Sinks([*board, *sinks]) if board or sinks else None
        self.backends = ("jsonl", *["tensorboard"] * len(board), *(type(sink).__name__ for sink in sinks))
        hint = "" if board else "; for TensorBoard: pip install 'ca_reg[tensorboard]'"
        _log.info("co-adaptation is logged to %s (%s)%s", self.path, ", ".join(self.backends), hint)

    def __call__(self, step: int, opacity: Tensor | Params) -> dict[str, float | int | str | None] | None:
        """Measure and log if the step is due: a multiple of ``every`` or the last, and later than those in the log.

        ``opacity`` is what the score is called with; the errors are those of the score, plus a ValueError if the step
        is negative or the monitor closed. Returns the logged record, or None if the step was not due.
        """
        check_count(step, "step", minimum=0)
        step = int(step)
        if (step % self.every and step != self.last_step) or step <= self._logged:
            return None
        if self._file.closed:
            raise ValueError("the monitor is closed; make a new one with resume_step to add to its log.")
        x = opacity if isinstance(opacity, Params) else Params(opacity)
        check_opacity(x.opacities)
        opacity = x.opacities.detach()
        record: dict[str, float | int | str | None] = {"step": step, "gaussians": opacity.shape[0]}
        position = count()
        for name, group in self.views.items():
            summary = summarize(self.score(x, view, index=next(position)) for view in group).as_dict()
            record[f"ca/{name}"] = summary["value"]
            record |= {f"ca_{key}/{name}": summary[key] for key in ("std_error", "reason", "empty_views")}
            if self.psnr is not None:
                record[f"psnr/{name}"] = self._mean_psnr(self.psnr, opacity, group)
        record.update(asdict(self.score.settings))
        self._write(record)
        self._show(opacity, step)
        return record

    def close(self) -> None:
        """Close the files and sinks. A second call does nothing."""
        if self._file.closed:
            return
        self._file.close()
        self._unlock()
        if self.writer is not None:
            self.writer.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    @torch.no_grad()
    def _mean_psnr(self, psnr: Callable[[Tensor, Any], float], opacity: Tensor, group: list[Any]) -> float | None:
        """Average the PSNR over the views where it is finite, with the test-time opacities; None if it is nowhere."""
        scaled = scale_opacity(opacity, self.score.p)
        found = [x for view in group if math.isfinite(x := float(psnr(scaled.clone(), view)))]  # it may edit its copy
        return sum(found) / len(found) if found else None

    @torch.no_grad()
    def _show(self, opacity: Tensor, step: int) -> None:
        """Write the details of the first view of each group, if they are asked for."""
        if self.details is None or self.writer is None:
            return
        for group, views in self.views.items():
            for name, x in self.details(opacity.clone(), views[0]).items():
                if x.numel():  # such as no share above 0
                    add = self.writer.add_histogram if x.ndim == 1 else self.writer.add_image
                    add(f"{name}/{group}", x, step)
        self.writer.flush()

    def _write(self, record: dict[str, Any]) -> None:
        """Append one line, and the scalars to TensorBoard."""
        self._append(json.dumps(record, allow_nan=False).encode() + b"\n")
        self._logged = int(record["step"])  # before the sinks: if one fails, the step is not logged again
        if self.writer is None:
            return
        half = record.get("method") == "exact" and record.get("drop_rate") == 0.5
        for key, x in record.items():
            if not (key.startswith(("ca/", "psnr/", "gaussians")) and isinstance(x, int | float)):
                continue
            if half and key.startswith("ca/"):  # the score for people: its name and its unit are the same everywhere
                key, x = f"exact CA (1e-3)/{key[3:]}", x * 1e3
            self.writer.add_scalar(key, x, record["step"])
        self.writer.flush()

    def _append(self, line: bytes) -> None:
        """Append a whole line to the log and sync it to disk, or leave the log as it was."""
        end, rest = self.path.stat().st_size, line
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            self._file.truncate(end)
            reason = f"{error.strerror} (the last measurement is not logged)"
            raise OSError(error.errno, reason, str(self.path)) from error


def _lock(folder: Path) -> Callable[[], Any]:
    """Lock a directory for one monitor and return what unlocks it; the system unlocks it when the process ends."""
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):  # Windows has no such locks
        return lambda: None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        reason = "another CAMonitor logs to this directory; close it, or give each its own log_dir"
        raise BlockingIOError(error.errno, reason, str(folder)) from error
    except OSError:  # such as a network file system without locks
        os.close(handle)
        return lambda: None
    return partial(_unlock, handle)


def _unlock(handle: int) -> None:
    import fcntl

    fcntl.flock(handle, fcntl.LOCK_UN)  # also for forked processes that hold the same handle
    os.close(handle)


def _keep_lines(path: Path, resume_step: int | None) -> int:
    """Drop the lines after ``resume_step``, all if it is None; return the last step that is kept, -1 if none is."""
    read = () if resume_step is None or not path.exists() else read_log(path)
    kept = [(line, record["step"]) for line, record in read if record["step"] <= resume_step]
    partial = path.with_suffix(".tmp")
    try:
        with partial.open("w", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line, _ in kept)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)  # atomic: the log never vanishes from disk
    finally:
        partial.unlink(missing_ok=True)
    return max((step for _, step in kept), default=-1)


def _summary_writer(folder: Path, resume_step: int | None) -> list[Any]:
    """Return a TensorBoard writer, none where tensorboard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return []
    # Hides what the earlier run wrote beyond the checkpoint; for a new run, all of it.
    return [SummaryWriter(str(folder), purge_step=0 if resume_step is None else resume_step + 1)]


def read_log(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Iterate over the measurements of a log, each with its raw line.

    An unterminated last line is skipped if it does not parse: a running or killed process has not finished it.

    Raises:
        ValueError: if another line is not a measurement; the message names file and line.
    """
    *whole, rest = path.read_bytes().split(b"\n")
    for number, line in enumerate([*whole, rest]):
        try:
            yield line.decode(), _measurement(line)
        except ValueError as error:
            if number < len(whole):
                raise ValueError(
                    f"{path}, line {number + 1}, is no measurement of a CAMonitor: {error}; remove that line to go on."
                ) from error


def _measurement(line: bytes) -> dict[str, Any]:
    """Parse a line: numbers, strings or null by name, including an integer ``step``."""
    try:
        record = json.loads(line.decode())
    except RecursionError as error:
        raise ValueError(str(error)) from error
    if not isinstance(record, dict) or not isinstance(record.get("step"), int):
        raise ValueError("expected an object with a whole number 'step'")
    for name, x in record.items():
        # 1023 bits are a float, which these become; a seed may well have the 128 of secrets.randbits.
        if not isinstance(x, int | float | str | None) or (isinstance(x, int) and x.bit_length() > 1023):
            raise ValueError(f"{name!r} must be a number, text or null")
    return record


def read_dynamics(path: str | os.PathLike[str]) -> dict[str, npt.NDArray[np.float64]]:
    """Read the log of a :class:`ca_reg.CAMonitor`.

    Takes the log, or the directory that holds it. Returns every numeric column by name (``step``, ``gaussians``,
    ``ca/test``, ``psnr/test``, ...), shape (lines,) each, sorted by step; nan where a line has no value.

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
    runs: str | os.PathLike[str] | Mapping[str, str | os.PathLike[str]],
    *,
    axes: Sequence[Axes] | None = None,
    colors: Mapping[str, str] | None = None,
) -> tuple[Axes, Axes]:
    """Plot co-adaptation and PSNR against the step, each on its own axes.

    ``runs`` is one log or log directory, or several by label. Each run has one color, by default the next of
    matplotlib's, else that of its label in ``colors``; its last group of views (test) is solid. Plots on two ``axes``,
    by default in a new figure, and returns them: co-adaptation, PSNR.

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
        color = (colors or {}).get(label, f"C{number}")
        groups = [key.removeprefix("ca/") for key in column if key.startswith("ca/")]
        lines = [*islice(cycle(("-", ":", "--", "-.")), len(groups))][::-1]
        for group, line in zip(groups, lines, strict=True):
            style: dict[str, Any] = {"color": color, "linestyle": line, "marker": ".", "markersize": 4}
            ca_axes.plot(column["step"], column[f"ca/{group}"], label=f"{label} {group}".strip(), **style)
            if f"psnr/{group}" in column:
                psnr_axes.plot(column["step"], column[f"psnr/{group}"], **style)
    for axis, quantity in ((ca_axes, "co-adaptation score CA"), (psnr_axes, "PSNR in dB")):
        axis.set_xlabel("iteration")
        axis.set_ylabel(quantity)
    ca_axes.set_ylim(bottom=0.0)
    psnr_axes.legend(handles=[*ca_axes.lines], loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return ca_axes, psnr_axes
