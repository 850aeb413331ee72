"""An executor of a sweep without other processes."""

from __future__ import annotations

from reference_trainer.runs.executors import Answer, Task, attempt

__all__ = ["Here"]


class Here:
    """An executor that does every task in this process, one at a time."""

    def __init__(self, jobs: int = 1) -> None:
        assert jobs == 1
        self.jobs = jobs
        self.tasks: list[Task] = []
        self.now: tuple[int, Answer]

    def start(self, number: int, task: Task) -> None:
        self.tasks.append(task)
        self.now = number, attempt(task, 1)

    def wait(self) -> list[tuple[int, Answer]]:
        return [self.now]

    def close(self) -> None:
        pass
