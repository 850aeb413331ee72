"""A script of a code base: how Python would run it, and what its sources import and define."""

from __future__ import annotations

import ast
import os
import re
import runpy
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

__all__ = ["Sources", "find_script", "read_folder", "read_script", "run_script", "set_command_line"]

_SUFFIXES = ("Rasterizer", "RasterizationSettings")
_NOT_READ = {"submodules", "build", "site-packages"}  # extensions and environments within a repository


@dataclass
class Sources:
    """What the files of a code base import and define.

    Args:
        imports: dotted names of all modules, and of what may be one, that are imported.
        rasterizers: names ``...Rasterizer`` and ``...RasterizationSettings`` imported from foreign modules, by module.
        models: classes with a method ``update_learning_rate(iteration)``, as ``module:Class``.
        root: the folder of the script, or its parent if files are imported from there.
    """

    imports: set[str] = field(default_factory=set)
    rasterizers: dict[str, set[str]] = field(default_factory=dict)
    models: list[str] = field(default_factory=list)
    root: Path = Path()

    @property
    def packages(self) -> set[str]:
        """Top-level names of all imported modules."""
        return {name.partition(".")[0] for name in self.imports}

    @property
    def classes(self) -> list[str]:
        """The rasterizers as ``module:Class``."""
        found = self.rasterizers.items()
        return [f"{module}:{name}" for module, names in found for name in sorted(names) if name.endswith(_SUFFIXES[0])]

    def need(self, name: str) -> bool:
        """Whether a package is imported, or one that requires it, as nerfstudio requires gsplat."""
        found = self.packages
        for package in self.packages:
            with suppress(PackageNotFoundError):
                found.update(re.split(r"[^\w-]", each)[0] for each in requires(package) or ())
        return name in found

    def is_own(self, module: str) -> bool:
        """Whether a module is a source file below the root, and not an extension to be compiled there."""
        return _is_own(self.root, module)

    def read(self, path: Path, folder: Path) -> list[tuple[int, str]]:
        """Read a file of the folder; return the modules it may import, each with its relative-import level."""
        try:
            nodes = list(ast.walk(ast.parse(path.read_bytes())))
        except SyntaxError:  # Python will report it at run time
            return []
        module = path.relative_to(folder).with_suffix("").parts if path.is_relative_to(folder) else ()
        modules = list(_imports(nodes))
        self.imports |= {_absolute(module, level, name) for level, name in modules} - {""}
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                names = {alias.name for alias in node.names if alias.name.endswith(_SUFFIXES)}
                origin = _absolute(module, node.level, node.module)
                if names and not _is_own(folder, origin):
                    self.rasterizers.setdefault(origin, set()).update(names)
            elif isinstance(node, ast.ClassDef) and module:
                methods = {part.name: part.args for part in node.body if isinstance(part, ast.FunctionDef)}
                arguments = methods.get("update_learning_rate")
                # Without an argument it may be a scheduler's, called for anything but a step of a model.
                if arguments is not None and len(arguments.posonlyargs + arguments.args) > 1:
                    self.models.append(f"{'.'.join(module).removesuffix('.__init__')}:{node.name}")
        return modules


def read_script(script: Path | str) -> Sources:
    """Read a script, and the files that it imports, directly or through others.

    They are searched in its folder, and also in the parent folder if the script mentions ``sys.path``. The script is
    the path of a file, or the name of a module in the working directory.
    """
    folder = script.resolve().parent if isinstance(script, Path) else Path.cwd()
    start = script if isinstance(script, Path) else folder / f"{script.replace('.', '/')}.py"
    above = start.is_file() and b"sys.path" in start.read_bytes()
    read: set[Path] = set()
    sources = Sources({script} if isinstance(script, str) else set(), root=folder)
    files = [(start, folder)]
    while files:
        path, origin = files.pop()
        path = path.resolve()
        if path in read or not path.is_file():
            continue
        read.add(path)
        sources.root = min(sources.root, origin)
        for level, name in sources.read(path, origin):
            for place in (folder, folder.parent)[: 1 + above] if level == 0 else (path.parents[level - 1],):
                module = place.joinpath(*name.split("."))
                files += [
                    (file, origin if level else place) for file in (module.with_suffix(".py"), module / "__init__.py")
                ]
    return sources


def read_folder(folder: Path) -> Sources:
    """Read all Python files under a folder, except those of extensions, environments and hidden folders."""
    sources = Sources(root=folder)
    for path in sorted(folder.rglob("*.py")):
        inner = path.relative_to(folder).parts
        if _NOT_READ.isdisjoint(inner) and not any(part.startswith(".") for part in inner):
            sources.read(path, folder)
    return sources


def _is_own(folder: Path, module: str) -> bool:
    """Whether a module is a source file of the folder, and not an extension to be compiled there."""
    package, *inner = module.split(".")
    if (folder / package / "setup.py").is_file():
        return False
    place = folder.joinpath(package, *inner)
    files = [file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()]
    # The Python half of an extension imports its compiled half, which was built if this file can be imported.
    names = rf"(\.+\w*|{re.escape(module)})"
    compiled = re.compile(rf"^\s*from\s+{names}(\s+import\s.*\b_C\b|\._C\s)", re.MULTILINE)
    if any(compiled.search(file.read_text("utf-8", "replace")) for file in files):
        return False
    return bool(files) or place.is_dir()


def _absolute(module: tuple[str, ...], level: int, name: str) -> str:
    """Return the dotted name of what a module imports with so many dots before it; "" beyond its top package."""
    if level == 0:
        return name
    return ".".join([*module[:-level], name]) if level < len(module) else ""


def _imports(nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Iterate over the modules that a file may import, each with its relative-import level."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = [node.module] if node.module else []
            yield from ((node.level, ".".join([*module, alias.name])) for alias in node.names)
            yield from ((node.level, name) for name in module)


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
