"""The command for the first minute on a card: what fails is named and counted, and the rest goes on."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("triton")
pytest.importorskip("scipy")

from benchmarks import gpu

ROOT = Path(__file__).parents[2]


@pytest.fixture
def compiler(monkeypatch):
    """Kernels a and b and a compiler that knows sm_90 alone, and refuses some kernels there."""
    from benchmarks import ahead

    refused, spilled = set(), set()

    def compile_ahead(kernel, target):
        if target == "sm_120" or kernel.label in refused:
            raise RuntimeError(f"no {kernel.label} here\nat all")
        return ahead.Compiled(kernel.label, target, 40, 0, int(kernel.label in spilled), 100, 60)

    monkeypatch.setattr(ahead, "KERNELS", [ahead.Kernel(x, None, {}) for x in "ab"])
    monkeypatch.setattr(ahead, "compile_ahead", compile_ahead)
    return SimpleNamespace(refused=refused, spilled=spilled)


def test_a_target_that_compiles_nothing_is_unknown_to_this_triton(compiler):
    text = gpu._ahead(["sm_90", "sm_120"])
    assert "| b | NVIDIA | 40 |" in text
    assert text.endswith("not compiled, as no kernel of this target: a on sm_120: no a here")


def test_a_kernel_that_does_not_compile_fails_by_name_and_keeps_the_others(compiler):
    compiler.refused.add("a")
    with pytest.raises(RuntimeError, match=r"b .* NVIDIA .*\n(.*\n)*a on sm_90: no a here$"):
        gpu._ahead(["sm_90"])


def test_a_spill_fails_by_name(compiler):
    compiler.spilled.add("b")
    with pytest.raises(RuntimeError, match="b on sm_90: 1 spills"):
        gpu._ahead(["sm_90"])


def test_a_measurement_that_failed_is_counted(monkeypatch, capsys):
    def refuse(work):
        raise RuntimeError("out of memory\nand more")

    monkeypatch.setattr(gpu, "_measured", refuse)
    monkeypatch.setattr(gpu, "counts_table", lambda: f"| one | {gpu._measure(None)} |\n| two | 3 |")
    assert gpu.main(["count"]) == 1
    assert "| one | FAILED: out of memory | | | | |" in capsys.readouterr().out


CODE = """
import json, os, sys
from types import SimpleNamespace
from benchmarks import gpu

gpu._COMPARED, gpu._SIZES, gpu._STEPS, gpu._CALLS = (6, 9, 0.3), {"small": (12, 9, 0.3)}, 2, 1
little = gpu.synthetic_scene(16, 12, points=9)
gpu.synthetic_scene = lambda: little
os.environ.pop("CA_REG_DATA", None)
gpu._TRAININGS["nothing"] = "3dgs", {"renderer": "gsplat"}
del gpu._TRAININGS["the recipe sparse"]  # whose guard takes the interpreter half a minute; `interpreted.py` has one
gpu.find_spec = lambda name: name  # a gsplat that does not work
sys.modules["gsplat"] = SimpleNamespace(__version__="1.5.3")
called = []

def measured(work):
    if getattr(work, "__name__", "") != "train_step":
        work()
    return ["1", "2", "3", "4", "5"]

gpu._measured = measured
sections = gpu._agreement, gpu._times, gpu._trainings, gpu._launches
print(json.dumps([list(section("cpu")) for section in sections]))
"""


@pytest.mark.slow
def test_on_a_card_that_is_an_interpreter():
    environment = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    agreement, times, trainings, launches = json.loads(done.stdout.splitlines()[-1])
    for row in agreement[2:4]:
        assert all(float(cell) < 1e-4 for cell in row.split("|")[2:-1])
    assert agreement[4].startswith("| gsplat | FAILED: ")
    assert agreement[-1] == "Deterministic runs agree."
    assert {row.count("|") for row in agreement[:5]} == {8}
    trained = trainings.index("")
    assert {row.count("|") for row in (*times, *trainings[trained + 1 :])} == {9}
    failed = [row for row in (*times, *trainings) if "FAILED" in row]
    assert all("gsplat" in row for row in failed)
    assert len(failed) == 7
    assert times[-1] == "| built-in scene | training step, dropout | triton | 1 | 2 | 3 | 4 | 5 |"
    dropout, expectation, binocular = (row.split("|") for row in trainings[2:5])
    assert [row[5].strip() for row in (dropout, expectation, binocular)] == ["9"] * 3
    assert all(5 < float(row[6]) < 30 for row in (dropout, expectation, binocular))
    kernels = [row.split("|")[1].strip() for row in launches[2:]]
    assert kernels[:3] == ["find_visible", "index_visible", "project_forward"]
    assert kernels[-2:] == ["composite_backward", "project_backward"]
    assert all(float(cell) > 0 for row in launches[2:] for cell in row.split("|")[2:-1])
