"""The kernels compiled ahead of time for cards that differ most: nothing spills, and nothing grows unnoticed.

They are NVIDIA's oldest, and one of AMD's with wide warps; `python -m benchmarks.gpu ahead` takes all cards that the
installed Triton knows. In a process of its own: a kernel that was made for Triton's interpreter cannot be
compiled.
"""

import json
import runpy
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


CODE = """
import dataclasses, json
from benchmarks.ahead import KERNELS, compile_ahead
less = "project backward, c", "project backward, deg"
some = [k for k in KERNELS if not (k.label.endswith(("degree 1", "degree 2")) or k.label.startswith(less))]
found = {target: [dataclasses.asdict(compile_ahead(k, target)) for k in some] for target in ("sm_75", "gfx90a")}
kernel = next(k for k in KERNELS if k.label == "composite backward")
found["24 registers"] = compile_ahead(kernel, "sm_90", maxnreg=24).spills
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def compiled():
    """What one process compiles, but projections of one and two bands, and backward without depths: others do as much
    and more; and a kernel with fewer registers than it needs."""
    environment = subprocess_environment(TRITON_INTERPRET="0", PYTHONPATH=str(ROOT))
    done = subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("target", ["sm_75", "gfx90a"])
def test_nothing_spills_or_takes_much_more_than_it_did(compiled, target):
    rows = compiled[target]
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


def test_a_spill_is_seen(compiled):
    assert compiled["24 registers"] > 0


@pytest.mark.parametrize(("arguments", "code"), [(["ahead", "sm_10"], 1), (["behind"], 2)])
def test_the_command_says_what_it_cannot_compile(arguments, code, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["gpu", *arguments])
    monkeypatch.delitem(sys.modules, "benchmarks.gpu", raising=False)  # runpy warns of what is there already
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("benchmarks.gpu", run_name="__main__")
    assert ended.value.code == code
    assert arguments[-1] in "".join(capsys.readouterr())
