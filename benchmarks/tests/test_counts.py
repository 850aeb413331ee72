"""What is counted without a card: launches, read-backs and bytes of an exact score, and what lists cost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from subprocesses import subprocess_environment

from benchmarks.counts import count_lists, counted

ROOT = Path(__file__).parents[2]
CODE = """
import json
from benchmarks.counts import bytes_per_entry, count_exact_score, count_step
rows = [count_exact_score(*size)._asdict() for size in ((16, 12, 0.05), (40, 30, 0.1))]
print(json.dumps({"rows": rows, "bytes": bytes_per_entry(), "step": count_step().read_backs}))
"""


@pytest.mark.parametrize("gradient", [False, True])
def test_lists_cost_in_proportion_to_their_entries(gradient, monkeypatch):
    monkeypatch.setattr("ca_reg.lists.CHUNK_ENTRIES", 1 << 10)
    short, longer, long = (count_lists(length, 16, gradient=gradient) for length in (100, 200, 400))
    assert long.entries > 3.5 * short.entries
    first, second = longer - short, long - longer
    assert second.elements / second.entries == pytest.approx(first.elements / first.entries, rel=0.1)
    assert second.operations / second.longest == pytest.approx(first.operations / first.longest, rel=0.1)
    assert second.peak / second.entries <= 32


@pytest.mark.parametrize(
    ("read", "count"),
    [
        (lambda x: (x + 1).cpu().tolist(), 1),
        (lambda x: int((x + 1).cpu()[-1]), 1),
        (lambda x: (read := (x + 1).cpu(), int(read[-1]), read.tolist()), 1),
        (lambda x: ((x + 1).tolist(), int(x[-1]), x.nonzero()), 3),
        (lambda x: x * 2, 0),
    ],
)
def test_a_number_is_read_back_once(read, count):
    x = torch.ones(3)
    assert counted(lambda: read(x))[1].read_backs == count


def test_an_exact_score_costs_the_same_at_any_size():
    """With the kernels, by Triton's interpreter in a process of its own."""
    pytest.importorskip("triton")
    environment = subprocess_environment(TRITON_INTERPRET="1", PYTHONPATH=str(ROOT))
    done = subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    small, large = found["rows"]
    assert large["entries"] > 4 * small["entries"]
    assert large["rendering"] == small["rendering"] <= 16
    assert abs(large["operations"] - small["operations"]) <= 3  # whether some Gaussians are left out
    assert large["operations"] <= 40
    assert large["read_backs"] == small["read_backs"] <= 3  # one of the picture, two of the score
    assert found["step"] <= 2  # the picture's, and the loss's once the step is done
    assert found["bytes"] <= 32
