"""What ends a training early: an error, or Ctrl-C and SIGTERM, which wait for the end of a step."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["TrainingInterrupted", "TrainingStoppedError", "hold_interrupts"]


class TrainingStoppedError(RuntimeError):
    """Training cannot go on; the message says why and what to try."""


class TrainingInterrupted(KeyboardInterrupt):
    """A signal between two steps: the model is whole and can be saved.

    Attributes:
        signal: which one, ``SIGINT`` (Ctrl-C) or ``SIGTERM`` (clusters, ``kill``). After saving, raise SIGTERM again
            (`signal.raise_signal`), so that the process ends as the sender expects.
    """

    def __init__(self, signal: signal.Signals) -> None:
        super().__init__(signal.name)
        self.signal = signal


@contextmanager
def hold_interrupts() -> Iterator[Callable[[], None]]:
    """Hold back Ctrl-C (SIGINT) and SIGTERM and remember them; a second Ctrl-C interrupts at once.

    A model that is interrupted while its tensors are being changed is broken and must not be saved. Inside this block
    the caller decides when to stop. A second SIGTERM changes nothing: senders that cannot wait use SIGKILL. Outside the
    main thread, where signals do not arrive, this does nothing; a signal that the process ignores (as in a background
    job) stays ignored.

    Yields:
        A function that raises `TrainingInterrupted` if a signal is waiting.

    Example:
        >>> with hold_interrupts() as stop_if_interrupted:
        ...     stop_if_interrupted()
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    waiting: list[signal.Signals] = []

    def remember(number: int, frame: FrameType | None) -> None:
        if waiting and number == signal.SIGINT:
            raise KeyboardInterrupt
        waiting.append(signal.Signals(number))

    def stop() -> None:
        if waiting:
            raise TrainingInterrupted(waiting[0])

    # None: set by a library in C, which Python could not put back.
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) not in (signal.SIG_IGN, None)]
    before = {number: signal.signal(number, remember) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
