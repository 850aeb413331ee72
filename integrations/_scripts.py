"""The script that is launched: what its sources import, how Python would run it, and the processes that it starts."""

from __future__ import annotations

import ast
import json
import os
import re
import runpy
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from tempfile import TemporaryDirectory
from traceback import walk_tb
from types import ModuleType
from typing import Any
from unittest.mock import patch

from ._patching import AfterImport

_SUFFIXES = ("Rasterizer", "RasterizationSettings")
_OF_MESHES = "pytorch3d"  # the package whose rasterizers, of meshes and points, have such names, too
_NOT_READ = {"submodules", "build", "site-packages"}  # extensions and environments within a repository


@dataclass
class Sources:
    """What the files of a code base import and define."""

    imports: set[str] = field(default_factory=set)
    """Dotted names of all modules, and of what may be one."""
    rasterizers: dict[str, set[str]] = field(default_factory=dict)
    """Names ``...Rasterizer`` and ``...RasterizationSettings`` of foreign modules that are imported, by module."""
    models: list[str] = field(default_factory=list)
    """Classes with a method ``update_learning_rate(iteration)``, as ``module:Class``."""
    root: Path = Path()
    """The folder of the script, or its parent if files are imported from there."""

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
                found.update(re.split(r"[^\w-]", each)[0] for each in requires(package) or () if "extra ==" not in each)
        return name in found

    def read(self, path: Path, folder: Path, *, main: bool = False) -> list[tuple[int, str]]:
        """Read a file of the folder; return the modules it may import, each with its relative-import level.

        Classes of the main program are no models: they are made while it runs, and no import shows them before.
        """
        try:
            nodes = list(ast.walk(ast.parse(path.read_bytes())))
        except SyntaxError:  # Python will report it at run time
            return []
        module = path.relative_to(folder).with_suffix("").parts if path.is_relative_to(folder) else ()
        modules = list(_imports(nodes))
        self.imports |= {_absolute(module, level, name) for level, name in modules} - {""}
        aliases = [alias for node in nodes if isinstance(node, ast.Import) for alias in node.names]
        called = {alias.asname or alias.name: alias.name for alias in aliases}
        for node in nodes:
            origin, names = "", set[str]()
            if isinstance(node, ast.ImportFrom) and node.module:
                names = {alias.name for alias in node.names if alias.name.endswith(_SUFFIXES)}
                origin = _absolute(module, node.level, node.module)
            elif isinstance(node, ast.Attribute) and node.attr.endswith(_SUFFIXES):
                origin, names = called.get(ast.unparse(node.value), ""), {node.attr}
            if origin and names and origin.partition(".")[0] != _OF_MESHES and not is_source(folder, origin):
                self.rasterizers.setdefault(origin, set()).update(names)
            if isinstance(node, ast.ClassDef) and module and not main:
                methods = {part.name: part.args for part in node.body if isinstance(part, ast.FunctionDef)}
                arguments = methods.get("update_learning_rate")
                # Without an argument it may be a scheduler's, called for anything but a step of a model.
                if arguments is not None and len(arguments.posonlyargs + arguments.args) > 1:
                    self.models.append(f"{'.'.join(module).removesuffix('.__init__')}:{node.name}")
        return modules


def read_script(script: Path | str) -> Sources:
    """Read a script, and the files that it imports, directly or through others.

    They are searched in its folder, and also in the parent folder if the script mentions ``sys.path``; gsplat is not
    read. The script is the path of a file, or the name of a module or of a package in the working directory.
    """
    folder = script.resolve().parent if isinstance(script, Path) else Path.cwd()
    start = folder.joinpath(*script.split("."), "__main__.py") if isinstance(script, str) else script
    if isinstance(script, str) and not start.is_file():
        start = start.parent.with_suffix(".py")
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
        for level, name in sources.read(path, origin, main=path == start.resolve()):
            if name.partition(".")[0] == "gsplat":  # its wrappers of INRIA's rasterizers are not the script's
                continue
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
        hidden = any(part.startswith(".") for part in inner)
        if path.is_file() and _NOT_READ.isdisjoint(inner) and not hidden:  # a link may lead nowhere
            sources.read(path, folder)
    return sources


