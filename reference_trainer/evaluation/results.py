"""Results as data: JSON files, Markdown tables, means with their spread, and a description of the machine."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import torch

import ca_reg
from reference_trainer.files import write_text
from reference_trainer.render import describe_engine

__all__ = ["format_mean_std", "machine", "markdown_table", "mean_std", "write_json"]

_ABSENT = "n/a"
_FIGURE = re.compile(r"[-+]?\d|-?$")  # also a dash or nothing in its place


def write_json(path: str | Path, data: object) -> None:
    """Write nested plain data as indented JSON, atomically; missing folders are made.

    NaN and infinities become null, because JSON cannot represent them. Raises TypeError for anything but plain data,
    including keys that are no strings, and OSError if the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_json(f"{folder}/a/result.json", {"ca": math.nan, "views": (1, 2)})
        ...     json.loads(Path(f"{folder}/a/result.json").read_text())
        {'ca': None, 'views': [1, 2]}
    """
    text = json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    write_text(path, text)


def mean_std(values: Iterable[float]) -> tuple[float, float]:
    """Return mean and sample standard deviation (n - 1) of the finite values; nan if there are too few.

    Example:
        >>> mean_std([1.0, 3.0, math.nan])
        (2.0, 1.4142135623730951)
    """
    finite = [float(value) for value in values if math.isfinite(value)]
    mean = statistics.fmean(finite) if finite else math.nan
    return mean, statistics.stdev(finite) if len(finite) > 1 else math.nan


def format_mean_std(values: Iterable[float], *, unit: float = 1.0) -> str:
    """Return mean and standard deviation as text: two digits of the deviation, the mean to the same place.

    Values that are not finite are left out, and the text says how many remain; a mean without a deviation has four
    digits, and no value at all gives ``"n/a"``. Values are in units of ``unit``: with 1e-3, 0.0023 is written 2.3.

    Example:
        >>> format_mean_std([20.39, 20.51, 20.63])
        '20.51 ± 0.12'
        >>> format_mean_std([0.00221, 0.00231, 0.00241], unit=1e-3)
        '2.31 ± 0.10'
        >>> format_mean_std([20.39, 20.63, math.nan])
        '20.51 ± 0.17 (2 of 3)'
    """
    if not unit > 0:
        raise ValueError(f"unit must be positive, got {unit}.")
    scaled = [value / unit for value in values]
    mean, std = mean_std(scaled)
    count = sum(map(math.isfinite, scaled))
    note = f" ({count} of {len(scaled)})" if 0 < count < len(scaled) else ""
    if not count:
        return _ABSENT
    if not std > 0:
        return f"{_number(mean)}{' ± 0' if std == 0 else ''}{note}"
    # Round first: a deviation of 0.0999 becomes 0.10, with one decimal less.
    decimals = max(0, 1 - math.floor(math.log10(float(f"{std:.1e}"))))
    return f"{mean:.{decimals}f} ± {std:.{decimals}f}{note}"


def markdown_table(rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> str:
    """Return rows, mappings from column to content, as a Markdown table that ends with a line break.

    Text is kept, floats get four digits; what is missing, None or not finite becomes ``n/a``. The columns, at least
    one, are also the headers. Columns of words are left-aligned, as is the first; columns of figures right-aligned.

    Example:
        >>> print(markdown_table([{"run": "baseline", "PSNR": 19.36}, {"run": "dropout"}], ["run", "PSNR"]), end="")
        | run | PSNR |
        |:---|---:|
        | baseline | 19.36 |
        | dropout | n/a |
    """
    if not columns:
        raise ValueError("a table needs at least one column.")
    lines = [[_cell(row.get(column)) for column in columns] for row in rows]
    words = {place for line in lines for place, cell in enumerate(line) if cell != _ABSENT and not _FIGURE.match(cell)}
    rule = [":---" if place in {0, *words} else "---:" for place in range(len(columns))]
    text = [f"| {' | '.join(line)} |" for line in [[_cell(column) for column in columns], *lines]]
    return "\n".join([text[0], f"|{'|'.join(rule)}|", *text[1:], ""])


def machine() -> dict[str, str | int]:
    """Return what a measurement depends on: versions, processor, cores, threads, engine, and the GPU if there is one.

    Example:
        >>> sorted(machine())
        ['ca_reg', 'cores', 'cpu', 'device', 'engine', 'kornia', 'platform', 'python', 'threads', 'torch']
    """
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "torch": str(torch.__version__),  # with its build, such as +cpu, which the package metadata may lack
        "kornia": version("kornia"),
        "ca_reg": ca_reg.__version__,
        "cpu": _cpu_name(),
        "cores": os.cpu_count() or 0,
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        "engine": describe_engine("cpu"),
    }


def _plain(data: object) -> object:
    """Replace numbers that JSON cannot hold, and tuples by lists."""
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, Mapping):
        # json.dumps would silently turn the key 1 into "1" and None into "null".
        if wrong := [key for key in data if not isinstance(key, str)]:
            raise TypeError(f"keys must be strings, got {wrong[0]!r}.")
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_plain(value) for value in data]
    return data


def _cell(value: object) -> str:
    """Return one table cell; a bar or a line break inside would split it."""
    text = _number(value) if isinstance(value, float) else _ABSENT if value is None else str(value)
    return " ".join(text.split()).replace("|", "\\|")


def _number(value: float) -> str:
    """Return a number with four significant digits, but with all digits before the decimal point."""
    if not math.isfinite(value):
        return _ABSENT
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _cpu_name() -> str:
    """Return the processor's name; on Linux only /proc has it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
