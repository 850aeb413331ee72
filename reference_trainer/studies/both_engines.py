"""Both engines of the renderer, one after the other."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from reference_trainer.render import use_engine

__all__ = ["drawn_by", "engines_on"]

_VARIABLE = "CA_REG_ENGINE"


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that draw float32 on a device: "loops" only on a CPU, and where numba is installed."""
    has_loops = device.type == "cpu" and importlib.util.find_spec("numba") is not None
    return ("loops", "torch") if has_loops else ("torch",)


@contextmanager
def drawn_by(engine: str) -> Iterator[None]:
    """Let an engine draw, and afterwards the one that was chosen before.

    Raises:
        ValueError, ImportError: as `use_engine`.

    Example:
        >>> from reference_trainer.render import describe_engine
        >>> with drawn_by("torch"):
        ...     describe_engine("cpu")
        'torch'
    """
    before = os.environ.get(_VARIABLE)
    use_engine(engine)
    try:
        yield
    finally:
        del os.environ[_VARIABLE]
        if before is not None:
            os.environ[_VARIABLE] = before
