import os

import pytest
import torch

from reference_trainer.runs.executors import Processes
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.threads import chosen_threads, thread_count, threads_for
from reference_trainer.training.trainer import Trainer


@pytest.fixture
def processors(monkeypatch):
    """A machine of eight processors on which nobody has chosen anything."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)


@pytest.fixture
def four():
    """Four threads, as a caller of torch may have asked for."""
    torch.set_num_threads(4)
    yield
    torch.set_num_threads(1)


@pytest.mark.parametrize(
    ("pixels", "jobs", "threads"),
    [(None, 1, 8), (None, 3, 2), (None, 16, 1), (96 * 64, 1, 1), (252 * 189, 1, 1), (512 * 384, 1, 3),
     (4032 * 3024, 1, 8), (512 * 384, 4, 2)],
)  # fmt: skip
def test_small_pictures_get_one_thread_and_jobs_share(processors, pixels, jobs, threads):
    assert thread_count(pixels, jobs=jobs) == threads


@pytest.mark.parametrize(
    ("word", "threads"), [("3", 3), ("3,2", 3), (" 3 ", 3), ("", None), ("0", None), ("many", None)]
)
def test_what_the_user_has_set_wins(processors, monkeypatch, word, threads):
    monkeypatch.setenv("OMP_NUM_THREADS", word)
    assert chosen_threads() == threads
    assert thread_count(96 * 64) == (threads or 1)
    assert thread_count(jobs=2) == (threads or 4)
    assert Processes(2)._threads == (threads or 4)


def test_threads_are_only_ever_fewer_and_come_back(processors, four):
    for pixels, threads in ((96 * 64, 1), (512 * 384, 3), (4032 * 3024, 4)):
        with threads_for(pixels):
            assert torch.get_num_threads() == threads
        assert torch.get_num_threads() == 4


@pytest.mark.slow
def test_a_run_of_small_pictures_uses_one(processors, four, options, short, tmp_path, monkeypatch):
    seen = []
    original = Trainer.train_step
    monkeypatch.setattr(Trainer, "train_step", lambda self: (seen.append(torch.get_num_threads()), original(self))[1])
    results = run_experiment(options, short, tmp_path, monitoring=Monitoring(0))
    assert set(seen) == {1} == {results["machine"]["threads"]}
    assert torch.get_num_threads() == 4
