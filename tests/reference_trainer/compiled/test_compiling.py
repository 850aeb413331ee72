"""The machine code of the loops on the disk: kept, found again, and never needed."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from subprocesses import subprocess_environment

numba = pytest.importorskip("numba")
from reference_trainer.compiled import compiling  # noqa: E402

SOURCE = """
def double(first, last, x):
    for i in range(first, last):
        x[i] = 2 * x[i]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where kernels are kept, empty; kernels of the test are not among those of the package."""
    monkeypatch.setattr(compiling, "KERNELS", [])
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def imported(path):
    """Import a file anew, as in a new process."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def double(tmp_path):
    """Return a function that makes the kernel anew and uses it."""
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE)

    def use(compiling=compiling) -> None:
        x = np.arange(5.0)
        compiling.kernel(imported(path).double)(1, 4, x)
        assert x.tolist() == [0, 2, 4, 6, 4]

    return use


@pytest.fixture
def loaded(double):
    """Return a function that makes the kernel anew, uses it, and returns what was compiled."""

    def load(compiling=compiling) -> list[tuple[str, bool]]:
        compiled = []
        with compiling.reported_to(lambda name, folder: compiled.append((name, folder is not None))):
            double(compiling)
        return compiled

    return load


@pytest.fixture
def unwritable(tmp_path, monkeypatch):
    """Return a function after which kernels cannot be kept anywhere."""

    def make() -> None:
        file = tmp_path / "file"
        file.touch()  # nobody makes a folder below a file, not even root
        (tmp_path / "__pycache__").touch()
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(file / "cache"))
        for variable in ("HOME", "XDG_CACHE_HOME"):
            monkeypatch.setenv(variable, str(file / "home"))

    return make


def test_it_is_compiled_once(folder, loaded):
    assert loaded() == [("doubling.double", True)]
    assert loaded() == []


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", [b"", b"no pickle", None], ids=["empty", "garbage", "cut off"])
def test_a_damaged_file_costs_the_time_to_compile(folder, loaded, suffix, damage):
    loaded()
    (path,) = folder.rglob(f"*.{suffix}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2] if damage is None else damage)
    assert loaded() == [("doubling.double", True)]
    assert loaded() == []  # and is mended


@pytest.mark.parametrize("changed", ["constants.py", "tiles.py", "projection.py", "compositing.py", "threads.py", ""])
def test_what_is_inlined_from_other_files_counts(folder, loaded, monkeypatch, changed):
    loaded()
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + b"#" * (path.name == changed))
    compiled = loaded(imported(compiling.__file__))
    assert compiled == [("doubling.double", True)] * (changed not in ("threads.py", ""))


def test_a_full_disk_costs_the_time_to_compile(folder, loaded, full_disk):
    loaded()
    for path in folder.rglob("*.nb?"):
        path.unlink()
    with full_disk(100):
        assert loaded() == [("doubling.double", True)]
    assert loaded() == [("doubling.double", True)]
    assert loaded() == []


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is Linux's")
def test_it_is_kept_in_the_users_cache_and_not_among_the_installed_files(tmp_path, folder, loaded, monkeypatch):
    """pip does not remove what it did not install, and the folder that stays hides an editable installation."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert loaded() == [("doubling.double", True)]
    assert loaded() == []
    assert {path.relative_to(tmp_path).parts[:2] for path in tmp_path.rglob("*.nb?")} == {("home", "ca_reg")}


def test_a_machine_on_which_nothing_can_be_written(folder, loaded, unwritable):
    unwritable()
    assert loaded() == loaded() == [("doubling.double", False)]


def test_it_says_so_once(caplog, folder, double, unwritable):
    fresh = imported(compiling.__file__)
    for _ in range(2):
        double(fresh)
        shutil.rmtree(folder)  # or the second time nothing would be compiled
    (record,) = caplog.records
    assert "once on this machine" in record.getMessage()
    unwritable()
    double(fresh)
    assert "NUMBA_CACHE_DIR" in caplog.records[1].getMessage()


SCRIPT = """
import json, sys
import numpy as np
from reference_trainer.compiled import compiling
sys.path.append(sys.argv[1])
import doubling
compiled, x = [], np.arange(5.0)
with compiling.reported_to(lambda name, folder: compiled.append(name)):
    compiling.kernel(doubling.double)(1, 4, x)
print(json.dumps([compiled, x.tolist()]))
"""


def started(path, folder, **environment):
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(path.parent)],
        env=subprocess_environment(NUMBA_CACHE_DIR=str(folder), **environment),
        stdout=subprocess.PIPE,
    )


def answer(process):
    compiled, x = json.loads(process.communicate(timeout=300)[0])
    assert x == [0, 2, 4, 6, 4]
    return compiled


@pytest.mark.slow
def test_several_processes_at_once_and_another_processor(tmp_path):
    path, folder = tmp_path / "doubling.py", tmp_path / "cache"
    path.write_text(SOURCE)
    together = [started(path, folder) for _ in range(3)]
    assert any([answer(process) for process in together])
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    assert answer(started(path, folder, **generic)) == ["doubling.double"]
    assert answer(started(path, folder, **generic)) == []
    assert answer(started(path, folder)) == []  # of the first three, beside those of the other processor
