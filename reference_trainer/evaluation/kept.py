"""Finished parts of a long measurement, kept in a file so that it can continue where it was interrupted."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from reference_trainer.files import write_text
from reference_trainer.json_files import read_json

__all__ = ["PARTIAL", "KeptRecords", "fingerprint"]

PARTIAL = "evaluation.partial.json"
"""Name of the file in the folder of an evaluation."""


class KeptRecords:
    """What was measured so far, by key; every record is on disk before the next one is measured.

    Records made under another ``depends_on``, or in a damaged file, are deleted: the measurement starts anew, and says
    so. The caller removes the file once the final result is written.

    Args:
        file: where to keep them; None keeps nothing.
        depends_on: everything the records depend on, see `fingerprint`.
        say: receives what became of existing records.

    Raises:
        OSError: if the file exists and cannot be read or removed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder, "scores.partial.json")
        ...     KeptRecords(file, {"seed": 1}, print).add("view 0", {"psnr": 20.5})
        ...     KeptRecords(file, {"seed": 1}, print).get("view 0")
        1 measured before, kept: ...scores.partial.json
        {'psnr': 20.5}
    """

    def __init__(self, file: Path | None, depends_on: object, say: Callable[[str], None]) -> None:
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
                say(f"{len(records)} measured before, kept: {file}")
                return
            reason = "they belong to another model, scene, setting or machine"
        # Immediately, or a picture of the new measurement could be taken for that of an old record.
        file.unlink()
        say(f"records of an interrupted measurement in {file} are not used, {reason}: everything is measured anew")

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
