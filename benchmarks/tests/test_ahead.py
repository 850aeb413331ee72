"""The kernels compiled ahead of time for cards that differ most, and nothing spilled.

They are NVIDIA's oldest and newest, and AMD's two widths of a warp; `python -m benchmarks.gpu ahead` takes all cards
that the installed Triton knows. In processes of their own: a kernel that was made for Triton's interpreter cannot be
compiled.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from subprocesses import subprocess_environment

pytest.importorskip("triton")
pytest.importorskip("scipy")
ROOT = Path(__file__).parents[2]


def run(*arguments):
    environment = subprocess_environment(TRITON_INTERPRET="0", PYTHONPATH=str(ROOT))
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True)


def compiled(code):
    """What a program that compiles with `benchmarks.ahead` prints, as JSON."""
    done = run("-c", f"import dataclasses, json\nfrom benchmarks.ahead import *\nprint(json.dumps({code}))")
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(("target", "registers"), [("sm_75", 128), ("sm_120", 128), ("gfx90a", 256), ("gfx1201", 256)])
def test_nothing_spills(target, registers):
    """The projections of one and two bands lie between those of none and of three, and took a quarter of the time."""
    some = "[k for k in KERNELS if not k.label.endswith(('degree 1', 'degree 2'))]"
    rows = compiled(f"[dataclasses.asdict(compile_ahead(k, {target!r})) for k in {some}]")
    assert rows
    assert [row["kernel"] for row in rows if row["spills"]] == []
    assert max(row["registers"] for row in rows) <= registers
    # A walk over a list is at least the exponential and the recursion, and no copy of the whole kernel.
    assert all(15 < row["per_entry"] < row["instructions"] for row in rows if row["per_entry"] is not None)


def test_a_spill_is_seen():
    """With fewer registers than the kernel needs."""
    kernel = "next(k for k in KERNELS if k.label == 'composite backward')"
    assert compiled(f"compile_ahead({kernel}, 'sm_90', maxnreg=24).spills") > 0


def test_the_command_says_what_it_cannot_compile():
    done = run("-m", "benchmarks.gpu", "ahead", "sm_10")
    assert done.returncode == 1
    assert "sm_10" in done.stdout
    assert run("-m", "benchmarks.gpu", "behind").returncode == 2
