"""Run a script as `python script.py arguments...` would, or a module as `python -m module arguments...`."""

from __future__ import annotations

import os
import runpy
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["find_script", "run_script", "set_command_line"]


def find_script(name: Path) -> Path | None:
    """Return the file of a script, or of an installed command such as ``ns-train``; None if there is none."""
    if name.is_file():
        return name
    command = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    return None if command is None else Path(command)


def set_command_line(script: Path | str, arguments: Sequence[str]) -> None:
    """Set ``sys.argv``, and ``sys.path[0]`` to the folder of the script, or for a module to the working directory."""
    sys.argv = [str(script), *arguments]
    # `python -m` has put the working directory there; with -P (Python 3.11) there is no such entry.
    if not getattr(sys.flags, "safe_path", False):
        sys.path[0] = str(script.resolve().parent) if isinstance(script, Path) else os.getcwd()


def run_script(script: Path | str) -> None:
    """Run a script as the main program; its exceptions, SystemExit and KeyboardInterrupt included, pass through."""
    if isinstance(script, Path):
        runpy.run_path(str(script), run_name="__main__")
    else:
        runpy.run_module(script, run_name="__main__", alter_sys=True)
