"""The loops in other processes: forked, spawned, without numba, and at the end of the interpreter.

In those of Ray: `tests/reference_trainer/runs/test_compare.py`.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from subprocesses import PYTHONPATH, subprocess_environment
from tiny import save_few

pytestmark = pytest.mark.slow  # each starts interpreters that import torch


def run(script, timeout=300, **environment):
    """Run a script in a process of its own; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", script],
        env=subprocess_environment(**environment),
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


DRAW = """
import multiprocessing, os, sys, threading, time
import torch
from reference_trainer.camera import Camera
from reference_trainer.render import describe_engine, render, use_engine

torch.set_num_threads(3)

def picture(*_):
    g = torch.Generator().manual_seed(0)
    means = torch.rand(3000, 3, generator=g) + torch.tensor([-0.5, -0.5, 1.0])
    tensors = [means, torch.randn(3000, 4, generator=g), 0.05 * torch.rand(3000, 3, generator=g),
               torch.rand(3000, generator=g).requires_grad_()]
    out = render(*tensors, Camera(torch.eye(4), 90.0, 90.0, 50.0, 40.0, 100, 80), colors=means)
    assert out.splats.engine.name == "numba"
    out.image.square().sum().backward()
    return out.image.detach().numpy().tobytes() + tensors[3].grad.numpy().tobytes()
"""


def test_forks_after_the_first_use_and_a_thread_that_outlives_the_main_one():
    """And no thread is left at the end: what still waits for the GIL then is unwound, which once aborted a process."""
    pytest.importorskip("numba")
    assert run(
        """
import atexit, threading
atexit.register(lambda: print(*(thread.name for thread in threading.enumerate())))  # first in, last out
"""
        + DRAW
        + """
expected = picture()
for _ in range(3):
    child = os.fork()
    if child == 0:
        os._exit(0 if picture() == expected else 1)
    for _ in range(600):
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.1)
    else:
        os.kill(child, 9)
        sys.exit("the forked process hangs")
    assert status == 0
with multiprocessing.get_context("fork").Pool(2) as pool:
    assert pool.map(picture, range(4)) == [expected] * 4
assert picture() == expected
assert threading.active_count() > 1
def later():
    threading.main_thread().join()
    time.sleep(0.5)
    assert picture() == expected
    print("rendered", flush=True)
threading.Thread(target=later).start()
"""
    ) == "rendered\nMainThread\n"  # fmt: skip


def test_a_spawned_process(tmp_path):
    pytest.importorskip("numba")
    script = tmp_path / "spawning.py"
    script.write_text(
        DRAW
        + """
if __name__ == "__main__":
    expected = picture()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(picture, range(1)) == [expected]
"""
    )
    subprocess.run([sys.executable, str(script)], env=subprocess_environment(), check=True, timeout=300)


THREADS = """
import threading, time, torch
from reference_trainer.render import describe_engine
from reference_trainer.compiled.threads import in_threads
used = []
in_threads(lambda *_: time.sleep(0.05) or used.append(threading.get_ident()), 20, least=1)
print(torch.get_num_threads(), len(set(used)), describe_engine("cpu"))
"""
IMPORTS = """
import sys
import ca_reg, reference_trainer.render
from reference_trainer.cli import main
for command in ([], ["train"], ["compare"]):
    try:
        main([*command, "--help"])
    except SystemExit as exit_:
        assert exit_.code == 0
print("loaded:", [name for name in ("numba", "llvmlite") if name in sys.modules])
"""


@pytest.mark.parametrize(("count", "first"), [("1", IMPORTS), ("2", "")], ids=["1", "2"])
def test_omp_num_threads_decides_for_the_loops_and_what_does_not_render_does_not_import_numba(count, first):
    pytest.importorskip("numba")
    lines = run(first + THREADS, OMP_NUM_THREADS=count).splitlines()
    of_torch, used, described = lines[-1].split(maxsplit=2)
    assert used == of_torch
    assert f", {of_torch} thread" in described
    assert int(of_torch) <= int(count)
    assert not first or lines[-2] == "loaded: []"


