"""Read a monitor's log, which holds one measurement per line, in JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["read_log"]


def read_log(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Iterate over the measurements of a log, each with its raw line.

    An unterminated last line is skipped if it does not parse: a running or killed process has not finished it.

    Raises:
        ValueError: if another line is not a measurement; the message names file and line.
    """
    *whole, rest = path.read_bytes().split(b"\n")
    for number, line in enumerate(whole, start=1):
        try:
            yield line.decode(), _measurement(line)
        except ValueError as error:
            raise ValueError(
                f"{path}, line {number}, is no measurement of a CAMonitor: {error}; remove that line to go on."
            ) from error
    try:
        record = _measurement(rest)
    except ValueError:
        return
    yield rest.decode(), record


def _measurement(line: bytes) -> dict[str, Any]:
    """Parse a line: numbers, strings or null by name, including an integer ``step``."""
    try:
        record = json.loads(line.decode())
    except RecursionError as error:
        raise ValueError(str(error)) from error
    if not isinstance(record, dict) or not isinstance(record.get("step"), int):
        raise ValueError("expected an object with a whole number 'step'")
    for name, x in record.items():
        if not isinstance(x, int | float | str | None) or (isinstance(x, int) and x.bit_length() > 64):
            raise ValueError(f"{name!r} must be a number, text or null")
    return record
