"""Ray on this machine with a worker killed for real; what it is asked for on other machines, by a stand-in."""

import os
import re
import signal
import sys
import threading
from types import SimpleNamespace

import pytest
import sweep_tasks
from subprocesses import PYTHONPATH
from waiting import until

from reference_trainer.runs.executors import Failure, RayCluster, Task, Value, run_all


@pytest.fixture(autouse=True)
def _no_cluster(monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


class StandIn:
    """The part of ``ray`` that starts tasks: notes what it is asked for, and does nothing."""

    def __init__(self, processors):
        self.processors = processors
        self.asked: dict = {}
        self.initialized = False
        self.shut = 0

    def is_initialized(self):
        return self.initialized

    def init(self, **keywords):
        self.asked["init"] = keywords

    def nodes(self):
        alive = [{"Alive": True, "Resources": {"CPU": float(count)}} for count in self.processors]
        return [*alive, {"Alive": False, "Resources": {"CPU": 1000.0}}, {"Alive": True, "Resources": {}}]

    def remote(self, **keywords):
        self.asked["remote"] = keywords
        started = SimpleNamespace(remote=lambda task, threads: self.asked.update(threads=threads) or "reference")
        return lambda function: SimpleNamespace(options=lambda name: started)

    def cancel(self, reference):
        self.asked["cancelled"] = reference

    def wait(self, references, num_returns, timeout):
        self.asked["waited"] = references

    def shutdown(self):
        self.shut += 1


def engine_on(stand_in, monkeypatch, jobs, **keywords):
    """An executor that has started one task on a stand-in."""
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    executor = RayCluster(jobs, **keywords)
    assert stand_in.asked == {}  # a sweep with nothing to do joins no cluster
    executor.start(0, Task("task", print, ()))
    return executor


@pytest.mark.parametrize(
    ("processors", "jobs", "share"),
    [
        ([8], 1, 8),
        ([8], 3, 2),
        ([2], 5, 1),
        ([16, 4, 4], 2, 12),
        ([4, 4, 4], 1, 4),  # no machine has 12: a task that asked for them would wait for ever
        ([], 2, 1),  # a cluster that grows when it is asked to
    ],
)
def test_a_task_reserves_its_share_of_the_processors(processors, jobs, share, monkeypatch):
    for chosen in (None, "5"):  # what the user has set wins, and reserves no more
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        if chosen:
            monkeypatch.setenv("OMP_NUM_THREADS", chosen)
        stand_in = StandIn(processors)
        engine_on(stand_in, monkeypatch, jobs, address="host:6379", gpus=0.5)
        assert stand_in.asked["threads"] == int(chosen or share)
    assert stand_in.asked["remote"] == {"num_cpus": share, "num_gpus": 0.5, "max_retries": 0}


def test_a_cluster_of_its_own_has_a_processor_for_every_job(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    stand_in = StandIn([4])
    engine_on(stand_in, monkeypatch, 6)
    assert stand_in.asked["init"]["address"] == "local"
    assert stand_in.asked["init"]["num_cpus"] == 6


@pytest.mark.parametrize(("option", "variable", "expected"), [("a:1", "b:1", "a:1"), (None, "b:1", "b:1")])
def test_the_address_of_a_running_cluster(option, variable, expected, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", variable)
    stand_in = StandIn([4])
    engine_on(stand_in, monkeypatch, 1, address=option)
    assert stand_in.asked["init"]["address"] == expected
    assert "num_cpus" not in stand_in.asked["init"]  # Ray refuses to resize it


@pytest.mark.parametrize("joined_before", [False, True])
def test_what_still_runs_is_interrupted_and_a_cluster_of_the_caller_is_left_running(joined_before, monkeypatch):
    stand_in = StandIn([4])
    stand_in.initialized = joined_before
    executor = engine_on(stand_in, monkeypatch, 1)
    assert ("init" in stand_in.asked) != joined_before
    for _ in range(2):
        executor.close()
    assert (stand_in.asked["cancelled"], stand_in.asked["waited"]) == ("reference", ["reference"])
    assert stand_in.shut == (0 if joined_before else 1)


def test_the_next_sweep_joins_a_cluster_again(monkeypatch):
    """It may have other machines by then, and the one that ended is not there any more."""
    stand_in = StandIn([4])
    executor = engine_on(stand_in, monkeypatch, 2)
    executor.close()
    stand_in.asked.clear()
    stand_in.processors = [8]
    executor.start(0, Task("task", print, ()))
    assert stand_in.asked["init"]["address"] == "local"
    assert stand_in.asked["remote"]["num_cpus"] == 4


@pytest.mark.slow
def test_a_sweep_on_ray_with_a_worker_killed(tmp_path, monkeypatch, said):
    """One task of four raises, the worker of another is killed in the middle; one tells about itself."""
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)  # Ray passes it to its workers

    def kill():
        until((tmp_path / "pid").exists)
        os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    tasks = [
        Task("victim", sweep_tasks.wait_to_be_killed, (str(tmp_path), 5)),
        Task("other", sweep_tasks.square, (2,)),
        Task("failing", sweep_tasks.square, (3,)),
        Task("about", sweep_tasks.environment, ()),
    ]
    outcomes = dict(run_all(RayCluster(2), tasks))
    killer.join(timeout=10)
    assert not ray.is_initialized()
    assert (outcomes[0], outcomes[1]) == (Value(25), Value(4))
    assert isinstance(outcomes[2], Failure)
    assert outcomes[2].error == "ValueError: three is refused"
    assert "in square" in outcomes[2].traceback
    pid, threads = outcomes[3].value
    assert pid != os.getpid()
    assert threads == max(2, os.cpu_count()) // 2
    assert len(said) == 1
    assert re.match(r"victim: .*\(WorkerCrashedError", said[0])
    assert said[0].endswith("; again with another (1 of 3)")
