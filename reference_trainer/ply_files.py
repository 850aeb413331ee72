"""Reading the vertices of PLY files, be they colored points or Gaussians."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["CONVERT", "PlyVertices", "read_ply"]

CONVERT = "its values are rounded; give the PLY that it was made from, or convert it to one first (SuperSplat does)"
_HEADER_LIMIT = 65_536  # bytes; a standard header has 1.6 kB, so more than this is not a header
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_OTHER_LINES = ("ply", "format", "obj_info", "end_header")  # of a header, besides those that are read


@dataclass(frozen=True)
class PlyVertices:
    """The vertices of a PLY file."""

    rows: NDArray[np.void]  # one record per vertex, with a field per property
    kinds: dict[str, str]  # the numpy types that the file declares, such as ``u1``; ASCII rows hold float64 regardless
    comments: list[str]  # of the header

    def columns(self, names: Sequence[str]) -> Tensor:
        """Return properties as columns, shape (N, len(names)), float32; values beyond its range become infinite."""
        table = np.empty((len(self.rows), len(names)), dtype=np.float32)
        with np.errstate(over="ignore"):
            for index, name in enumerate(names):
                table[:, index] = self.rows[name]
        return torch.from_numpy(table)


def read_ply(path: Path) -> PlyVertices:
    """Read the vertices, which must be the file's first element; binary of either byte order or ASCII.

    Raises ValueError if the file is not such a PLY, is compressed, or is shorter or longer than its header says;
    OSError if the file cannot be read.
    """
    with path.open("rb") as file:
        header = _read_header(file, path)
        return PlyVertices(_read_rows(file, path, header), header.properties, header.comments)


@dataclass(frozen=True)
class _Header:
    """What a header declares; ``alone`` if the vertices are its only element."""

    layout: str
    count: int
    properties: dict[str, str]
    comments: list[str]
    alone: bool


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Read everything up to the first vertex."""
    lines: list[str] = []
    while not lines or lines[-1] != "end_header":
        raw = file.readline(_HEADER_LIMIT)
        if file.tell() > _HEADER_LIMIT or not raw.endswith(b"\n") or (not lines and raw.strip() != b"ply"):
            raise ValueError(
                f"{path} is not a PLY file: expected a header from 'ply' to 'end_header' in the first "
                f"{_HEADER_LIMIT} bytes."
            )
        lines.append(raw.decode("latin-1").strip())
    layout, count, properties, elements, comments = "", -1, dict[str, str](), list[str](), list[str]()
    for line in lines:
        match line.split():
            case ["format", kind, "1.0"]:
                layout = kind
            case ["comment", *_]:
                comments.append(line.removeprefix("comment").strip())
            case ["element", name, number]:
                elements.append(name)
                if name == "vertex" and number.isdecimal() and len(number) < 19:
                    count = int(number)
            case ["property", kind, name] if elements[-1:] == ["vertex"]:
                if kind not in _TYPES or name in properties:
                    raise ValueError(f"{path}: the property line '{line}' has an unknown type or a repeated name.")
                properties[name] = _TYPES[kind]
            case ["property", "list", *_] if elements[-1:] == ["vertex"]:
                raise ValueError(f"{path}: vertices with list properties ('{line}') are not supported.")
            case ["property", *_] if elements[-1:] != ["vertex"]:
                pass
            case [keyword, *_] if keyword not in _OTHER_LINES:
                raise ValueError(f"{path}: the header line '{line[:80]}' is not one of a PLY file.")
    if "chunk" in elements:
        raise ValueError(f"{path} is a compressed PLY: {CONVERT}.")
    if layout not in (*_BYTE_ORDERS, "ascii"):
        raise ValueError(f"{path}: the format must be {', '.join(_BYTE_ORDERS)} or ascii (1.0), got '{layout}'.")
    if elements[:1] != ["vertex"] or "vertex" in elements[1:] or count < 0:
        raise ValueError(f"{path}: the first element must be 'vertex' with a count, got {elements[:8] or 'none'}.")
    if not properties:
        raise ValueError(f"{path}: the vertices must have properties such as 'property float x', got none.")
    return _Header(layout, count, properties, comments, alone=len(elements) == 1)


def _read_rows(file: BinaryIO, path: Path, header: _Header) -> NDArray[np.void]:
    """Read the vertices as a structured array; the file's size is checked first, so a false count costs nothing."""
    layout, count, properties = header.layout, header.count, header.properties
    available = os.fstat(file.fileno()).st_size - file.tell()
    binary = layout != "ascii"
    kinds = {name: _BYTE_ORDERS[layout] + kind if binary else "f8" for name, kind in properties.items()}
    dtype = np.dtype(list(kinds.items()))
    needed = count * (dtype.itemsize if binary else 2 * len(properties))  # a digit and a separator at least
    if needed > available + (not binary):
        raise ValueError(
            f"{path} is cut short: {count} vertices need {needed} bytes after the header, {available} are there."
        )
    if binary:
        if header.alone and available >= needed + dtype.itemsize:
            raise ValueError(f"{path} announces {count} vertices, {needed} bytes, but {available} follow the header.")
        return np.frombuffer(file.read(needed), dtype=dtype, count=count)
    table, line = np.empty((count, len(properties))), b"\n"
    try:
        for row in table:
            line = file.readline()
            words = line.split()
            if len(words) != len(row):
                raise ValueError(f"got {len(words)}")
            row[:] = np.array(words, np.float64)
        if not line.endswith(b"\n"):
            raise ValueError("the last line has no end")
    except ValueError as error:
        raise ValueError(f"{path}: the vertex lines do not hold {len(properties)} numbers each: {error}.") from error
    if header.alone and file.read().strip():
        raise ValueError(f"{path} announces {count} vertices, but more lines follow them.")
    return table.view(dtype)[:, 0]
