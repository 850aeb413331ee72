"""The queue, on an executor that does what it is told: no processes."""

from collections import defaultdict

import pytest

from reference_trainer.runs.executors import Death, Failure, Task, Value, attempt, run_all


class Told:
    """Answers every task with the next entry of its script; ends the task that was started last first."""

    def __init__(self, jobs, script):
        self.jobs = jobs
        self.script = {number: list(answers) for number, answers in script.items()}
        self.running: list[int] = []
        self.started: list[int] = []
        self.most = 0
        self.closed = False

    def start(self, number, task):
        assert task.label == f"task {number}"
        self.started.append(number)
        self.running.append(number)
        self.most = max(self.most, len(self.running))

    def wait(self):
        number = self.running.pop()
        return [(number, self.script[number].pop(0))]

    def close(self):
        self.closed = True


def tasks(count):
    return [Task(f"task {number}", print, ()) for number in range(count)]


@pytest.mark.parametrize("jobs", [1, 2, 7])
def test_every_task_ends_once_and_no_more_run_than_asked(jobs):
    executor = Told(jobs, {number: [Value(number)] for number in range(5)})
    assert sorted(run_all(executor, tasks(5))) == [(number, Value(number)) for number in range(5)]
    assert sorted(executor.started) == list(range(5))
    assert executor.most == min(jobs, 5)
    assert executor.closed


def test_a_failure_is_an_outcome_and_is_not_tried_again():
    failure = Failure("ValueError: no", "Traceback")
    executor = Told(1, {0: [Value(0)], 1: [failure], 2: [Value(2)]})
    assert dict(run_all(executor, tasks(3))) == {0: Value(0), 1: failure, 2: Value(2)}
    assert executor.started == [0, 1, 2]


def test_a_task_whose_worker_died_goes_to_the_end_of_the_queue(said):
    executor = Told(1, {0: [Death("killed"), Death("killed"), Value(0)], 1: [Value(1)], 2: [Value(2)]})
    assert list(run_all(executor, tasks(3))) == [(1, Value(1)), (2, Value(2)), (0, Value(0))]
    assert executor.started == [0, 1, 2, 0, 0]
    assert [text[-8:] for text in said] == ["(1 of 3)", "(2 of 3)"]
    assert all(text.startswith("task 0: killed") for text in said)


@pytest.mark.parametrize("retries", [0, 1, 4])
def test_a_task_that_kills_every_worker_is_given_up(retries):
    executor = Told(2, defaultdict(list, {0: [Death(f"end {n}") for n in range(9)], 1: [Value(1)]}))
    outcomes = dict(run_all(executor, tasks(2), retries=retries))
    assert outcomes[1] == Value(1)
    assert outcomes[0].error == (f"end {retries} ({retries + 1} workers died)" if retries else "end 0")
    assert executor.started.count(0) == retries + 1


def test_the_executor_is_closed_when_nobody_asks_any_more():
    executor = Told(1, {number: [Value(number)] for number in range(5)})
    outcomes = run_all(executor, tasks(5))
    next(outcomes)
    outcomes.close()
    assert executor.closed
    assert executor.started == [0]


def test_the_executor_is_closed_on_an_interruption():
    executor = Told(1, {0: []})
    executor.wait = lambda: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        list(run_all(executor, tasks(1)))
    assert executor.closed


def test_an_error_becomes_data_and_an_interruption_does_not():
    def interrupt():
        raise KeyboardInterrupt

    failure = attempt(Task("x", {}.__getitem__, ("key",)), 1)
    assert failure.error == "KeyError: 'key'"
    assert failure.traceback.startswith("Traceback")
    with pytest.raises(KeyboardInterrupt):
        attempt(Task("x", interrupt, ()), 1)
