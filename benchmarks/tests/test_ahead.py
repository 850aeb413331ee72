"""The kernels compiled ahead of time for cards that differ most: nothing spills, and nothing grows unnoticed.

They are NVIDIA's oldest, and one of AMD's with wide warps; `python -m benchmarks.gpu ahead` takes all cards that the
installed Triton knows. In processes of their own: a kernel that was made for Triton's interpreter cannot be
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
BOUNDS = json.loads((ROOT / "benchmarks" / "data" / "kernels.json").read_text("utf-8"))
"""Most registers and instructions per entry of every kernel by maker, as `python -m benchmarks.gpu ahead` printed them
with Triton 3.9."""
SLACK = 1.5  # for other versions of Triton; a doubling of a loop or of registers is seen


def run(*arguments):
    environment = subprocess_environment(TRITON_INTERPRET="0", PYTHONPATH=str(ROOT))
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True)


def compiled(code):
    """What a program that compiles with `benchmarks.ahead` prints, as JSON."""
    done = run("-c", f"import dataclasses, json\nfrom benchmarks.ahead import *\nprint(json.dumps({code}))")
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("target", ["sm_75", "gfx90a"])
def test_nothing_spills_or_takes_much_more_than_it_did(target):
    """But projections of one and two bands, and backward without depths: others do as much and more."""
    less = "endswith(('degree 1', 'degree 2')) or k.label.startswith(('project backward, c', 'project backward, deg'))"
    some = f"[k for k in KERNELS if not (k.label.{less})]"
    rows = compiled(f"[dataclasses.asdict(compile_ahead(k, {target!r})) for k in {some}]")
    assert rows
    assert [row["kernel"] for row in rows if row["spills"]] == []
    for row in rows:
        registers, per_entry = BOUNDS[row["kernel"]]["NVIDIA" if target.startswith("sm_") else "AMD"]
        assert row["registers"] <= SLACK * registers, row
        if per_entry is not None:  # the exponential and the recursion at least, and no copy of the whole kernel
            assert 15 < row["per_entry"] < min(SLACK * per_entry, row["instructions"]), row


def test_the_table_of_the_page_has_the_numbers_of_the_bounds():
    page = (ROOT / "docs" / "gpu.md").read_text("utf-8").split("| kernel | registers |")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines()[2:]]
    assert len(rows) == 6
    for name, *spans in rows:
        (registers, nvidia), (same, amd) = BOUNDS[name]["NVIDIA"], BOUNDS[name]["AMD"]
        most = [int(span.split(" to ")[-1]) if span else None for span in spans]
        assert most == [max(registers, same), nvidia, amd], name


def test_a_spill_is_seen():
    """With fewer registers than the kernel needs."""
    kernel = "next(k for k in KERNELS if k.label == 'composite backward')"
    assert compiled(f"compile_ahead({kernel}, 'sm_90', maxnreg=24).spills") > 0


def test_the_command_says_what_it_cannot_compile():
    done = run("-m", "benchmarks.gpu", "ahead", "sm_10")
    assert done.returncode == 1
    assert "sm_10" in done.stdout
    assert run("-m", "benchmarks.gpu", "behind").returncode == 2
