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

ENGINES = ("auto", "torch", "numba", "triton")
_RENAMED = {"loops": "numba"}
_VARIABLE = "CA_REG_ENGINE"
_TORCH = TorchEngine()


def use_engine(name: str) -> None:
    """Choose the engine of this process and, by ``CA_REG_ENGINE``, of those that it starts.

    Args:
        name: ``torch``, ``numba``, ``triton``, or ``auto``, the default: for float32, numba on a CPU
            and triton on a card, where they are installed; Triton comes with torch there.

    Raises:
        ValueError: if there is no such engine.
        ImportError: if numba or triton is asked for and missing.

    Example:
        >>> use_engine("torch")
        >>> describe_engine("cpu")
        'torch'
        >>> use_engine("auto")
    """
    _check_name(name, "there is no engine {name!r}")
    if name == "numba" and _numba_engine() is None:
        raise ImportError("the engine numba needs numba: pip install 'ca_reg[trainer]', or use the engine torch.")
    if name == "triton" and _triton_engine() is None:
        raise ImportError("the engine triton needs Triton: pip install triton (Linux), or use the engine torch.")
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
    """Return the engine for a device and dtype; errors are those of `chosen_engine`.

    On a CPU, Triton renders only if chosen and interpreted (``TRITON_INTERPRET=1``).
    """
    # Loops are compiled for float32 on a CPU, kernels for float32 on a card; whoever asks for
    # anything else gets it, by the other engine.
    chosen = chosen_engine()
    if chosen == "torch" or dtype != torch.float32:
        return _TORCH
    if _runs_triton(device, chosen):
        return _triton_engine() or _TORCH
    return (_numba_engine() if device.type == "cpu" else None) or _TORCH


def engines_on(device: torch.device) -> tuple[str, ...]:
    """Return the engines that render float32 on a device; "numba" only on a CPU, "triton" on a card."""
    if _runs_triton(device, "auto") and _triton_engine() is not None:
        return ("triton", "torch")
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
    name = engine_for(torch.device(device)).name
    if name == "torch":
        return name
    if name == "triton":
        return f"triton ({version('triton')}{', interpreted' if torch.device(device).type == 'cpu' else ''})"
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


def _runs_triton(device: torch.device, chosen: str) -> bool:
    """Return whether Triton is to render on a device; of NVIDIA's cards those since Turing, which it supports."""
    if device.type == "cpu":
        return chosen == "triton" and os.environ.get("TRITON_INTERPRET") == "1"
    if device.type != "cuda" or chosen == "numba":
        return False
    known = torch.cuda.is_available() and torch.version.hip is None
    return not known or torch.cuda.get_device_capability(device) >= (7, 5)


@functools.cache
def _triton_engine() -> Engine | None:
    """Return the engine of Triton kernels, or None if Triton is missing or does not work."""
    if importlib.util.find_spec("triton") is None:
        return None
    try:
        from reference_trainer.render.triton.engine import TritonEngine
    except ImportError as error:
        warnings.warn(f"triton is installed but cannot be imported ({error}): the engine torch renders.", stacklevel=2)
        return None
    return TritonEngine()