def is_source(folder: Path, module: str) -> bool:
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
    # `python -m` has put the working directory there; with -P there is no such entry.
    if not sys.flags.safe_path:
        sys.path[0] = str(script.resolve().parent) if isinstance(script, Path) else os.getcwd()


def run_script(script: Path | str) -> None:
    """Run a script as the main program; its exceptions, SystemExit and KeyboardInterrupt included, pass through."""
    if isinstance(script, Path):
        runpy.run_path(str(script), run_name="__main__")
    else:
        runpy.run_module(script, run_name="__main__", alter_sys=True)


_VARIABLE = "CA_REG_IN_CHILDREN"
_LAUNCHER = f"{__package__}.run"
_PYTHON = re.compile(r"(?:^|[/\s;&|])(?<!include/)python[\d.]*(?:\.exe)?(?=\s|$)")
_ISOLATED = re.compile(r"\s-[a-zA-Z]*[IES]")  # such a Python reads neither PYTHONPATH nor sitecustomize
_MODELS = (".ply", ".pth", ".pt", ".ckpt", ".npz")
_POINTS = ("input.ply", "points3D.ply", "points3d.ply")  # the initial points, which the INRIA family copies
_NETWORK = {"urllib", "urllib3", "requests", "huggingface_hub"}

# Python imports this module when it starts. It waits for torch, as processes without torch render nothing, and then
# hands over to the module of the same name that it hides, if there is one.
_SITECUSTOMIZE = f'''
import importlib.util
import json
import os
import sys

folder = os.path.dirname(os.path.abspath(__file__))


class AfterTorch:
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name != "torch":
            return None
        sys.meta_path.remove(cls)
        spec = importlib.util.find_spec(name)
        sys.meta_path.insert(0, cls)  # many packages only ask whether torch is there, before anyone imports it
        if spec is not None:
            run = spec.loader.exec_module
            spec.loader.exec_module = lambda module: (run(module), begin())
        return spec


def begin():
    try:
        for function, arguments in json.loads(os.environ["{_VARIABLE}"])["calls"]:
            module, _, name = function.partition(":")
            getattr(importlib.import_module(module), name)(*arguments)
    except (Exception, SystemExit) as error:
        problem = f"not regularized, {{type(error).__name__}}: {{error}}"
        print(f"[ca_reg] {{sys.argv[0]}}: {{problem}}", file=sys.stderr)
        with open(os.path.join(folder, f"{{os.getpid()}}.json"), "w") as file:
            json.dump({{"script": sys.argv[0], "renders": None, "problem": problem}}, file)


if "{_VARIABLE}" in os.environ and "{_LAUNCHER}" not in getattr(sys, "orig_argv", ()):
    sys.meta_path.insert(0, AfterTorch)
sys.path[:] = [place for place in sys.path if os.path.abspath(place) != folder]
hidden = sys.modules.pop("sitecustomize")
try:
    import sitecustomize
except ImportError:
    sys.modules["sitecustomize"] = hidden
'''

_calls: list[tuple[str, Sequence[Any]]] = []  # functions that children call, with their arguments
_folder: list[str] = []


@contextmanager
def in_children(function: str, *arguments: Any) -> Iterator[None]:
    """Let Python processes that are started within the block call a function, ``module:name``, once they import torch.

    This holds for processes of ``multiprocessing`` that start afresh, for ``subprocess``, ``os.system`` and whatever
    else hands on the environment, and for their children. The function of an inner block is called first. The arguments
    must be representable in JSON.
    """
    with ExitStack() as undo:
        if not _folder:
            folder = undo.enter_context(TemporaryDirectory(prefix="ca_reg_"))
            (Path(folder) / "sitecustomize.py").write_text(_SITECUSTOMIZE, encoding="utf-8")
            path = os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH")]))
            undo.enter_context(patch.dict(os.environ, PYTHONPATH=path))
            _folder.append(folder)
            undo.callback(_folder.clear)
        _calls.insert(0, (function, arguments))
        undo.callback(_calls.pop, 0)
        undo.enter_context(patch.dict(os.environ, {_VARIABLE: json.dumps({"folder": _folder[0], "calls": _calls})}))
        yield


def folder_of_reports() -> str:
    """Return, in such a process, the folder in which it may leave a report."""
    return str(json.loads(os.environ[_VARIABLE])["folder"])


def reports_of_children() -> list[dict[str, Any]]:
    """Return the reports that such processes have left."""
    paths = sorted(Path(_folder[0]).glob("*.json")) if _folder else []
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


