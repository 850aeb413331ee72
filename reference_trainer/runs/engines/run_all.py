"""The queue of a sweep: a limited number of tasks at a time, and a new worker for a task whose worker died."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence

from reference_trainer.runs.engines.engine import Death, Engine, Failure, Task, Value

__all__ = ["run_all"]


def run_all(
    engine: Engine, tasks: Sequence[Task], *, retries: int = 3, say: Callable[[str], None] = lambda text: None
) -> Iterator[tuple[int, Value | Failure]]:
    """Run tasks on an engine; yield the outcomes in the order in which they end, and close the engine.

    A task that raises is not retried: it would raise again. One whose worker died goes to the end of the queue, so that
    a task that kills its workers does not delay the others.

    Args:
        engine: where to run; closed at the end, also if the caller stops iterating or is interrupted.
        tasks: what to run.
        retries: how many dead workers of one task are replaced.
        say: receives a line about every worker that is replaced.

    Yields:
        The index of a task, and its outcome.
    """
    queue = deque(range(len(tasks)))
    running = 0
    deaths: Counter[int] = Counter()
    try:
        while queue or running:
            while queue and running < engine.jobs:
                number = queue.popleft()
                engine.start(number, tasks[number])
                running += 1
            for number, answer in engine.wait():
                running -= 1
                if not isinstance(answer, Death):
                    yield number, answer
                elif deaths[number] < retries:
                    deaths[number] += 1
                    say(f"{tasks[number].label}: {answer.reason}; again with another ({deaths[number]} of {retries})")
                    queue.append(number)
                else:
                    times = f" ({retries + 1} workers died)" if retries else ""
                    yield number, Failure(f"{answer.reason}{times}", "")
    finally:
        engine.close()
