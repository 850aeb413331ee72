"""A lock that admits one process at a time to the folder of a run."""

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

    Args:
        folder: of the run.

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
        reference_trainer.runs.lock.FolderInUseError: ...: another process is at work there (process ...
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