class ScriptAudit:
    """Notices files that a script writes and processes that it starts, within a ``with`` block."""

    _current: ScriptAudit | None = None
    _hooked = False

    def __init__(self) -> None:
        # Paths of the model and of the .ply that were written last, as far as Python's own files go.
        self.saved: str | None = None
        self.saved_ply: str | None = None
        self.missed: list[str] = []  # commands of Python processes that do not see the environment of `in_children`

    def __enter__(self) -> ScriptAudit:
        if not ScriptAudit._hooked:  # such a hook cannot be removed
            sys.addaudithook(_audit)
        ScriptAudit._hooked, ScriptAudit._current = True, self
        return self

    def __exit__(self, *error: object) -> None:
        ScriptAudit._current = None

    def notice(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Process an audit event of Python."""
        if event == "open":
            path, mode = str(arguments[0]), str(arguments[1])
            if "w" in mode and path.endswith(_MODELS) and not path.endswith(_POINTS):
                self.saved = os.path.abspath(path)  # the script may change the working directory
                self.saved_ply = self.saved if path.endswith(".ply") else self.saved_ply
        elif event == "os.system":
            self._check(os.fsdecode(arguments[0]), os.environ)
        elif event == "subprocess.Popen":
            command = arguments[1]
            words = [command] if isinstance(command, str | bytes | os.PathLike) else command
            self._check(" ".join(map(os.fsdecode, words)), os.environ if arguments[3] is None else arguments[3])

    def _check(self, command: str, environment: Mapping[Any, Any]) -> None:
        if not _folder or not _PYTHON.search(command) or _LAUNCHER in command:
            return
        names = {os.fsdecode(name): os.fsdecode(value) for name, value in environment.items()}
        reached = _VARIABLE in names and _folder[0] in names.get("PYTHONPATH", "").split(os.pathsep)
        if not reached or _ISOLATED.search(command):
            self.missed.append(command)


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if ScriptAudit._current is not None and event in ("open", "os.system", "subprocess.Popen"):
        ScriptAudit._current.notice(event, arguments)


def explain_download(error: BaseException, root: Path, saved: str | None) -> str | None:
    """Describe a failed download of the script's own, with its file and the last model written; None if it was none."""
    cause: BaseException | None = error
    while cause is not None and type(cause).__module__.partition(".")[0] not in _NETWORK:
        cause = cause.__cause__ or cause.__context__
    if cause is None:
        return None
    frames = [frame for each in (error, cause) for frame, _ in walk_tb(each.__traceback__)]
    files = [Path(frame.f_code.co_filename) for frame in frames]
    own = next((file.relative_to(root) for file in reversed(files) if file.is_relative_to(root)), "the script")
    addresses = [frame.f_locals.get("url") for frame in frames]
    address = next((str(url) for url in addresses if isinstance(url, str)), "a file")
    return (
        f"The script's own {own} downloads {address}, which failed; neither the launcher nor the training needs it. "
        + (f"The last model written before that is {saved}." if saved else "No model was seen to be written before.")
        + " Put the file where the script looks for it, or evaluate where there is a network."
    )


@contextmanager
def old_aliases() -> Iterator[None]:
    """Give ``np.int`` and its like, and ``matplotlib.cm.get_cmap``, back to their libraries within a block."""
    added: list[tuple[ModuleType, str]] = []

    def give(module: ModuleType, names: Mapping[str, Any]) -> None:
        for name, value in names.items():
            if name not in vars(module):  # numpy warns of a name that it asks for
                setattr(module, name, value)
                added.append((module, name))

    def to_numpy(numpy: ModuleType) -> None:
        kinds = {kind.__name__: kind for kind in (int, float, bool, complex, object, str)}
        give(numpy, kinds | {"float_": numpy.float64, "complex_": numpy.complex128, "Inf": numpy.inf, "NaN": numpy.nan})

    try:
        with AfterImport({"numpy": to_numpy, "matplotlib.cm": lambda cm: give(cm, {"get_cmap": _get_cmap})}):
            yield
    finally:
        for module, name in added:
            delattr(module, name)


def _get_cmap(name: Any = None, lut: int | None = None) -> Any:
    from matplotlib import pyplot

    return pyplot.get_cmap(name, lut)
