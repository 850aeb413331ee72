"""Real processes, killed for real."""

import os
import re
import signal
import subprocess
import sys
import threading
from operator import itemgetter
from pathlib import Path

import pytest
import sweep_tasks
from subprocesses import subprocess_environment
from waiting import PATIENCE, until

from reference_trainer.runs.executors import Failure, Processes, Task, Value, run_all


def gone(pid):
    """Whether a process has ended; one that nobody has waited for yet has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def kill_the_one_who_waits(folder):
    """Kill the process of `sweep_tasks.wait_to_be_killed` when it has said its number."""
    until((folder / "pid").exists)
    os.kill(int((folder / "pid").read_text()), signal.SIGKILL)


@pytest.mark.slow
def test_every_task_has_a_process_with_its_share_of_the_processors_and_an_outcome(monkeypatch):
    """Of four tasks one raises, one ends its process, and two tell about themselves."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(6)), raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    about = [Task(name, sweep_tasks.environment, ()) for name in "ab"]
    tasks = [Task("3", sweep_tasks.square, (3,)), Task("leave", sweep_tasks.leave, ()), *about]
    raised, left, *told = [outcome for _, outcome in sorted(run_all(Processes(2), tasks, retries=0), key=itemgetter(0))]
    assert isinstance(raised, Failure)
    assert raised.error == "ValueError: three is refused"
    assert "in square" in raised.traceback
    assert "exit code 7" in left.error
    assert len({outcome.value[0] for outcome in told} | {os.getpid()}) == 3
    assert [outcome.value[1] for outcome in told] == [3, 3]


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_takes_no_other_task_with_it(tmp_path, said):
    killer = threading.Thread(target=kill_the_one_who_waits, args=(tmp_path,))
    killer.start()
    tasks = [Task("victim", sweep_tasks.wait_to_be_killed, (str(tmp_path), 5)), Task("other", sweep_tasks.square, (2,))]
    outcomes = dict(run_all(Processes(2), tasks))
    killer.join()
    assert outcomes == {0: Value(25), 1: Value(4)}
    assert len(said) == 1
    assert re.match("victim: .*SIGKILL, .*memory", said[0])


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_worker_is_interrupted_once_however_its_parent_ends(tmp_path, number):
    """The sweep runs in a session of its own; SIGINT goes to all of its group, as Ctrl-C in a terminal does."""
    command = [sys.executable, sweep_tasks.__file__, str(tmp_path)]
    sweep = subprocess.Popen(command, env=subprocess_environment(), start_new_session=True, stderr=subprocess.PIPE)
    until((tmp_path / "started").exists)
    worker = int((tmp_path / "started").read_text())
    if number == signal.SIGINT:
        os.killpg(sweep.pid, number)
    else:
        os.kill(sweep.pid, number)
    until((tmp_path / "interrupted").exists)
    sweep.communicate(timeout=PATIENCE)
    until(lambda: gone(worker))


def test_no_job_is_refused():
    with pytest.raises(ValueError, match="1 job, got 0"):
        Processes(0)
