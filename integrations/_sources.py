"""Static analysis of a code base's source: its imports, its rasterizers and its model classes."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

__all__ = ["Sources", "read_folder", "read_script"]

_SUFFIXES = ("Rasterizer", "RasterizationSettings")
_NOT_READ = {"submodules", "build", "site-packages"}  # extensions and environments within a repository


@dataclass
class Sources:
    """What the files of a code base import and define.

    Args:
        packages: top-level names of all imported modules.
        rasterizers: names ``...Rasterizer`` and ``...RasterizationSettings`` imported from foreign modules, by module.
        models: classes with a method ``update_learning_rate``, as ``module:Class``.
        root: the folder of the script, or its parent if files are imported from there.
    """

    packages: set[str] = field(default_factory=set)
    rasterizers: dict[str, set[str]] = field(default_factory=dict)
    models: list[str] = field(default_factory=list)
    root: Path = Path()

    @property
    def classes(self) -> list[str]:
        """The rasterizers as ``module:Class``."""
        found = self.rasterizers.items()
        return [f"{module}:{name}" for module, names in found for name in sorted(names) if name.endswith(_SUFFIXES[0])]

    def need(self, name: str) -> bool:
        """Whether a package is imported, or one that requires it, as nerfstudio requires gsplat."""
        found = set(self.packages)
        for package in self.packages:
            with suppress(PackageNotFoundError):
                found.update(re.split(r"[^\w-]", each)[0] for each in requires(package) or ())
        return name in found

    def read(self, path: Path, folder: Path) -> list[tuple[int, str]]:
        """Read a file of the folder; return the modules it may import, each with its relative-import level."""
        try:
            nodes = list(ast.walk(ast.parse(path.read_bytes())))
        except SyntaxError:  # Python will report it at run time
            return []
        modules = list(_imports(nodes))
        self.packages |= {name.partition(".")[0] for level, name in modules if level == 0}
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = {alias.name for alias in node.names if alias.name.endswith(_SUFFIXES)}
                if names and not _is_own(folder, node.module):
                    self.rasterizers.setdefault(node.module, set()).update(names)
            elif isinstance(node, ast.ClassDef) and path.is_relative_to(folder):
                methods = {part.name for part in node.body if isinstance(part, ast.FunctionDef)}
                if "update_learning_rate" in methods:
                    module = ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")
                    self.models.append(f"{module}:{node.name}")
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
    sources = Sources({script.partition(".")[0]} if isinstance(script, str) else set(), root=folder)
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
    sources = Sources()
    for path in sorted(folder.rglob("*.py")):
        inner = path.relative_to(folder).parts
        if _NOT_READ.isdisjoint(inner) and not any(part.startswith(".") for part in inner):
            sources.read(path, folder)
    return sources


def _is_own(folder: Path, module: str) -> bool:
    """Whether a module is part of the folder, and not an extension to be installed from there."""
    place = folder / module.partition(".")[0]
    return place.with_suffix(".py").is_file() or (place.is_dir() and not (place / "setup.py").is_file())


def _imports(nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Iterate over the modules that a file may import, each with its relative-import level."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = [node.module] if node.module else []
            yield from ((node.level, ".".join([*module, alias.name])) for alias in node.names)
            yield from ((node.level, name) for name in module)
