"""The operations by which this process changes files below a folder, and SIGKILL at one of them.

Between two operations nothing changes on disk, so a process that is killed before each of them, and in the middle of
each write, has left behind everything that a kill can leave.
"""

from __future__ import annotations

import builtins
import io
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["listed", "perform", "watch"]

_EVENTS = ("open", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.symlink", "os.truncate")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def perform(folder: Path, fatal: int | None, power: bool, action: Callable[..., object], *arguments: Any) -> None:
    """Do something while its operations are watched; if it comes to its end, they are listed in `listed`.

    Args:
        folder: as of `watch`.
        fatal: as of `watch`.
        power: as of `watch`.
        action: what to do.
        arguments: of the action.
    """
    operations = watch(folder, fatal=fatal, power=power)
    action(*arguments)
    listed(folder).write_text("\n".join(operations))


def listed(folder: Path) -> Path:
    """Where `perform` lists the operations, beside the folder."""
    return folder.with_suffix(".txt")


def watch(folder: Path, *, fatal: int | None = None, power: bool = False) -> list[str]:
    """From now on name the operations of this process in the list that is returned, each before it happens.

    Python announces all of them but writes, for which files are opened with a class of our own. It cannot be undone.

    Args:
        folder: what lies in it is watched, and itself.
        fatal: number of the operation, from 1 on, that does not happen because the process is killed; None for none.
        power: instead of a kill pretend a power cut: of what was not synced to the disk, only half is found there.
    """
    root, names = os.path.abspath(folder), list[str]()
    unsynced: dict[int, int] = {}  # size on disk by inode, of files that have grown since

    def inside(path: Any) -> bool:
        if isinstance(path, int):
            return False
        text = os.path.abspath(os.fsdecode(path))
        return text == root or text.startswith(root + os.sep)

    def happens(name: str, path: Any) -> None:
        names.append(f"{name} {os.path.relpath(os.fsdecode(path), root)}")
        if len(names) != fatal:
            return
        for each in Path(root).rglob("*") if power else ():
            if (found := each.stat()).st_ino in unsynced:
                os.truncate(each, (unsynced[found.st_ino] + found.st_size) // 2)
        os.kill(os.getpid(), signal.SIGKILL)

    def announced(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _EVENTS and inside(arguments[0]) and (event != "open" or arguments[2] & _WRITING):
            happens(event.removeprefix("os."), arguments[0])

    class File(io.FileIO):
        """A file without a buffer that writes in two halves."""

        def write(self, data: Any) -> int:
            content = memoryview(data).cast("B")
            found = os.fstat(self.fileno())
            unsynced.setdefault(found.st_ino, found.st_size)
            for half in (content[: len(content) // 2], content[len(content) // 2 :]):
                happens("write", self.name)
                while half:
                    half = half[super().write(half) :]
            return len(content)

        def truncate(self, size: int | None = None) -> int:
            happens("truncate", self.name)
            return super().truncate(size)

    def opened(
        file: Any, mode: str = "r", buffering: int = -1, encoding: str | None = None, errors: str | None = None,
        newline: str | None = None, closefd: bool = True, opener: Any = None,
    ) -> Any:  # fmt: skip
        if not set(mode) & set("wax+") or not inside(file):
            return plain_open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = File(file, mode.replace("b", "").replace("t", ""), closefd, opener)
        if buffering == 0:
            return raw
        buffered = (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)

    def synced(file: Any) -> None:
        plain_sync(file)
        unsynced.pop(os.fstat(file if isinstance(file, int) else file.fileno()).st_ino, None)

    plain_open, plain_sync = builtins.open, os.fsync
    builtins.open = io.open = Path.open = opened  # type: ignore[assignment]
    os.fsync = synced
    sys.addaudithook(announced)
    return names
