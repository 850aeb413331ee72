"""The folder of a run: the names of its files, the settings that claim it, and the lock for one process at a time.

Imports no torch: the command line checks folders with it before it loads anything that takes seconds.
"""

from __future__ import annotations

import ast
import dataclasses
import errno
import os
import re
import socket
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from reference_trainer.files import has_mark
from reference_trainer.json_files import read_json, settings_from
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = [
    "BAKED_PLY", "CHECKPOINT", "COMPARISON", "CONFIG", "GUARD", "GUARD_PICTURE", "LOCK", "MEMBERS", "PLAN", "PLY",
    "RESULTS", "SCENE", "VIEWS", "FolderInUseError", "check_output", "check_run", "check_trusted", "check_writable",
    "folder_name", "is_own_plan", "modules_named", "read_results", "read_run_settings", "report_file", "run_lock",
    "run_settings", "runs_of", "settings_of_run",
]  # fmt: skip

CONFIG = "config.json"
PLAN = "plan.json"
LOG = "ca.jsonl"  # of a `CAMonitor`
CHECKPOINT = "checkpoint.pt"
PLY = "point_cloud.ply"
BAKED_PLY = "point_cloud_for_viewers.ply"
GUARD = "guard.json"  # what the guard removed while training
GUARD_PICTURE = "guard.png"
VIEWS = "views"  # here and in the folder of an evaluation
RESULTS = "results.json"
COMPARISON = "comparison.json"  # of several runs
SCENE = "scene"  # where `ca-reg run` puts photographs that have no cameras, in a folder of their name
MEMBERS = "members"  # where it puts runs that it distills into one

_OWN_PAGE = b'<meta name="generator" content="ca-reg report">'  # near the beginning of report/page.html
_EXPRESSIONS = ("regularizer", "loss", "density", "renderer")  # settings that are read by a `Registry`


def folder_name(text: str) -> str:
    """Return a folder name for an expression, such as that of a regularizer.

    Example:
        >>> folder_name("dropout(0.1) + noise(0.4)"), folder_name("")
        ('dropout_0.1_noise_0.4', 'plain')
    """
    return re.sub(r"[^\w.=-]+", "_", text).strip("_") or "plain"


def run_settings(options: SceneOptions, config: TrainConfig) -> dict[str, Any]:
    """Return the content of ``config.json``, which claims a folder for one run."""
    return {"scene": dataclasses.asdict(options.absolute()), "config": dataclasses.asdict(config)}


