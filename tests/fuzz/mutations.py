"""Ways to damage a file, as pure functions of its bytes and a source of random numbers."""

from __future__ import annotations

import io
import json
import pickle
import random
import re
import struct
import time
import zipfile
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from fuzz.state_mutations import STATE_MUTATIONS
from PIL import Image

__all__ = ["CUT", "FOREIGN", "Form", "damage"]

Form = Literal["binary", "text", "json", "tensors", "state"]
Mutation = Callable[[bytes, random.Random], bytes]

_INTEGERS = (0, 1, 2, 255, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e-320, 1e308, -1e308)
_WORDS = (
    *("0", "-1", "1", "nan", "inf", "-inf", "1e400", "1e-400", "1e308", "0x10", "1_000", "", "x", "\x00", "é", "#"),
    *(
        "9" * 5000,
        str(2**63),
        str(2**64),
        "-" + "9" * 30,
        "4294967296",
        "2147483648",
        "../../etc/passwd",
        "/etc/passwd",
    ),
)
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 0.5, 10**400, 10**18, 1e308, float("nan"), float("inf"), "", "x", "\x00", "1"),
    *("../../etc/passwd", "/etc/passwd", ".", "..", "a" * 5000, "é\ud800", [], {}, [[]], [None], {"a": 1}, [1, "x"]),
    *([[1e400] * 4] * 4, [0] * 100, [[]] * 20_000, [{"": 0}] * 10_000, [""] * 20_000),
)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(1, len(data))]  # an empty file of COLMAP points is what its manual tells users to make


def _flip_bits(data: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def _random_bytes(data: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(data)), rng.choice((1, 2, 4, 8, 64))
    return data[:at] + rng.randbytes(size) + data[at + size :]


def _absurd_word(data: bytes, rng: random.Random) -> bytes:
    """Overwrite 4 or 8 bytes with a number that counts and sizes are not made for."""
    layout = rng.choice("IQfd")
    value = rng.choice(_FLOATS) if layout in "fd" else rng.choice(_INTEGERS) % 2 ** (8 * struct.calcsize(layout))
    if layout == "f" and abs(value) > 1e38:
        value = float("inf")
    word = struct.pack(rng.choice("<>") + layout, value)
    at = rng.randrange(len(data))
    at -= rng.choice((0, at % 4))
    return data[:at] + word + data[at + len(word) :]


def _delete(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + data[at + rng.choice((1, 2, 8, 100)) :]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(data)), rng.choice((1, 8, 64, len(data)))
    return data[: at + size] + data[at:]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.choice((0, rng.randrange(len(data)), len(data)))
    return data[:at] + rng.choice((bytes(1), b"\n", rng.randbytes(16), b"#" * 100_000, bytes(100_000))) + data[at:]


def _zeros(data: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(data)), rng.choice((8, 64, len(data)))
    return (data[:at] + bytes(size) + data[at + size :])[: len(data)]


def _swap_word(data: bytes, rng: random.Random) -> bytes:
    """Put an absurd word in the place of one that stands between blanks, commas or quotes."""
    places = list(re.finditer(rb"[^\s,\"\[\]{}:]+", data[:20_000])) or [re.match(b"", data)]
    place = rng.choice(places)
    assert place is not None
    return data[: place.start()] + rng.choice(_WORDS).encode() + data[place.end() :]


def _change_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[at])
        case 2:
            other = rng.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            words = lines[at].split(b" ")
            del words[rng.randrange(len(words))]
            lines[at] = b" ".join(words)
    return b"\n".join(lines)


def _nest(data: bytes, rng: random.Random) -> bytes:
    """Open more brackets than any parser wants to follow."""
    return rng.choice((b"[", b'{"a":', b"(")) * 100_000 + data


def _change_node(data: bytes, rng: random.Random) -> bytes:
    """Replace, remove or add a value somewhere in a JSON document, or in one line of JSON lines."""
    lines = [data] if data.lstrip().startswith(b"{\n") or data.count(b"\n") < 2 else data.splitlines()
    at = rng.randrange(len(lines))
    root = [json.loads(lines[at])]
    node: Any = root
    key: Any = 0
    while isinstance(node[key], dict | list) and node[key] and rng.random() < 0.8:
        node = node[key]
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
    match rng.randrange(4):
        case 0 if node is not root:
            del node[key]
        case 1 if isinstance(node, dict):
            node[rng.choice(_WORDS)] = node.pop(key)
        case _:
            node[key] = rng.choice(_VALUES)
    lines[at] = json.dumps(root[0]).encode()
    return b"\n".join(lines)


def _foreign(data: bytes, rng: random.Random) -> bytes:
    """Put a file of another format under the name: what it is shows in its content alone."""
    image, kind = Image.new(rng.choice(("L", "RGB")), (8, 8)), rng.choice(_FOREIGN)
    file = io.BytesIO()
    if kind == "pickle":
        return pickle.dumps({"x": [1, 2.5]})
    if kind == "NPY":
        np.save(file, np.zeros((2, 17)))
    elif kind == "ZIP":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr(zipfile.ZipInfo("x"), data)  # of 1980, not of this second
    else:
        # Pillow writes the present second into a PDF.
        image.save(file, kind, **({"creationDate": _LONG_AGO, "modDate": _LONG_AGO} if kind == "PDF" else {}))
    return file.getvalue()


def _expand(data: bytes, rng: random.Random) -> bytes:
    """Insert a hundred thousand bytes of the shortest values that a text can hold, at the end of a line or anywhere."""
    word = rng.choice((b"0 ", b"\n", b"0\n", b"[],", b"{},", b'{"":0},', b'"",', b"0 0 0 0 0 0 0 0\n", b"[", b"0,"))
    at = rng.choice((rng.randrange(len(data)), data.rfind(b"\n") + 1, data.find(b"[") + 1))
    return data[:at] + word * (100_000 // len(word)) + data[at:]


_LONG_AGO = time.gmtime(0)
_FOREIGN = ("EPS", "PDF", "GIF", "PPM", "TGA", "PCX", "ICO", "NPY", "ZIP", "pickle")  # that no reader takes as they are
CUT, FOREIGN = "cut", "foreign"
_BYTES: dict[str, Mutation] = {
    CUT: _cut, "flip bits": _flip_bits, "random bytes": _random_bytes, "absurd number": _absurd_word,
    "delete": _delete, "repeat": _repeat, "insert": _insert, "zeros": _zeros,
    FOREIGN: _foreign,
}  # fmt: skip
_TEXT: dict[str, Mutation] = {"swap word": _swap_word, "change line": _change_line, "nest": _nest, "expand": _expand}
_MUTATIONS: dict[Form, dict[str, Mutation]] = {
    "binary": _BYTES | {"swap word": _swap_word},
    "text": _BYTES | _TEXT,
    "json": _BYTES | _TEXT | {"change node": _change_node, "change node again": _change_node},
    "tensors": _BYTES | {"share": STATE_MUTATIONS["share"]},
    "state": STATE_MUTATIONS,
}


def damage(data: bytes, form: Form, seed: int) -> tuple[str, bytes]:
    """Return how the file was damaged and what became of it; the same for the same seed.

    Args:
        data: a good file, not empty.
        form: what kind of damage makes sense for it.
        seed: chooses the damage.
    """
    rng = random.Random(seed)
    kind = rng.choice(list(_MUTATIONS[form]))
    return kind, _MUTATIONS[form][kind](data, rng)
