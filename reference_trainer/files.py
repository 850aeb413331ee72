"""Writing files atomically, and telling what a file is by its name."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["has_mark", "is_ply", "remove_leftovers", "replacing", "write_text"]

_PART = ".part"


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path to write to; on success it replaces ``path`` atomically, on failure nothing changes.

    The temporary file lies in the same folder, which is created if missing. The content is synced before the move, and
    the move before this returns: a power cut leaves the old file or the new one, and no later write without this one.

    Raises:
        OSError: if the file cannot be written, as on a full disk, or is a folder; the error names ``path``.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with replacing(f"{folder}/new/note.txt") as place:
        ...         _ = place.write_text("all of it")
        ...     sorted(p.name for p in Path(folder, "new").iterdir())
        ['note.txt']
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "this is a folder: expected the name of a file to write", str(path))
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
    """Write text as UTF-8, atomically as `replacing` does.

    Bytes of a file name that are no text become escapes, in JSON its own: names of old archives are not all UTF-8.
    """
    with replacing(path) as place:
        place.write_text(text, encoding="utf-8", errors="backslashreplace")


def has_mark(file: Path, mark: bytes, within: int = -1) -> bool:
    """Whether this program wrote a file: whether it is there with ``mark`` in its first ``within`` bytes, or in all."""
    if not file.is_file():
        return False
    with file.open("rb") as content:
        return mark in content.read(within)


def remove_leftovers(folder: str | Path, *, below: bool = True) -> None:
    """Remove the temporary files that killed processes left in a folder; ``below`` includes all subfolders.

    No other process may be writing there.
    """
    for path in [*Path(folder).glob(f"{'**/' * below}.*{_PART}")]:
        if path.is_file():
            path.unlink(missing_ok=True)


def is_ply(path: Path) -> bool:
    """Whether a path names a PLY file; it need not exist."""
    return path.suffix.lower() == ".ply" and not path.is_dir()


def _sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)  # Windows syncs only what may be written
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
