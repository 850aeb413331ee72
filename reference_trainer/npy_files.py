"""Reading untrusted ``.npy`` and ``.npz`` files."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

__all__ = ["read_npy", "read_npz"]


def read_npy(data: bytes, name: str | Path, *, strict: bool = True) -> NDArray[Any]:
    """Read an array from the content of an ``.npy`` file, which errors call ``name``; floats become float64.

    The announced size is compared with the data before anything is allocated. (Reading from a file would allocate
    whatever its header announces.) Raises ValueError if the data is damaged or holds anything but real numbers or text;
    if ``strict``, anything but finite floats of 4 or 8 bytes.
    """
    file = io.BytesIO(data)
    try:
        version = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, columns_first, dtype = read_header(file)
    except Exception as error:  # numpy evaluates the header as Python literals, with as many kinds of errors
        raise ValueError(f"{name} is not a NumPy array of numbers: {error}") from error
    body = file.read()
    if not strict and dtype.kind not in "fiuU":
        raise ValueError(f"{name} must hold numbers or text, got shape {shape} of {dtype}.")
    if strict and (dtype.kind != "f" or dtype.itemsize not in (4, 8)):
        raise ValueError(f"{name} must hold floats of 4 or 8 bytes, got shape {shape} of {dtype}.")
    if min(shape, default=0) < 0 or len(body) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{name} is damaged: shape {shape} of {dtype} does not make {len(body)} bytes.")
    with np.errstate(over="ignore"):  # becomes infinite, which is reported
        array = np.frombuffer(body, dtype).reshape(shape, order="F" if columns_first else "C")
        array = array.astype(np.float64) if dtype.kind == "f" else array
    if strict and not np.isfinite(array).all():
        raise ValueError(f"{name} must hold finite numbers; some of its {array.size} are not.")
    return array


def read_npz(path: Path, *, largest: int = 10_000, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays of an ``.npz`` file by name, each of at most ``largest`` bytes.

    With ``names``, only these arrays are read, and they may hold any real numbers or text.

    Raises:
        ValueError: if the file is not an ``.npz`` or is damaged, or an array is too large or not what `read_npy` takes.
        OSError: if the file cannot be read.
    """
    members: dict[str, bytes] = {}
    content = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in archive.infolist():
                if names is not None and member.filename.removesuffix(".npy") not in names:
                    continue
                with archive.open(member) as file:
                    members[member.filename.removesuffix(".npy")] = data = file.read(largest + 1)
                if len(data) > largest:
                    raise ValueError(f"{member.filename} has more than {largest} bytes")
    except Exception as error:  # of the archive or of its compression, each with errors of its own
        raise ValueError(f"{path} is not an .npz file of small arrays: {error}.") from error
    return {name: read_npy(data, f"{path}: {name}", strict=names is None) for name, data in members.items()}
