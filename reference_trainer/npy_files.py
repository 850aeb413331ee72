"""Arrays of floats in NumPy's files, which somebody else may have written."""

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

    Its announced size is compared with the data before anything is allocated for it. (Reading from a file would
    allocate whatever length its header has.) Raises ValueError if it is damaged, holds Python objects, or, if it is to
    be ``strict``, anything but finite floats.
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
    """Read all arrays of an ``.npz`` file by name; each may have so many bytes.

    Of several, those with certain names may be asked for; these may hold numbers of any kind, or text.

    Raises:
        ValueError: if it is none, is damaged, or an array is larger or not one of finite floats.
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
