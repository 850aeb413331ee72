"""`Study`, a declaration of what to measure and show, and `run_study`, which runs it."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import torch

from reference_trainer.evaluation.results import ResultStore, fingerprint, machine, write_json
from reference_trainer.evaluation.style import new_figure
from reference_trainer.files import write_text
from reference_trainer.runs.executors import Executor, Failure, Task, run_all
from reference_trainer.runs.folder import CHECKPOINT, run_lock

if TYPE_CHECKING:  # an extra
    from matplotlib.figure import Figure

__all__ = ["Clock", "Record", "Records", "Study", "checkpoints", "in_turns", "now", "run_study"]

_log = logging.getLogger(__name__)

Clock = Callable[[], float]
"""Returns seconds."""
Record = dict[str, Any]
"""The measurement of one case: strings, numbers including nan and infinity, None, lists and dictionaries."""
Records = Mapping[str, Record]
"""Records by name of the case, in the order of declaration."""


@dataclass(frozen=True)
class Study:
    """What to measure and what to show.

    Args:
        name: of its files, ``NAME.json``, ``NAME.md`` and ``NAME.png``.
        measure: measures one case, given its settings as keyword arguments. A module-level function, so that a worker
            in another process can import it.
        cases: the settings by name of the case: strings, numbers, None, paths of existing files, which count with size
            and modification time, and lists and dataclasses of these. A place to write to is a string.
        report: returns the tables of all records in Markdown.
        plot: plots all records in an empty figure; None for no figure.
        check: whether the study checks the program itself: once it is finished, the next call measures all again.
    """

    name: str
    measure: Callable[..., Record]
    cases: Mapping[str, Mapping[str, Any]]
    report: Callable[[Records], str]
    plot: Callable[[Records, Figure], None] | None = None
    check: bool = False


def run_study(study: Study, out: Path, *, executor: Executor | None = None) -> Records:
    """Measure the cases not measured yet; write all records, the tables and the figure, and log the tables.

    Every record is on disk, in ``NAME.records.json``, as soon as its case is measured. Later calls reuse it as long as
    the settings, the files among them and the result of `machine` are the same; other cases may come and go.

    They go into the folder ``out``. An ``executor`` measures several cases at a time; without one this process measures
    one after the other.

    Raises:
        ValueError: if there is no case, or what ``study.measure`` raises.
        FolderInUseError: if another process is at work in the folder; nothing there was touched.
        RuntimeError: after the others are written, if cases failed on the executor; the same call tries them again.
    """
    if not study.cases:
        raise ValueError(f"expected at least 1 case of {study.name}, got none.")
    with run_lock(out):
        here, file = machine(), out / f"{study.name}.records.json"
        kept = ResultStore(file, study.name)
        keys = {name: f"{name} {fingerprint([here, _decisive(dict(case))])}" for name, case in study.cases.items()}
        missing = [name for name, key in keys.items() if kept.get(key) is None]
        failed = {}
        for name, outcome in _measured(study, missing, executor):
            if isinstance(outcome, Failure):
                failed[name] = outcome.error
            else:
                kept.add(keys[name], json.loads(json.dumps(outcome)))  # as it will be when read back
        records = {name: record for name, key in keys.items() if (record := kept.get(key)) is not None}
        data = {"study": study.name, "machine": here, "cases": records, "failed": failed}
        write_json(out / f"{study.name}.json", data)
        if records:
            text = study.report(records)
            write_text(out / f"{study.name}.md", text)
            _log.info("%s", text)
            if study.plot is not None:
                with new_figure(out / f"{study.name}.png") as figure:
                    study.plot(records, figure)
            _log.info("numbers, tables and figures: %s.* in %s", study.name, out)
        if failed:
            why = "".join(f"\n  {name}: {error}" for name, error in failed.items())
            raise RuntimeError(f"{len(failed)} of {len(keys)} cases FAILED; the same command tries them again:{why}")
        if study.check:
            file.unlink(missing_ok=True)
        return records


def checkpoints(runs: Sequence[Path]) -> dict[str, Path]:
    """Return the checkpoints of runs, named by the last three parts of their paths, or more if needed for uniqueness.

    Raises:
        ValueError: if there is no run.
        FileNotFoundError: if a folder holds no run.
    """
    if not runs:
        raise ValueError("expected at least 1 run, got none: give the --out folders of ca-reg train.")
    folders, parts = list(dict.fromkeys(run.resolve() for run in runs)), 3
    for folder in folders:
        if not (folder / CHECKPOINT).exists():
            raise FileNotFoundError(f"{folder} holds no run (no {CHECKPOINT}): give the --out folder of ca-reg train.")
    while len({folder.parts[-parts:] for folder in folders}) < len(folders):
        parts += 1
    return {"/".join(folder.parts[-parts:]): folder / CHECKPOINT for folder in folders}


def _measured(study: Study, names: Sequence[str], executor: Executor | None) -> Iterator[tuple[str, Record | Failure]]:
    """Measure cases; yield each when it is finished. Without an executor an error ends the study."""
    calls = {name: partial(study.measure, **study.cases[name]) for name in names}
    if executor is None:
        for number, (name, call) in enumerate(calls.items(), start=1):
            _log.info("[%d/%d] %s", number, len(names), name)
            yield name, call()
        return
    tasks = [Task(name, call, ()) for name, call in calls.items()]
    for number, (index, outcome) in enumerate(run_all(executor, tasks), start=1):
        failed = isinstance(outcome, Failure)
        _log.info("[%d/%d] %s%s", number, len(names), names[index], ": FAILED" * failed)
        yield names[index], outcome if isinstance(outcome, Failure) else outcome.value


def _decisive(settings: Any) -> Any:
    """Return settings for `fingerprint`, with the size and modification time of files."""
    if isinstance(settings, Path):
        state = settings.stat()
        # Not the content: checkpoints are large, and a training that goes on changes both.
        return [str(settings.resolve()), state.st_size, state.st_mtime_ns]
    if isinstance(settings, dict):
        return {name: _decisive(value) for name, value in settings.items()}
    return [_decisive(value) for value in settings] if isinstance(settings, list | tuple) else settings


def in_turns(calls: Mapping[str, Callable[[], object]], repeats: int, clock: Clock) -> dict[str, list[float]]:
    """Time several calls, by name, in turns, so that a change in the machine's load affects all of them alike.

    After one untimed round, returns the seconds of every one of the ``repeats`` rounds, by name. The clock is such as
    `now` of a device, or `time.process_time`.

    Example:
        >>> len(in_turns({"nothing": lambda: None}, 3, perf_counter)["nothing"])
        3
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():  # untimed: compilation, caches, the first touch of memory
        call()
    for _ in range(repeats):
        for name, call in calls.items():
            start = clock()
            call()
            seconds[name].append(clock() - start)
    return seconds


def now(device: torch.device) -> float:
    """Wait until all work queued on a device is done; return the wall-clock time in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return perf_counter()
