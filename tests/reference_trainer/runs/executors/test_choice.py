import sys

import pytest

from reference_trainer.runs.executors import Processes, RayCluster, choose_executor


@pytest.fixture(autouse=True)
def _no_cluster(monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


@pytest.fixture
def without_ray(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)


@pytest.mark.parametrize("name", ["auto", "processes"])
@pytest.mark.usefixtures("without_ray")
def test_without_ray_the_processes_of_this_machine_do(name):
    executor = choose_executor(name, jobs=3)
    assert isinstance(executor, Processes)
    assert executor.jobs == 3


@pytest.mark.parametrize(("name", "address"), [("ray", None), ("ray", "auto"), ("auto", "10.0.0.1:6379")])
@pytest.mark.usefixtures("without_ray")
def test_without_ray_a_cluster_says_what_to_install(name, address):
    with pytest.raises(ImportError, match=r"pip install 'ca_reg\[ray\]'; --executor processes"):
        choose_executor(name, jobs=1, address=address)


@pytest.mark.parametrize("name", ["ray", "auto"])
def test_an_address_is_that_of_a_cluster(name, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", object())
    assert isinstance(choose_executor(name, jobs=1, address="auto"), RayCluster)
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    assert isinstance(choose_executor(name, jobs=1), RayCluster)
    assert isinstance(choose_executor("processes", jobs=1), Processes)


def test_processes_have_no_address():
    with pytest.raises(ValueError, match=r"--address auto .*Ray cluster"):
        choose_executor("processes", jobs=1, address="auto")


@pytest.mark.parametrize("name", ["processes", "ray"])
def test_no_job_is_refused(name):
    with pytest.raises(ValueError, match="1 job, got 0"):
        choose_executor(name, jobs=0)
