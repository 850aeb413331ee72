"""One process at a time in the folder of a run."""

from __future__ import annotations

import errno
import os
import re
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["LOCK", "FolderInUseError", "run_lock"]

LOCK = ".lock"
_HOLDER = ".lock.holder"  # beside the lock, because Windows lets nobody read a file that is locked
_KNOWN_HOLDER = re.compile(r"process \d+ on [\w.-]+")
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK)


class FolderInUseError(RuntimeError):
    """Another process is at work in the folder of a run."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Keep every other process that asks for the same lock out of a folder; the folder is made if it is missing.

    The lock belongs to the operating system, which releases it when the process ends, however it ends: there are no
    stale locks, although the empty file ``.lock`` stays. Whoever does not ask for the lock, such as a reader, is not
    kept out. On a network file system that supports locks it holds for all machines. On one that does not, the folder
    is used without, with a warning.

    Args:
        folder: of the run.

    Raises:
        FolderInUseError: if it is locked; nothing in the folder was touched. It does not wait.
        OSError: if the lock file cannot be made.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, run_lock(Path(folder)):
        ...     with run_lock(Path(folder)):
        ...         pass
        Traceback (most recent call last):
        ...
        reference_trainer.runs.lock.FolderInUseError: ...: another process is at work there (process ...
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    # Where the system has no locks, filelock would fall back to a marker file, which outlives a killed process.
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
            _note_holder(folder)
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):
                (folder / _HOLDER).unlink()
            lock.release()


def _note_holder(folder: Path) -> None:
    """Leave word who holds the lock; a courtesy, for which no run must fail."""
    with suppress(OSError):
        (folder / _HOLDER).write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")


def _holder(folder: Path) -> str:
    """Return who holds the lock as far as known."""
    with suppress(OSError, ValueError), (folder / _HOLDER).open(encoding="utf-8") as file:
        text = file.read(200)
        if _KNOWN_HOLDER.fullmatch(text):
            return text
    return "which one is not known"
