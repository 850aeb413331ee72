"""Results as data: JSON files, a store of what is measured so far, and a description of the machine."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import ca_reg
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.render import describe_engine

__all__ = ["PARTIAL", "ResultStore", "fingerprint", "machine", "write_json"]

PARTIAL = "evaluation.partial.json"
"""Name of the `ResultStore` in the folder of an evaluation."""

_log = logging.getLogger(__name__)


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


def machine(device: torch.device | str | None = None) -> dict[str, str | int]:
    """Return what a measurement on a device depends on: versions, processor, cores, threads, the device, its engine.

    Without a device, the GPU stands for it if there is one, and the engine is that of the processor.

    Example:
        >>> sorted(machine())
        ['ca_reg', 'cores', 'cpu', 'device', 'engine', 'kornia', 'platform', 'python', 'threads', 'torch']
    """
    kind = "cuda" if device is None and torch.cuda.is_available() else torch.device(device or "cpu").type
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "torch": str(torch.__version__),  # with its build, such as +cpu, which the package metadata may lack
        "kornia": version("kornia"),
        "ca_reg": ca_reg.__version__,
        "cpu": _cpu_name(),
        "cores": os.cpu_count() or 0,
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if kind == "cuda" else kind,
        "engine": describe_engine(device or "cpu"),
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


def _cpu_name() -> str:
    """Return the processor's name; on Linux only /proc has it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


class ResultStore:
    """What was measured so far, by key; every record is on disk before the next one is measured.

    Records made under another ``depends_on``, or in a damaged file, are deleted: the measurement starts anew, and says
    so. The caller removes the file once the final result is written.

    Args:
        file: where to keep them; None keeps nothing.
        depends_on: everything the records depend on, see `fingerprint`.

    Raises:
        OSError: if the file exists and cannot be read or removed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder, "scores.partial.json")
        ...     ResultStore(file, {"seed": 1}).add("view 0", {"psnr": 20.5})
        ...     ResultStore(file, {"seed": 1}).get("view 0")
        {'psnr': 20.5}
    """

    def __init__(self, file: Path | None, depends_on: object) -> None:
        self._file = file
        self._records: dict[str, dict[str, Any]] = {}
        self._depends_on = "" if file is None else fingerprint(depends_on)
        if file is None or not file.exists():
            return
        try:
            content = read_json(file)
            depends_on, digest, records = content["depends_on"], content["digest"], content["records"]
            if _digest(records) != digest:
                raise ValueError("its digest is another one")
        except (ValueError, TypeError, KeyError):
            reason = "it is damaged"
        else:
            if depends_on == self._depends_on:
                self._records = records
                _log.info("%d measured before, kept: %s", len(records), file)
                return
            reason = "they belong to another model, scene, setting or machine"
        # Immediately, or a picture of the new measurement could be taken for that of an old record.
        file.unlink()
        _log.info(
            "records of an interrupted measurement in %s are not used, %s: everything is measured anew", file, reason
        )

    def get(self, key: str, files: Iterable[Path] = ()) -> dict[str, Any] | None:
        """Return a record, or None if there is none or one of the files written with it is gone."""
        record = self._records.get(key)
        return record if record is not None and all(file.is_file() for file in files) else None

    def add(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep a record of strings and numbers, including nan and infinity.

        Raises:
            OSError: if it cannot be written; earlier records are kept.
        """
        if self._file is None:
            return
        self._records[key] = dict(record)
        content = {"depends_on": self._depends_on, "digest": _digest(self._records), "records": self._records}
        write_text(self._file, json.dumps(content, indent=1) + "\n")  # nan stays nan: this file is read by Python alone


def fingerprint(x: object) -> str:
    """Return a digest of tensors, numbers, strings and None, nested in dataclasses, mappings, lists and tuples.

    Equal values give equal digests in every process; a tensor's device counts, because results depend on it.
    Raises TypeError for anything else.

    Example:
        >>> fingerprint([torch.zeros(2), 3]) == fingerprint([torch.zeros(2), 3]) != fingerprint([torch.zeros(2), 4])
        True
    """
    digest = hashlib.sha256()
    for part in _parts(x):
        digest.update(part)
    return digest.hexdigest()


def _digest(records: object) -> str:
    """Return a digest of records as JSON, the same before writing and after reading."""
    return fingerprint(json.dumps(records))


def _parts(x: object) -> Iterator[Any]:
    """Yield buffers that encode a value unambiguously: a sequence is preceded by its length."""
    if isinstance(x, Tensor):
        yield f"{x.dtype} {tuple(x.shape)} {x.device};".encode()
        yield x.detach().cpu().reshape(-1).contiguous().view(torch.uint8).numpy()
    elif dataclasses.is_dataclass(x) and not isinstance(x, type):
        yield f"{type(x).__name__} ".encode()
        yield from _parts({field.name: getattr(x, field.name) for field in dataclasses.fields(x)})
    elif isinstance(x, Mapping):
        yield from _parts([part for item in x.items() for part in item])
    elif isinstance(x, list | tuple):
        yield f"[{len(x)};".encode()
        for part in x:
            yield from _parts(part)
    elif x is None or isinstance(x, str | int | float):
        yield f"{x!r};".encode()
    else:
        raise TypeError(f"a fingerprint is made of tensors, numbers, strings and None, got {type(x).__name__}.")
