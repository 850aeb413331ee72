"""Feeds damaged files to a reader and says what it did wrong."""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
import time
import tracemalloc
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzz.mutations import CUT, FOREIGN, Form, damage

__all__ = ["Outcome", "Target", "fuzz", "leaves"]

SECONDS = 1.0  # of the processor: the machine may be busy
OTHER_PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.startfile")


@dataclass(frozen=True)
class Target:
    """A reader, and a good file for it.

    Args:
        name: of the reader and the format.
        file: the file that is damaged, within the folder.
        write: writes the good file and whatever else the reader needs into a folder.
        read: reads it.
        form: which kinds of damage make sense.
        checksummed: the format has checksums, so that whatever is accepted must be what was written.
        finite: whether everything that was read must be finite.
        grows: the file is written line by line, so that a part of it is a good file.
        expansion: bytes of memory that are fine for every byte of the file.
        memory: and besides those.
        check: raises AssertionError if shapes do not fit together.
    """

    name: str
    file: str
    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    form: Form
    checksummed: bool = False
    finite: bool = True
    grows: bool = False
    expansion: int = 10
    memory: int = 4_000_000
    check: Callable[[Any], None] = lambda result: None


@dataclass
class Outcome:
    """What a reader did with damaged files: counts, and one line for each thing that it did wrong."""

    inputs: int = 0
    refused: int = 0
    read: int = 0
    slowest: float = 0.0
    peak: int = 0
    defects: list[tuple[int, str]] = field(default_factory=list)

    def kinds(self) -> Counter[str]:
        """Count the defects by what they say."""
        return Counter(text for _, text in self.defects)


def fuzz(target: Target, folder: Path, seeds: range) -> Outcome:
    """Damage the file once for each seed, read it, and compare with what a reader owes its caller.

    It must return something complete or raise ValueError or OSError with the path, within a second, with memory
    proportional to the file's size, and without another program.
    """
    folder.mkdir(parents=True, exist_ok=True)
    target.write(folder)
    path = folder / target.file
    good = path.read_bytes()
    expected = list(leaves(target.read(folder)))  # also loads what is imported at the first use
    outcome = Outcome()
    for seed in seeds:
        kind, damaged = damage(good, target.form, seed)
        path.write_bytes(damaged)
        for text in _one(target, folder, kind, len(damaged), expected, outcome):
            outcome.defects.append((seed, f"{kind}: {text}"))
    return outcome


def _one(target: Target, folder: Path, kind: str, size: int, expected: list[Any], outcome: Outcome) -> Iterator[str]:
    """Read one damaged file and yield what is wrong about it."""
    programs = _programs_started()
    programs.clear()
    result, error = None, None
    start = time.process_time()
    tracemalloc.start()  # for the reading alone: it makes all else slower, too
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # as in use; the tests' settings make errors of them
            result = target.read(folder)
    except BaseException as raised:
        error = raised
    finally:
        seconds, peak = time.process_time() - start, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    outcome.inputs += 1
    outcome.slowest, outcome.peak = max(outcome.slowest, seconds), max(outcome.peak, peak)
    if seconds > SECONDS:
        yield f"took {seconds:.0f} s"
    if peak > target.expansion * size + target.memory:
        yield f"took more than {target.expansion} x its size in memory"
    if programs:
        yield f"started another program ({programs[0]})"
    if error is not None:
        outcome.refused += 1
        if not isinstance(error, ValueError | OSError):
            yield f"{type(error).__name__}"
        elif str(folder) not in str(error):
            yield f"{type(error).__name__} without the path"
        return
    outcome.read += 1
    if kind == FOREIGN:
        yield "accepted a file of another format"
    found = list(leaves(result))
    if target.finite and not all(map(_finite, found)):
        yield "values that are not finite"
    if ((kind == CUT and not target.grows) or target.checksummed) and not _equal(found, expected):
        yield "accepted with other content"
    try:
        target.check(result)
    except AssertionError as failed:
        yield f"inconsistent: {str(failed).partition(chr(10))[0]}"


@functools.cache
def _programs_started() -> list[str]:
    """Return a list that every start of a program by this process is appended to, from the first call on."""
    started: list[str] = []
    sys.addaudithook(lambda event, arguments: started.append(event) if event in OTHER_PROGRAMS else None)
    return started


def leaves(x: Any) -> Iterator[Any]:
    """Iterate over the arrays, numbers and strings in a nested value."""
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        x = {item.name: getattr(x, item.name) for item in dataclasses.fields(x)}
    if isinstance(x, torch.Tensor):
        yield x.detach().numpy()
    elif isinstance(x, Mapping):
        for key in x:
            yield key
            yield from leaves(x[key])
    elif isinstance(x, list | tuple):
        for item in x:
            yield from leaves(item)
    else:
        yield x


def _finite(x: Any) -> bool:
    if isinstance(x, np.ndarray) and x.dtype.kind == "f":
        return bool(np.isfinite(x).all())
    return not isinstance(x, float) or math.isfinite(x)


def _equal(a: list[Any], b: list[Any]) -> bool:
    return len(a) == len(b) and all(map(_same, a, b))


def _same(x: Any, y: Any) -> bool:
    if isinstance(x, np.ndarray) and isinstance(y, np.ndarray):
        return x.dtype == y.dtype and np.array_equal(x, y, equal_nan=x.dtype.kind == "f")
    return type(x) is type(y) and bool(x == y)