def hiding(*packages):
    """The beginning of a script on a machine without some packages."""
    return f"""
import importlib.machinery, sys
import torch

class Hiding(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {packages} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(importlib.machinery.PathFinder)] = Hiding
"""


def test_without_numba_and_triton_everything_is_there(tmp_path):
    """And that Triton is missing is an error only if it is asked for."""
    save_few(tmp_path / "start.ply")
    out = run(
        hiding("numba", "llvmlite", "triton")
        + f"""
from reference_trainer.cli import main
from reference_trainer.render import describe_engine, use_engine
from reference_trainer.render.engine import engines_on
print(describe_engine("cuda"), engines_on(torch.device("cuda")))
try:
    use_engine("triton")
except ImportError as error:
    print(error)
out, start = {str(tmp_path / "run")!r}, {str(tmp_path / "start.ply")!r}
train = ["train", "--downscale", "16", "--init", start, "--monitor-every", "0", "--dropout", "0.2"]
main([*train, "--iterations", "3", "--out", out])
main(["evaluate", out])
main([*train, "--iterations", "2", "--analytic", "--out", out + "2"])
main(["warmup"])
assert "numba" not in sys.modules
try:
    main(["render", out, "--engine", "numba"])
except SystemExit as exit_:
    print("code", exit_.code)
"""
    )
    assert out.startswith("torch ('torch',)\n")
    assert "pip install 'triton>=3.4'" in out
    assert "Engine: torch" in out
    assert "exact CA" in out
    assert "Nothing is left" in out
    assert out.endswith("code 2\n")


def test_a_numba_that_cannot_be_imported_is_as_good_as_none(tmp_path):
    """Such as one that is too old for the installed NumPy, which raises ImportError."""
    (tmp_path / "numba").mkdir()
    (tmp_path / "numba" / "__init__.py").write_text("raise ImportError('Numba needs NumPy 1.0 or less')")
    out = run(
        """
import warnings
from reference_trainer.render import describe_engine, use_engine
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    print(describe_engine("cpu"), describe_engine("cpu"), [str(x.message) for x in caught])
try:
    use_engine("numba")
except ImportError as error:
    print(error)
""",
        PYTHONPATH=f"{tmp_path}:{PYTHONPATH}",
    )
    assert out.startswith("torch torch ['")
    assert out.count("(Numba needs NumPy 1.0 or less)") == 1
    assert "engine numba needs numba" in out


def test_warmup_leaves_nothing_to_compile(tmp_path):
    """With all loops of a training, a score, shares and a dense start; those of one file are then missing in a copy."""
    pytest.importorskip("numba")
    script = """
from reference_trainer.cli import main
main(["warmup"])
import reference_trainer.compiled.stereo
from reference_trainer.compiled.compiling import KERNELS
assert len(KERNELS) > 10
print("unused:", [kernel.py_func.__qualname__ for kernel in KERNELS if not kernel.signatures])
print(*{str(kernel._cache.cache_path) for kernel in KERNELS}, sep="\\n")
"""
    _, _, folders = run(script, timeout=900).partition("unused: []\n")
    assert folders
    for folder in map(Path, folders.splitlines()):
        if not folder.is_dir():
            pytest.skip("no folder keeps loops")
        shutil.copytree(folder, tmp_path / folder.name, ignore=shutil.ignore_patterns("binning.*"))
    first, second = (run(script, timeout=900, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2))
    assert "Compiling the renderer's loops" in first
    compiled = re.search(r"^Compiled: (.+)\.$", first, re.MULTILINE)[1].split(", ")
    assert {name.partition(".")[0] for name in compiled} == {"binning"}
    assert "Compiling" not in second
    assert "Nothing is left" in second
