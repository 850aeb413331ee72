"""Writing files whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["replacing"]


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a place to write to; on success it becomes ``path`` in one move, on failure nothing has changed.

    Missing folders are made. The content is on disk before the move: a power cut leaves the old file or the new.

    Args:
        path: the file to create or replace.

    Yields:
        A path in the same folder to write the content to.

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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
