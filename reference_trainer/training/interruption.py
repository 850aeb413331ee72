"""Ctrl-C between steps, never in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["TrainingInterrupted", "hold_interrupts"]


class TrainingInterrupted(KeyboardInterrupt):
    """Ctrl-C between two steps: the model is whole and can be saved."""


@contextmanager
def hold_interrupts() -> Iterator[Callable[[], bool]]:
    """Hold back Ctrl-C (SIGINT) and remember it; a second one interrupts at once.

    A model that is interrupted while its tensors are being changed is broken and must not be saved. Inside this block
    the caller decides when to stop. Outside the main thread, where signals do not arrive, nothing is done.

    Yields:
        A function that tells whether an interruption is waiting.

    Example:
        >>> with hold_interrupts() as interrupted:
        ...     interrupted()
        False
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    waiting = False

    def remember(number: int, frame: FrameType | None) -> None:
        nonlocal waiting
        if waiting:
            raise KeyboardInterrupt
        waiting = True

    before = signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: waiting
    finally:
        signal.signal(signal.SIGINT, before)
