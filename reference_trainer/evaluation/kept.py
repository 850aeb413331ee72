"""Finished parts of a long measurement, kept in a file so that it continues where it was interrupted."""

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
"""What the file is called in the folder of an evaluation."""


class KeptRecords:
    """What was measured so far, by key; every record is on the disk before the next one is measured.

    Records that were made under anything else than ``depends_on``, and those of a damaged file, are not used: the
    measurement starts anew, and says so. Whoever has written the final result removes the file.

    Args:
        file: where to keep them; None keeps nothing.
        depends_on: all that decides the records, see `fingerprint`.
        say: receives what became of the records that were there.

    Raises:
        OSError: if the file is there and cannot be read.

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
        # At once: the first picture of the new measurement must not be found beside an old record.
        file.unlink()
        say(f"records of an interrupted measurement in {file} are not used, {reason}: everything is measured anew")

    def get(self, key: str, files: Iterable[Path] = ()) -> dict[str, Any] | None:
        """Return a record, or None if there is none, or one of the files that were written with it is gone."""
        record = self._records.get(key)
        return record if record is not None and all(file.is_file() for file in files) else None

    def add(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep a record of strings and numbers, nan and infinity among them.

        Raises:
            OSError: if it cannot be written; the records before it are kept.
        """
        if self._file is None:
            return
        self._records[key] = dict(record)
        content = {"depends_on": self._depends_on, "digest": _digest(self._records), "records": self._records}
        write_text(self._file, json.dumps(content, indent=1) + "\n")  # nan stays nan: this file is read by Python alone


def fingerprint(x: object) -> str:
    """Return a digest of tensors, numbers, strings and None, nested in dataclasses, mappings, lists and tuples.

    Equal values give equal digests in every process; the device of a tensor counts, because results depend on it.
    Raises TypeError if there is anything else.

    Example:
        >>> fingerprint([torch.zeros(2), 3]) == fingerprint([torch.zeros(2), 3]) != fingerprint([torch.zeros(2), 4])
        True
    """
    digest = hashlib.sha256()
    for part in _parts(x):
        digest.update(part)
    return digest.hexdigest()


def _digest(records: object) -> str:
    """Return a digest of what JSON makes of records, the same before it is written and after it is read."""
    return fingerprint(json.dumps(records))


def _parts(x: object) -> Iterator[Any]:
    """Iterate over buffers that tell values apart: what has parts says their number first."""
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
