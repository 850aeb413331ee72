"""Every operation of a writing function, and some of those of a whole run, is the last of a process."""

import itertools
import signal
import sys

import pytest
import torch
from reliability.harness import start
from reliability.operations import listed, perform
from reliability.writes import SHORT, campaign

from ca_reg.monitor import LOG_NAME, CAMonitor
from ca_reg.score import CAScore
from reference_trainer.files import write_text

CARELESS = """
from pathlib import Path
place = Path({place!r})
place.write_text("the new one")
place.replace({path!r})
Path({path!r}).with_name("other.txt").touch()
"""


def killed(folder, fatal, power, action, *arguments):
    process = start(perform, folder, fatal, power, action, *arguments)
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


def contents(path, old, power, action, *arguments):
    """What a file holds if the action is killed at its first operation, its second, ..., and these operations."""
    seen = []
    for fatal in itertools.count(1):
        path.parent.mkdir(exist_ok=True)
        path.write_text(old)
        if not killed(path.parent, fatal, power, action, *arguments):
            return seen, [name.split()[0] for name in listed(path.parent).read_text().splitlines()]
        seen.append(path.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("power", [False, True])
def test_a_file_is_the_old_one_or_the_new_wherever_its_writer_is_killed(tmp_path, power):
    path = tmp_path / "folder" / "note.txt"
    seen, operations = contents(path, "old", power, write_text, path, "the new one")
    assert operations == ["mkdir", "open", "write", "write", "rename", "remove"]
    assert seen == ["old"] * 5 + ["the new one"]


def resumed(path, step):
    """Open the log of a training that goes on; without TensorBoard, which writes files of its own."""
    sys.modules["torch.utils.tensorboard"] = None
    score = CAScore(lambda opacity, view: (torch.zeros(3, 1, 1), torch.ones(1, 1)))
    CAMonitor(score, path.parent, views={"test": [0]}, resume_step=step)


@pytest.mark.slow
@pytest.mark.parametrize("power", [False, True])
def test_a_log_is_the_old_one_or_the_shortened_wherever_that_is_killed(tmp_path, power):
    path, lines = tmp_path / "folder" / LOG_NAME, [f'{{"step": {step}}}\n' for step in (1, 2, 3)]
    seen, operations = contents(path, "".join(lines), power, resumed, path, 2)
    before = operations.index("rename") + 1
    assert operations[before - 4 : before] == ["open", "write", "write", "rename"]
    assert seen == ["".join(lines)] * before + ["".join(lines[:2])] * (len(operations) - before)


@pytest.mark.slow
@pytest.mark.parametrize(("power", "after"), [(False, "the new one"), (True, "the n")])
def test_a_careless_writer_is_found_out(tmp_path, power, after):
    """In place, a kill leaves a part; moved without being synced, a power cut does."""
    path = tmp_path / "folder" / "note.txt"
    in_place = f"from pathlib import Path; Path({str(path)!r}).write_text('the new one')"
    assert contents(path, "old", power, exec, in_place)[0] == ["old", "", "th" if power else "the n"]
    moved = CARELESS.format(place=str(path.with_name("place.txt")), path=str(path))
    assert contents(path, "old", power, exec, moved)[0] == ["old"] * 4 + [after]


@pytest.mark.slow
def test_runs_killed_at_some_of_their_operations_and_again(tmp_path):
    """By power cuts, which lose more than kills; each run costs four processes that import torch, so these are few."""
    operations, out = campaign(SHORT, tmp_path, first=23, every=40, power=True, again=0)
    assert out.defects == []
    assert out.kills == out.finished == 2 * len(operations[22::40]) >= 6
