"""Run a script as `python script.py arguments...` would."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["run_script", "set_command_line"]


def set_command_line(script: Path, arguments: Sequence[str]) -> None:
    """Give the script its command line, and its folder as the first place to import from.

    Args:
        script: path of the file.
        arguments: what follows the name of the script on its command line.
    """
    sys.argv = [str(script), *arguments]
    # The first place is now the folder that `python -m` was called in; with -P (Python 3.11) there is no such place.
    if not getattr(sys.flags, "safe_path", False):
        sys.path[0] = str(script.resolve().parent)


def run_script(script: Path) -> None:
    """Run a script as the main program; whatever it raises is raised here, SystemExit and KeyboardInterrupt included.

    Args:
        script: path of the file.
    """
    runpy.run_path(str(script), run_name="__main__")