def read_run_settings(path: str | Path) -> tuple[SceneOptions, TrainConfig]:
    """Return the scene and the training of a run from its ``config.json``.

    Settings that the file lacks, because an older version wrote it, take their defaults. A scene and models that
    `ca-reg run` has put into the folder of the run are found there, wherever that has been moved.

    Raises:
        ValueError: if the file is not a run's ``config.json``, or holds an unknown or invalid setting.
        OSError: if it cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "config.json").write_text('{"scene": {"views": 3}, "config": {"dropout": 0.2}}')
        ...     scene, config = read_run_settings(f"{folder}/config.json")
        >>> scene.path, scene.views, config.dropout
        ('synthetic', 3, 0.2)
    """
    content = read_json(path)
    if not isinstance(content, dict) or not {"scene", "config"} <= content.keys():
        raise ValueError(f"{path} is not the config.json of a run: it must hold the objects 'scene' and 'config'.")
    scene = settings_from(SceneOptions, content["scene"], f"{path}, scene")
    config = settings_from(TrainConfig, content["config"], f"{path}, config")
    place, here = Path(scene.path), Path(path).parent
    run = here.parents[1] if here.parent.name == MEMBERS else here
    if place.parent.name == SCENE and (own := run / SCENE / place.name).is_dir():
        scene = dataclasses.replace(scene, path=str(own))
    if scene.init and Path(scene.init).parts[-3:-2] == (MEMBERS,) and (here / MEMBERS).is_dir():
        before, now = (folder.as_posix() for folder in (Path(scene.init).parents[2], here.resolve()))
        scene = dataclasses.replace(scene, init=scene.init.replace(before, now))
        # Quoted anew: a name with one quotation mark needs the other around it.
        quoted = r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\""""
        moved = re.sub(quoted, lambda at: repr(ast.literal_eval(at[0]).replace(before, now)), config.loss)
        config = dataclasses.replace(config, loss=moved)
    return scene, config


def settings_of_run(
    out: Path, options: SceneOptions, config: TrainConfig, *, auto: bool, given: Collection[str]
) -> TrainConfig | None:
    """Return the settings that the run in a folder began with, None if none has begun.

    ``options`` and ``config`` are what is asked for; with ``auto`` the plan that the run began with, if any, is applied
    to ``config``, but not to the settings that are ``given``.

    Raises:
        ValueError: if the folder holds a run with other settings, a checkpoint without settings, or a damaged file;
            or no run, but files that a run would overwrite, a comparison, or the photographs.
    """
    trained = (out / CHECKPOINT).exists()  # looked for first: another process writes it last
    if not (out / CONFIG).exists():
        if trained:
            raise ValueError(f"{out} holds a {CHECKPOINT} but no {CONFIG}: give another folder, or delete this one.")
        # A run writes its plan first.
        plan = () if is_own_plan(out / PLAN) else (PLAN,)
        check_output(out, options.path, (*plan, LOG, PLY, BAKED_PLY, RESULTS, GUARD, GUARD_PICTURE, VIEWS, COMPARISON))
        return None
    if auto and (out / PLAN).exists():
        from reference_trainer.training.plan import Plan  # needs torch

        try:
            config = Plan.from_dict(read_json(out / PLAN)).applied(config, given=given)
        except (ValueError, TypeError, AttributeError) as error:  # whatever a damaged file, or another version's, holds
            raise ValueError(f"{out / PLAN}: {error}") from error
    found = run_settings(*read_run_settings(out / CONFIG))
    changed = [
        f"{key}: {found[part][key]} -> {value}"
        for part, values in run_settings(options, config).items()
        for key, value in values.items()
        if found[part][key] != value
    ]
    if changed:
        raise ValueError(
            f"{out} holds a run with other settings ({'; '.join(changed)}): give another folder, or delete this one."
        )
    return config


def check_output(folder: Path, scene: str | Path | None, files: Collection[str]) -> None:
    """Refuse to write into a folder of somebody else's, with a ValueError.

    That is the scene, the folder of the photographs, or one that holds ``files``, names of what would be overwritten
    although nothing says that this program wrote it. Raises a PermissionError if nothing can be written there.
    """
    check_writable(folder)
    place = None if scene in (None, "synthetic") else Path(str(scene)).resolve()
    pictures = re.fullmatch(r"images?(_\d+)?", folder.name) and folder.resolve().parent == place
    if place is not None and folder.exists() and (folder.resolve() == place or pictures):
        raise ValueError(f"{folder} is the folder of the scene, to which nothing is written: give another --out.")
    if existing := [name for name in files if (folder / name).exists()]:
        raise ValueError(
            f"{folder} holds {', '.join(existing)}, but nothing says that this command wrote it: give another --out."
        )


def is_own_plan(file: Path) -> bool:
    """Whether a file is a plan of this program."""
    return has_mark(file, b'"items"')


def check_writable(folder: Path) -> None:
    """Refuse a folder that cannot be written to, or made, with a PermissionError, before anything is computed."""
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise PermissionError(f"{folder} cannot be written to, because of {place}: give another --out.")


def check_run(folder: Path) -> None:
    """Refuse a folder that holds no run, saying what it holds instead.

    Raises:
        FileNotFoundError: if it has no ``config.json``.
    """
    if (folder / CONFIG).is_file():
        return
    found = f"{folder} holds no run (no {CONFIG}): give the --out folder of ca-reg train"
    if not folder.exists():
        found = f"{folder} holds no run: there is no such folder; give the --out folder of ca-reg train"
    elif folder.suffix.lower() == ".ply":
        found = f"{folder} is a PLY, which knows no cameras: give the --out folder of ca-reg train"
    elif folder.is_file():
        found = f"{folder} is neither a run nor a PLY: give the --out folder of ca-reg train, or a standard 3DGS .ply"
        if folder.suffix.lower() in (".pt", ".pth", ".ckpt"):
            found += ", which the program that wrote this checkpoint can export"
    elif inside := [path for path in runs_of(folder) if path != folder]:
        found = f"{folder} holds no run itself, but {len(inside)} below it: give one, such as {inside[0]}"
    elif scenes := sorted(path.parent for path in folder.glob(f"*/{COMPARISON}")):
        found = f"{folder} holds the comparisons of {len(scenes)} scenes: give that of one, such as {scenes[0]}"
    raise FileNotFoundError(f"{found}.")


def runs_of(folder: Path) -> list[Path]:
    """Return the runs of a folder: itself, or of a comparison the first seed of every strategy, in its order."""
    if (folder / CONFIG).is_file():
        return [folder]
    order: list[str] = []
    with suppress(OSError, ValueError, AttributeError, TypeError):
        order = [*read_json(folder / COMPARISON)["runs"]]
    seeds = [path.parent for path in folder.glob(f"*/seed_*/{CONFIG}") if path.parent.name[5:].isdecimal()]
    first: dict[str, Path] = {}
    for run in sorted(seeds, key=lambda run: int(run.name[5:])):
        first.setdefault(run.parent.name, run)
    return [first[name] for name in sorted(first, key=lambda name: (name not in order, [*order, name].index(name)))]


def report_file(runs: Sequence[Path], out: Path | None = None) -> Path:
    """Return the file of a report: ``out``, or ``report.html`` in the run, or in the deepest folder common to all.

    Raises:
        ValueError: if it is a folder, or a file that is no report of this program.
        PermissionError: if nothing can be written there.
    """
    if out is not None and out.is_dir():
        raise ValueError(f"{out} is a folder: --out is the file to write, such as {out / 'report.html'}.")
    file = out or Path(os.path.commonpath([run.absolute() for run in runs])) / "report.html"
    check_writable(file.parent)
    if file.exists() and not has_mark(file, _OWN_PAGE, within=1_000):
        raise ValueError(f"{file} is no report of ca-reg and is not overwritten: give another --out.")
    return file


def modules_named(settings: Any) -> set[str]:
    """Return the modules that settings, or an expression, name as module:Class: using them would import these.

    Example:
        >>> sorted(modules_named(TrainConfig(regularizer="dropout(0.1) + mine.drops:Mine(0.2)")))
        ['mine.drops']
    """
    from ca_reg.registry import modules  # loads torch

    if isinstance(settings, str):
        return modules(settings)
    reader, colon, _ = getattr(settings, "format", "").partition(":")
    return set[str]([reader] * bool(colon)).union(*(modules(getattr(settings, name, "")) for name in _EXPRESSIONS))


def check_trusted(where: Path, settings: Any, trust: Collection[str]) -> None:
    """Refuse settings read from a file that would import a module which nobody has named on the command line.

    Raises:
        ValueError: with the module, and how to name it; also if an expression cannot be read.
    """
    try:
        unknown = sorted(modules_named(settings) - set(trust))
    except ValueError as error:
        raise ValueError(f"{where} says what it was trained with: {error}") from error
    if unknown:
        raise ValueError(
            f"{where} was trained with code of {', '.join(unknown)}, which is not imported because a file says so. If "
            f"it is yours, say --trust {' '.join(unknown)}."
        )


def read_results(out: Path) -> dict[str, Any]:
    """Read the results of a complete run; scores that an older version did not measure may be missing.

    Raises:
        ValueError: if the file is damaged.
        OSError: if it cannot be read.
    """
    results: dict[str, Any] = read_json(out / RESULTS)
    match results:
        case {
            "config": {"seed": int()},
            "gaussians": int() as count,
            "seconds": float(),
            "mean": {"train": _} as means,
            "views": [_, *_] as views,
        }:
            named = all(isinstance(view, dict) and {"name", "split"} <= view.keys() for view in views)
            if named and all(map(_is_row, (*means.values(), *views))) and count.bit_length() < 64:
                return results
    raise ValueError(f"{out / RESULTS} does not hold the results of a run: delete it to measure again.")


def _is_row(row: Any) -> bool:
    """Whether these are the scores of a view or their means: text where it belongs, else a number or None."""
    return isinstance(row, dict) and all(
        isinstance(x, str if name in ("name", "split", "ca_reason") else float | None) for name, x in row.items()
    )


LOCK = ".lock"
_HOLDER = ".lock.holder"  # a separate file, because on Windows a locked file cannot be read
_KNOWN_HOLDER = re.compile(r"process \d+ on [\w.-]+")
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK)


class FolderInUseError(RuntimeError):
    """Another process is at work in the folder of a run."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Lock a folder, made if missing, against other processes that ask for the same lock.

    The operating system releases the lock when the process ends, however it ends: there are no stale locks, although
    the empty file ``.lock`` stays. The lock is advisory: readers are not kept out. On a network file system that
    supports locks it holds across machines; on one that does not, a warning is issued and the folder used unlocked.

    Raises:
        FolderInUseError: at once, if the folder is locked; nothing in it was touched.
        OSError: if the lock file cannot be made.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, run_lock(Path(folder)):
        ...     with run_lock(Path(folder)):
        ...         pass
        Traceback (most recent call last):
        ...
        reference_trainer.runs.folder.FolderInUseError: ...: another process is at work there (process ...
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    # Without locks in the system, filelock would fall back to a marker file, which outlives a killed process.
    lock = FileLock(folder / LOCK, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise FolderInUseError(
            f"{folder}: another process is at work there ({_holder(folder)}). Nothing was changed: wait until it ends, "
            f"stop it (on Ctrl-C it saves a checkpoint), or give another folder."
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        warnings.warn(
            f"{folder} is on a file system without locks ({error.strerror}): take care that no other process works in "
            f"it, or two runs overwrite each other's files.",
            RuntimeWarning,
            stacklevel=3,  # past contextlib
        )
    try:
        if lock.is_locked:
            with suppress(OSError):  # no run must fail over a note
                (folder / _HOLDER).write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):
                (folder / _HOLDER).unlink()
            lock.release()


def _holder(folder: Path) -> str:
    """Return who holds the lock, as far as known."""
    with suppress(OSError, ValueError), (folder / _HOLDER).open(encoding="utf-8") as file:
        text = file.read(200)
        if _KNOWN_HOLDER.fullmatch(text):
            return text
    return "which one is not known"
