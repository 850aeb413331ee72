"""What the trainer says: the messages of its log, which the command line prints."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["hearing"]


@contextmanager
def hearing() -> Iterator[list[str]]:
    """Yield a list that receives every message while the context lasts."""
    messages: list[str] = []
    handler, log = logging.Handler(), logging.getLogger("reference_trainer")
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    yield messages
    log.removeHandler(handler)
    log.setLevel(level)
