"""Runs the kernels' tests, this file's neighbors and others, in processes of their own: interpreted, or on a card."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from subprocesses import subprocess_environment

pytest.importorskip("triton")
FOLDER = Path(__file__).parent
LISTS = "gsplat_lists.py"
PARTS = {
    "interpreted.py": "interpreted",
    "../../training/losses/test_photometric.py": "photometric and float32",
    "../../training/density/test_operations.py": "operations and (are_counted or dilute or many_gaussians)",
    "../../model/test_optimizer.py": "optimizer",
}
"""Files, and which of their quick tests run kernels."""


def passes(marked, interpret, *names, named=""):
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-m", marked, "-k", named]
    environment = subprocess_environment(TRITON_INTERPRET=interpret, CA_REG_ENGINE="triton")
    done = subprocess.run(
        [*command, *(str((FOLDER / name).resolve()) for name in names)],
        cwd=FOLDER.parents[3],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    return int(re.search(r"(\d+) passed", done.stdout)[1])


@pytest.mark.slow
def test_quick_ones_in_the_interpreter():
    parts = [f"({named})" for named in PARTS.values()]
    assert passes("not slow", "1", *PARTS, named=" or ".join(parts)) >= 48


@pytest.mark.slow
def test_slow_ones_in_the_interpreter():
    assert passes("slow", "1", "interpreted.py", *([LISTS] if find_spec("gsplat") else [])) >= 50


@pytest.mark.gpu
def test_on_a_card():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    passes("slow or not slow", "0", "interpreted.py")
    passes("not slow", "0", "../../training/losses/test_photometric.py", named="float32")
