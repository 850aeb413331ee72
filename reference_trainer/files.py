"""Writing files whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["remove_leftovers", "replacing", "write_text"]

_PART = ".part"


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a place to write to; on success it becomes ``path`` in one move, on failure nothing has changed.

    Missing folders are made; the place is in the same folder. The content is on disk before the move, and the move
    before this returns: a power cut leaves the old file or the new, and what is written later does not survive without
    what was written before.

    Raises:
        OSError: if it cannot be written, such as on a full disk; it names ``path``.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with replacing(f"{folder}/new/note.txt") as place:
        ...         _ = place.write_text("all of it")
        ...     sorted(p.name for p in Path(folder, "new").iterdir())
        ['note.txt']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{_PART}")
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        if os.name == "posix":  # elsewhere a folder cannot be opened
            _sync(path.parent)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        reason = f"{os.strerror(error.errno)} (not written; what was there before is kept)"
        raise OSError(error.errno, reason, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text in UTF-8 as `replacing` does."""
    with replacing(path) as place:
        place.write_text(text, encoding="utf-8")


def remove_leftovers(folder: str | Path, *, below: bool = True) -> int:
    """Remove what killed processes had begun to write in a folder, and return how many files that were.

    No other process may be writing there now. ``below`` also looks into all folders below it.
    """
    leftovers = [path for path in Path(folder).glob(f"{'**/' * below}.*{_PART}") if path.is_file()]
    for path in leftovers:
        path.unlink(missing_ok=True)
    return len(leftovers)


def _sync(path: Path) -> None:
    """Wait until a file or the entries of a folder are on the disk."""
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)  # Windows syncs only what may be written
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
