"""Fixtures shared by all tests."""

import os

# The tests are many small operations: a second thread only spins, and slows them down when the cores are busy. Torch
# reads this when it is loaded, and the processes that tests start inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Nor has torch.compile enough to do for processes of its own, each of which would import torch.
os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")

import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from devices import DEVICES
from stand_ins.card import CARD, pretended_card, register_card
from tiers import pytest_cmdline_main as pytest_cmdline_main
from tiers import pytest_configure as cut_the_slow_tier

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real scenes; skips where they are absent."""
    root = Path(os.environ.get("CA_REG_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"the real scenes are not at {root}; set CA_REG_DATA to their folder")
    return root


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Every device that this machine has, and one that it only pretends to have."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    with pretended_card() if request.param == CARD else nullcontext():
        yield torch.device(request.param)


@pytest.fixture
def card() -> Iterator[torch.device]:
    """A device that is none, and refuses what CUDA would refuse."""
    with pretended_card() as device:
        yield device


@pytest.fixture
def generator() -> torch.Generator:
    """A generator with a fixed seed."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """For what must have the bits of another process, whatever the threads of this one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def full_disk() -> Callable[[int], AbstractContextManager[None]]:
    """A context in which every file of this process ends at so many bytes: what goes beyond fails half-way."""
    resource = pytest.importorskip("resource", reason="the limit of a file's size is POSIX")

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


def pytest_collection_finish(session):
    """Compile the loops before the first test of a run on several processes: one does, the others wait."""
    if not hasattr(session.config, "workerinput") or not any("reference_trainer" in i.nodeid for i in session.items):
        return
    try:
        from filelock import FileLock
    except ImportError:  # without ca_reg[trainer] there are no loops
        return
    from reference_trainer.runs.warmup import warm_up

    with FileLock(Path(tempfile.gettempdir(), "ca_reg_tests_compile.lock")):
        warm_up()


class _WithoutTriton:
    """Leaves out the kernels and their tests: Triton has no wheels for macOS and Windows."""

    @staticmethod
    def pytest_ignore_collect(collection_path):
        path = collection_path.relative_to(ROOT) if collection_path.is_relative_to(ROOT) else collection_path
        return True if "triton" in path.as_posix() else None


def pytest_configure(config):
    """Prepare what must be before the first test."""
    register_card()
    cut_the_slow_tier(config)
    # No file of a test outlives it, so none need wait for the disk. Those of tests/reliability that pretend power cuts
    # do so in processes of their own.
    os.fsync = lambda handle: None
    if find_spec("triton") is None:
        config.pluginmanager.register(_WithoutTriton())
    # A shell starts background jobs deaf to Ctrl-C, and some tests send it to themselves.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
