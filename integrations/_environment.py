"""What surrounds a launched script: processes and files that it makes, and names that its libraries have dropped."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from traceback import walk_tb
from types import ModuleType
from typing import Any
from unittest.mock import patch

from ._patching import AfterImport

__all__ = ["Watch", "explain_download", "folder_of_reports", "in_children", "old_aliases", "reports_of_children"]

_VARIABLE = "CA_REG_IN_CHILDREN"
_LAUNCHER = f"{__package__}.run"
_PYTHON = re.compile(r"(?:^|[/\s;&|])python[\d.]*(?:\.exe)?(?=\s|$)")
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


if "{_VARIABLE}" in os.environ and "{_LAUNCHER}" not in sys.orig_argv:
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
    if not _folder:
        with TemporaryDirectory(prefix="ca_reg_") as folder:
            (Path(folder) / "sitecustomize.py").write_text(_SITECUSTOMIZE, encoding="utf-8")
            _folder.append(folder)
            path = os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH")]))
            try:
                with patch.dict(os.environ, PYTHONPATH=path), in_children(function, *arguments):
                    yield
            finally:
                _folder.clear()
        return
    _calls.insert(0, (function, arguments))
    try:
        with patch.dict(os.environ, {_VARIABLE: json.dumps({"folder": _folder[0], "calls": _calls})}):
            yield
    finally:
        _calls.pop(0)


def folder_of_reports() -> str:
    """Return, in such a process, the folder in which it may leave a report."""
    return str(json.loads(os.environ[_VARIABLE])["folder"])


def reports_of_children() -> list[dict[str, Any]]:
    """Return the reports that such processes have left."""
    paths = sorted(Path(_folder[0]).glob("*.json")) if _folder else []
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


class Watch:
    """Notices files that a script writes and processes that it starts, within a ``with`` block.

    Attributes:
        saved: path of the model that was written last, as far as Python's own files go; None if there was none.
        missed: commands of Python processes that do not see the environment of :func:`in_children`.
    """

    _current: Watch | None = None
    _hooked = False

    def __init__(self) -> None:
        self.saved: str | None = None
        self.missed: list[str] = []

    def __enter__(self) -> Watch:
        """Watch."""
        if not Watch._hooked:  # such a hook cannot be removed
            sys.addaudithook(_audit)
        Watch._hooked, Watch._current = True, self
        return self

    def __exit__(self, *error: object) -> None:
        """Stop watching."""
        Watch._current = None

    def notice(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Process an audit event of Python."""
        if event == "open":
            path, mode = str(arguments[0]), str(arguments[1])
            if "w" in mode and path.endswith(_MODELS) and not path.endswith(_POINTS):
                self.saved = path
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
    if Watch._current is not None and event in ("open", "os.system", "subprocess.Popen"):
        Watch._current.notice(event, arguments)


def explain_download(error: BaseException, root: Path, saved: str | None) -> str | None:
    """Describe a download of a script's own that failed: whose it is, and which model had been written; else None."""
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

    def to_matplotlib(cm: ModuleType) -> None:
        give(cm, {"get_cmap": _get_cmap})

    watch = AfterImport({"numpy": to_numpy, "matplotlib.cm": to_matplotlib})
    watch.start()
    try:
        yield
    finally:
        watch.stop()
        for module, name in added:
            delattr(module, name)


def _get_cmap(name: Any = None, lut: int | None = None) -> Any:
    import matplotlib

    found = matplotlib.rcParams["image.cmap"] if name is None else name
    found = matplotlib.colormaps[found] if isinstance(found, str) else found
    return found if lut is None else found.resampled(lut)
