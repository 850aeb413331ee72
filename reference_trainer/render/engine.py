"""The choice of the engine that renders."""

from __future__ import annotations

import functools
import importlib.util
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from unittest.mock import patch

import torch

from reference_trainer.render.splats import Engine
from reference_trainer.render.torch.engine import TorchEngine

__all__ = [
    "ENGINES",
    "Engine",
    "chosen_engine",
    "describe_engine",
    "engine_for",
    "engines_on",
    "use_engine",
    "using_engine"
]  # fmt: skip

ENGINES = ("auto", "torch", "numba")
_RENAMED = {"loops": "numba"}
_VARIABLE = "CA_REG_ENGINE"
_TORCH = TorchEngine()


def use_engine(name: str) -> None:
    """Choose the engine of this process and, by ``CA_REG_ENGINE``, of those that it starts.

    Args:
        name: ``torch``, ``numba``, or ``auto``, the default: numba for float32 on a CPU where it is
            installed.

    Raises:
        ValueError: if there is no such engine.
        ImportError: if numba is asked for and missing.

    Example:
        >>> use_engine("torch")
        >>> describe_engine("cpu")
        'torch'
        >>> use_engine("auto")
    """
    _check_name(name, "there is no engine {name!r}")
    if name == "numba" and _numba_engine() is None:
        raise ImportError("the engine numba needs numba: pip install 'ca_reg[trainer]', or use the engine torch.")
    os.environ[_VARIABLE] = name


def chosen_engine() -> str:
    """Return the name that was chosen, to tell workers on other machines.

    Raises:
        ValueError: if the environment names an engine that does not exist.
    """
    chosen = os.environ.get(_VARIABLE, "auto")
    _check_name(chosen, f"{_VARIABLE} names the engine {{name!r}}")
    return chosen


def _check_name(name: str, complaint: str) -> None:
    """Raise a ValueError that begins with the complaint unless there is such an engine."""
    if name not in ENGINES:
        hint = f"it is called {_RENAMED[name]} now" if name in _RENAMED else f"choose one of {', '.join(ENGINES)}"
        raise ValueError(f"{complaint.format(name=name)}; {hint}.")


def engine_for(device: torch.device, dtype: torch.dtype = torch.float32) -> Engine:
    """Return the engine for a device and dtype; errors are those of `chosen_engine`."""
    # Loops are compiled for float32 on a CPU; whoever asks for anything else gets it, by the other
    # engine.
    if chosen_engine() == "torch" or device.type != "cpu" or dtype != torch.float32:
        return _TORCH
    return _numba_engine() or _TORCH


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that render float32 on a device; "numba" only on a CPU."""
    return ("numba", "torch") if device.type == "cpu" and _numba_engine() is not None else ("torch",)


@contextmanager
def using_engine(engine: str) -> Iterator[None]:
    """Render with an engine within a block; errors are those of `use_engine`.

    Example:
        >>> with using_engine("torch"):
        ...     describe_engine("cpu")
        'torch'
    """
    # The choice lives in the environment, so that processes started within the block make it too.
    with patch.dict(os.environ):
        use_engine(engine)
        yield


def describe_engine(device: torch.device | str) -> str:
    """Describe for people which engine renders on a device, which need not be present."""
    if engine_for(torch.device(device)).name == "torch":
        return "torch"
    count = torch.get_num_threads()
    return f"numba ({version('numba')}, {count} thread{'s' if count > 1 else ''})"


@functools.cache
def _numba_engine() -> Engine | None:
    """Return the engine of compiled loops, or None if numba is missing or does not work."""
    if importlib.util.find_spec("numba") is None:
        return None
    try:
        from reference_trainer.render.numba.engine import NumbaEngine
    except ImportError as error:  # such as a NumPy that is too new for it
        warnings.warn(f"numba is installed but cannot be imported ({error}): the engine torch renders.", stacklevel=2)
        return None
    return NumbaEngine()
