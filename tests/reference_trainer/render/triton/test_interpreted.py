"""Runs `interpreted.py` in a process of its own: in Triton's interpreter, and on a card where there is one."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from subprocesses import subprocess_environment

pytest.importorskip("triton")
FILE = Path(__file__).with_name("interpreted.py")


def passes(marked, interpret):
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-m", marked, str(FILE)]
    environment = subprocess_environment(TRITON_INTERPRET=interpret)
    done = subprocess.run(command, cwd=FILE.parents[4], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("marked", ["not slow", "slow"])
def test_in_the_interpreter(marked):
    passes(marked, "1")


@pytest.mark.gpu
def test_on_a_card():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    passes("slow or not slow", "0")
