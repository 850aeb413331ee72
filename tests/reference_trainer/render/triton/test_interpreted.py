"""Runs this file's neighbors and the losses' tests of float32 in processes of their own: interpreted, or on a card."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from subprocesses import subprocess_environment

pytest.importorskip("triton")
FOLDER = Path(__file__).parent
LOSSES = "../../training/losses/test_photometric.py"


def passes(marked, interpret, name="interpreted.py", *, named=""):
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-m", marked, "-k", named]
    environment = subprocess_environment(TRITON_INTERPRET=interpret, CA_REG_ENGINE="triton")
    done = subprocess.run(
        [*command, str((FOLDER / name).resolve())],
        cwd=FOLDER.parents[3],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("marked", "named"), [("not slow", ""), ("slow", "not far_end"), ("slow", "far_end")])
def test_in_the_interpreter(marked, named):
    passes(marked, "1", named=named)


@pytest.mark.slow
def test_losses():
    passes("not slow", "1", LOSSES, named="float32")


@pytest.mark.slow
def test_over_gsplats_lists():
    pytest.importorskip("gsplat")
    passes("slow", "1", "gsplat_lists.py")


@pytest.mark.gpu
def test_on_a_card():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    passes("slow or not slow", "0")
    passes("not slow", "0", LOSSES, named="float32")
