"""Point clouds in PLY files, as COLMAP, MeshLab and the INRIA code write them: positions and 8-bit colours."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import torch

from reference_trainer.scenes.scene import PointCloud

__all__ = ["ply_points"]

_HEADER_LIMIT = 65_536  # bytes; a header of a point cloud has a few hundred
_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def ply_points(path: str | Path) -> PointCloud:
    """Read the vertices of a PLY file.

    Args:
        path: a PLY file, binary little-endian or ASCII, whose first element is ``vertex`` with at least the properties
            ``x y z red green blue``, colours as bytes.

    Returns:
        The points; ``seen_by`` is None, for a PLY file does not say which images it comes from.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is truncated or not such a PLY file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no point cloud {path}.")
    with path.open("rb") as file:
        start = file.read(_HEADER_LIMIT)
        end = _END.search(start)
        file.seek(end.end() if end else 0)
        header, body = (start[: end.start()], file.read()) if end else (b"", b"")
    words = [line.split() for line in header.decode("ascii", errors="replace").splitlines() if line.strip()]
    try:
        if not end or words[0] != ["ply"]:
            raise ValueError("it has no PLY header")
        form = next(line[1] for line in words if line[0] == "format")
        elements = [at for at, line in enumerate(words) if line[0] == "element"]
        if words[elements[0]][1] != "vertex":
            raise ValueError(f"its first element is {words[elements[0]][1]}, not vertex")
        count = int(words[elements[0]][2])
        rows = words[elements[0] + 1 : elements[1] if len(elements) > 1 else None]
        strange = [line[0] for line in rows if line[0] not in ("property", "comment", "obj_info")]
        if strange:
            raise ValueError(f"its header has lines of an unknown kind, {strange[:3]}")
        dtype = np.dtype([(line[2], "<" + _TYPES[line[1]]) for line in rows if line[0] == "property"])
        missing = {"x", "y", "z", "red", "green", "blue"} - set(dtype.names or ())
        if missing or dtype["red"] != np.uint8:
            raise ValueError(f"its vertices need x, y, z and red, green, blue as bytes, but have {dtype}")
        vertices = _vertices(body, form, dtype, count, alone=len(elements) == 1)
    except (ValueError, IndexError, KeyError, StopIteration, OverflowError, TypeError) as error:
        raise ValueError(f"{path} is not a point cloud this program can read: {error}.") from error
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        positions = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float32)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1).astype(np.float32) / 255
    if len(vertices) == 0 or not np.isfinite(positions).all():
        raise ValueError(f"{path} must hold points with finite positions; it has {len(vertices)} points.")
    return PointCloud(torch.from_numpy(positions), torch.from_numpy(colors), source=str(path))


def _vertices(body: bytes, form: str, dtype: np.dtype[np.void], count: int, *, alone: bool) -> np.ndarray:
    """Read the vertex records that follow the header; where nothing else does, there must be no more of them."""
    if form == "binary_little_endian":
        if count < 0 or count * dtype.itemsize > len(body):
            raise ValueError(f"{count} vertices of {dtype.itemsize} bytes do not fit in {len(body)} bytes")
        if alone and (count + 1) * dtype.itemsize <= len(body):
            raise ValueError(f"it announces {count} vertices of {dtype.itemsize} bytes but has {len(body)} bytes")
        return np.frombuffer(body, dtype, count)
    if form == "ascii":
        names = dtype.names or ()
        if count < 0 or 2 * count * len(names) > len(body) + 1:  # a digit and a separator at least
            raise ValueError(f"it announces {count} vertices but has {len(body)} bytes")
        vertices, text, line = np.empty(count, dtype), io.BytesIO(body), b"\n"
        for row in range(count):
            line = text.readline()
            words = line.decode("ascii").split()
            if len(words) != len(names):
                raise ValueError(f"the line of vertex {row} has {len(words)} numbers instead of {len(names)}")
            vertices[row] = tuple(words)
        if not line.endswith(b"\n"):
            raise ValueError("its last line has no end: it is cut short")
        if alone and text.read().strip():
            raise ValueError(f"it announces {count} vertices but has more")
        return vertices
    raise ValueError(f"its format is {form}; convert it to binary_little_endian or ascii")
