"""Reading untrusted ``torch.save`` files."""

from __future__ import annotations

import io
import pickletools
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor

__all__ = ["load_tensors", "moved"]

_STORAGES = ("Bool", "Byte", "Char", "Short", "Int", "Long", "Half", "BFloat16", "Float", "Double")
# torch's own list for weights_only also has bytearray and Tensor, which allocate any amount of memory from a few bytes.
_ALLOWED = {
    "collections OrderedDict",
    "torch._utils _rebuild_parameter",
    "torch._utils _rebuild_tensor_v2",
    *(f"torch {kind}Storage" for kind in _STORAGES),
}
_LARGEST_PICKLE = 256_000  # bytes, with the names of all views but no tensors; each may take 160 of memory
_PICKLES_OF_OLD_FILES = 5  # magic number, version, platform, content, names of the storages


def load_tensors(path: str | Path, device: torch.device | str = "cpu", *, what: str = "a file of tensors") -> Any:
    """Read tensors, numbers and strings in nested dicts and lists; no code in the file is executed.

    Stricter than ``torch.load(weights_only=True)``: checksums are verified, so that a damaged file is refused instead
    of read as other numbers, and nothing is read that would take much more memory than the file has bytes: the pickle
    must be small, and no container in it may be referenced twice. Files from before PyTorch 1.6, which have no
    checksums, are read too. Errors say ``what`` the file should have been.

    Raises:
        ValueError: if the file is damaged or holds anything else.
        OSError: if the file cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.save({"step": 3, "x": torch.zeros(2)}, f"{folder}/state.pt")
        ...     load_tensors(f"{folder}/state.pt")
        {'step': 3, 'x': tensor([0., 0.])}
    """
    path = Path(path)
    data = io.BytesIO(path.read_bytes())
    try:
        if data.getvalue().startswith(b"PK\x03\x04"):
            data = _checked_archive(data)
        else:
            _check_old_file(data)
        state = torch.load(data, map_location="cpu", weights_only=True)
        _check_content(state)
        return moved(state, device)
    except Exception as error:  # zipfile, pickletools and torch raise many types for damaged files
        reason = str(error).partition("\n")[0]  # torch goes on with advice to load the file without this safety
        raise ValueError(f"{path} is not {what} ({type(error).__name__}: {reason}).") from error


def moved(state: Any, device: torch.device | str) -> Any:
    """Return nested dicts and lists with their tensors on a device; tensors already there are not copied.

    Example:
        >>> moved({"x": [torch.zeros(2)], "step": 3}, "meta")
        {'x': [tensor(..., device='meta', size=(2,))], 'step': 3}
    """
    if isinstance(state, Tensor):
        return state.to(device)
    if isinstance(state, dict):
        return type(state)((key, moved(value, device)) for key, value in state.items())
    return [moved(value, device) for value in state] if isinstance(state, list) else state


def _checked_archive(data: io.BytesIO) -> io.BytesIO:
    """Verify the checksums and rewrite the archive, so that torch reads exactly what was checked here.

    A damaged attribute would make torch take a record for a folder, and return a tensor of uninitialized memory.
    """
    clean = io.BytesIO()
    with zipfile.ZipFile(data) as archive, zipfile.ZipFile(clean, "w") as copy:
        names = archive.namelist()
        if len(set(names)) != len(names):
            raise ValueError("two of its records have one name")
        for record in archive.infolist():
            if record.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"its record {record.filename} is compressed, which torch.save does not do")
            content = archive.read(record)
            if record.filename.endswith(".pkl"):
                _check_pickle(io.BytesIO(content))
            copy.writestr(record.filename, content)
    clean.seek(0)
    return clean


def _check_old_file(data: io.BytesIO) -> None:
    """Refuse a file of the format before PyTorch 1.6 that names forbidden objects or announces more than it holds."""
    size = len(data.getbuffer())
    for part in range(_PICKLES_OF_OLD_FILES):
        _check_pickle(data, largest=size if part == 3 else None)
    data.seek(0)


def _check_pickle(file: IO[bytes], largest: int | None = None) -> None:
    """Refuse a pickle that names anything but tensors, is long, reuses a tuple, or has an integer above ``largest``.

    Tuples that each hold the next one twice grow exponentially: hashing the outermost as a dict key would not end.
    """
    start, last, tuples = file.tell(), "", set[object]()
    for opcode, argument, position in pickletools.genops(file):
        name = opcode.name
        if name == "STACK_GLOBAL" or (name == "GLOBAL" and argument not in _ALLOWED):
            raise ValueError(f"it holds {argument or 'an object'}, not only tensors, numbers and strings")
        if largest is not None and isinstance(argument, int) and argument > largest:
            raise ValueError(f"it announces {argument} numbers in {largest} bytes")
        if (position or 0) - start > _LARGEST_PICKLE:
            raise ValueError(f"it describes its tensors in more than {_LARGEST_PICKLE} bytes")
        if name == "MEMOIZE" or name.startswith("DUP"):  # of protocols that torch does not write
            raise ValueError(f"its pickle has the operation {name}, which torch.save does not write")
        if name.endswith("GET") and argument in tuples:
            raise ValueError("it holds one tuple at two places")
        if not name.endswith("PUT"):
            last = name
        elif last.startswith("TUPLE"):
            tuples.add(argument)


def _check_content(state: Any) -> None:
    """Refuse content larger than its storage: tensors that repeat theirs, containers referenced twice."""
    pending, seen = [state], set[int]()
    while pending:
        x = pending.pop()
        if isinstance(x, Tensor) and x.numel() * x.element_size() > x.untyped_storage().nbytes():
            raise ValueError(f"a tensor of shape {tuple(x.shape)} has {x.untyped_storage().nbytes()} bytes")
        if isinstance(x, Mapping | list | tuple) and x:
            if id(x) in seen:
                raise ValueError(f"it holds one {type(x).__name__} at two places")
            seen.add(id(x))
            pending.extend(x.values() if isinstance(x, Mapping) else x)
