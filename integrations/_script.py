"""Run a script as `python script.py arguments...` would, or a module as `python -m module arguments...`."""

from __future__ import annotations

import ast
import os
import re
import runpy
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

__all__ = ["find_script", "imported_packages", "require", "run_script", "set_command_line"]


def find_script(name: Path) -> Path | None:
    """Return the file of a script, or of a command that an installed package brings, such as ``ns-train``."""
    if name.is_file():
        return name
    command = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    return None if command is None else Path(command)


def require(packages: Iterable[str], name: str) -> bool:
    """Return whether a package is among these, or one of these that is installed is built on it."""

    def requirements(package: str) -> list[str]:
        try:
            return requires(package) or []
        except PackageNotFoundError:
            return []

    return any(re.match(r"[\w-]+", each)[0] == name for p in packages for each in [p, *requirements(p)])  # type: ignore[index]


def imported_packages(script: Path | str) -> set[str]:
    """Return the first names of all modules that a script imports, itself or through files beside it; runs nothing.

    The script is the path of a file, or the name of a module in the present folder; so it is below.
    """
    folder = script.resolve().parent if isinstance(script, Path) else Path.cwd()
    files = [script if isinstance(script, Path) else folder / f"{script.replace('.', '/')}.py"]
    read: set[Path] = set()
    found = {script.partition(".")[0]} if isinstance(script, str) else set()
    while files:
        path = files.pop().resolve()
        if path in read or not path.is_file():
            continue
        read.add(path)
        for level, name in _imports(path):
            if level == 0:
                found.add(name.partition(".")[0])
            module = (path.parents[level - 1] if level else folder).joinpath(*name.split("."))
            files += [module.with_suffix(".py"), module / "__init__.py"]
    return found


def _imports(path: Path) -> Iterator[tuple[int, str]]:
    """Iterate over the modules that a file may import, each with the number of dots before its name."""
    try:
        nodes = list(ast.walk(ast.parse(path.read_bytes())))
    except SyntaxError:  # Python will say so when it runs it
        return
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = [node.module] if node.module else []
            yield from ((node.level, ".".join([*module, alias.name])) for alias in node.names)
            yield from ((node.level, name) for name in module)


def set_command_line(script: Path | str, arguments: Sequence[str]) -> None:
    """Give the script its command line, and its folder, or the present one, as the first place to import from."""
    sys.argv = [str(script), *arguments]
    # The first place is now the folder that `python -m` was called in; with -P (Python 3.11) there is no such place.
    if not getattr(sys.flags, "safe_path", False):
        sys.path[0] = str(script.resolve().parent) if isinstance(script, Path) else os.getcwd()


def run_script(script: Path | str) -> None:
    """Run a script as the main program; what it raises is raised here, SystemExit and KeyboardInterrupt, too."""
    if isinstance(script, Path):
        runpy.run_path(str(script), run_name="__main__")
    else:
        runpy.run_module(script, run_name="__main__", alter_sys=True)
