"""Files of which readers make the most memory for a byte: the shortest records that their formats allow.

``PYTHONPATH=.:tests python tests/fuzz/expansion.py 8000000`` measures each in a process of its own and prints a table.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import resource
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from fuzz import samples
from fuzz.harness import Target
from fuzz.targets import TARGETS
from PIL import Image

from reference_trainer.scenes.images import read_image

__all__ = ["EXPANDING", "PICTURES", "read_quietly"]

Write = Callable[[int], bytes]


def _lines(line: str, *, head: str = "", end: str = "") -> Write:
    """Repeat a line, its number in the place of a hash, up to about so many bytes."""

    def write(size: int) -> bytes:
        count = size // len(line.replace("#", "11111"))
        body = "".join(line.replace("#", str(i)) for i in range(count)) if "#" in line else line * count
        return (head.replace("COUNT", str(count)) + body + end).encode()

    return write


def _ply(line: str, names: str, kind: str = "float") -> Write:
    """Write an ASCII PLY, or one of bytes if the line is empty."""
    form = "ascii" if line else "binary_little_endian"
    properties = "".join(f"property {'uchar' if name in COLORS else kind} {name}\n" for name in names.split())
    head = f"ply\nformat {form} 1.0\nelement vertex COUNT\n{properties}end_header\n"
    return _lines(line or "\0" * len(names.split()), head=head)


def _json(value: str, around: str = "[{}]") -> Write:
    """Repeat a value in a list."""

    def write(size: int) -> bytes:
        return around.replace("{}", ",".join([value] * (size // (len(value) + 1)))).encode()

    return write


def _binary(record: Callable[[int], bytes]) -> Write:
    """Repeat a record of COLMAP, after its count."""

    def write(size: int) -> bytes:
        count = size // len(record(0))
        return struct.pack("<Q", count) + b"".join(map(record, range(count)))

    return write


def _npy(size: int) -> bytes:
    rows = np.zeros((size // 68, 17), np.float32)
    head = str({"descr": "<f4", "fortran_order": False, "shape": rows.shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + rows.tobytes()


def _pickle(size: int) -> bytes:
    """Write a checkpoint of empty dicts; above 256 kB it is refused."""
    import io
    import zipfile

    file, good = io.BytesIO(), io.BytesIO()
    torch.save({"x": torch.zeros(1)}, good)
    with zipfile.ZipFile(good) as archive, zipfile.ZipFile(file, "w") as evil:
        for name in archive.namelist():
            content = b"\x80\x02](" + b"}" * size + b"e."
            evil.writestr(name, content if name.endswith("data.pkl") else archive.read(name))
    return file.getvalue()


COLORS = ("red", "green", "blue")
POINTS = "x y z red green blue"
MODEL = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
FRAME = '{"file_path":"NUMBER","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}'


def _frames(size: int) -> bytes:
    frames = ",".join(FRAME.replace("NUMBER", str(i)) for i in range(size // len(FRAME)))
    return f'{{"w":1,"h":1,"camera_angle_x":1,"frames":[{frames}]}}'.encode()


EXPANDING: dict[tuple[str, str], Write] = {
    ("COLMAP cameras.txt", "cameras"): _lines("# SIMPLE_PINHOLE 1 1 1 0 0\n"),
    ("COLMAP images.txt", "images"): _lines("# 1 0 0 0 0 0 0 1 #\n\n"),
    ("COLMAP images.txt", "features"): _lines("0 0 0 ", head="1 1 0 0 0 0 0 0 1 a\n", end="\n"),
    ("COLMAP points3D.txt", "points"): _lines("0 0 0 0 0 0 0 0\n"),
    ("COLMAP points3D.txt", "blank lines"): _lines("\n", head="1 0 0 0 0 0 0 0\n"),
    ("COLMAP points3D.txt", "a track"): _lines("1 0 ", head="1 0 0 0 0 0 0 0 ", end="\n"),
    ("COLMAP cameras.bin", "cameras"): _binary(lambda i: struct.pack("<iiQQ3d", i, 0, 1, 1, 1, 0, 0)),
    ("COLMAP images.bin", "images"): _binary(
        lambda i: struct.pack("<i7di", i, 1, 0, 0, 0, 0, 0, 0, 1) + f"{i:07}".encode() + bytes(9)
    ),
    ("COLMAP points3D.bin", "points"): _binary(lambda i: struct.pack("<Q3d3BdQ", i, 0, 0, 0, 0, 0, 0, 0, 0)),
    ("LLFF poses_bounds.npy", "rows"): _npy,
    ("Blender transforms.json", "frames"): _frames,
    ("Blender transforms.json", "dicts"): _json('{"":0}'),
    ("split.json, its own views", "dicts"): _json('{"":0}'),
    ("split.json, its own views", "lists"): _json("[]"),
    ("split.json, its own views", "numbers"): _json("-9"),
    ("split.json, its own views", "names"): _json('"r"', '{"train":["r_0"],"test":[{}]}'),
    ("run config.json", "dicts"): _json('{"":0}', '{"scene":[{}],"config":{}}'),
    ("monitor log", "measurements"): _lines('{"step":1}\n'),
    ("PLY points, ASCII", "points"): _ply("0 0 0 0 0 0\n", POINTS),
    ("PLY points, binary", "points of bytes"): _ply("", POINTS, "char"),
    ("PLY model, ASCII", "Gaussians"): _ply("0 " * 13 + "0\n", MODEL),
    ("PLY model, binary", "Gaussians of bytes"): _ply("", MODEL, "char"),
    ("checkpoint", "dicts"): _pickle,
}
PICTURES = {("PNG", "RGB"), ("PNG", "RGBA"), ("PNG", "P"), ("JPEG", "RGB"), ("BMP", "RGB"), ("TIFF", "RGB"),
            ("WEBP", "RGB"), ("WEBP", "RGBA")}  # fmt: skip


def target_of(name: str) -> Target:
    """Return the reader of this name."""
    return next(target for target in TARGETS if target.name == name)


def read_quietly(target: Target, folder: Path) -> None:
    """Read, whatever comes of it."""
    try:
        target.read(folder)
    except (ValueError, OSError) as error:
        assert str(folder) in str(error)  # noqa: PT017 - the message is part of what a reader owes


def _resident(read: Callable[[], object], answer: int) -> None:
    """Send by how much a reader raises the largest resident size of this process."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read()
    os.write(answer, struct.pack("<q", 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)))


def main(size: int) -> None:
    """Measure files of this size, and pictures of as many pixels."""
    multiprocessing.set_start_method("fork")  # what is imported is there; no thread has been started
    torch.set_num_threads(1)
    print("| reader | the file holds | memory, bytes per byte |\n|:---|:---|---:|", flush=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for (name, what), content in EXPANDING.items():
            target = target_of(name)
            target.write(folder)
            read_quietly(target, folder)  # imports
            amount = min(size, 255_000) if name == "checkpoint" else size
            _measured(lambda: (folder / target.file).write_bytes(content(amount)))  # noqa: B023 - called at once
            bytes_ = _measured(functools.partial(read_quietly, target, folder))
            print(f"| {name} | {what} | {bytes_ / (folder / target.file).stat().st_size:.0f} |", flush=True)
        for form, mode in sorted(PICTURES):
            side = int(size**0.5)
            _measured(lambda: Image.new(mode, (side, side)).save(folder / "picture", form))  # noqa: B023
            bytes_ = _measured(functools.partial(read_image, folder / "picture"))
            print(f"| picture, {form} {mode} | {side}x{side} pixels | {bytes_ / side**2:.0f} a pixel |", flush=True)


def _measured(read: Callable[[], object]) -> int:
    """Call in a process of its own, so that nothing here is freed and used again by what is measured next."""
    out, into = os.pipe()
    process = multiprocessing.Process(target=_resident, args=(read, into))
    process.start()
    process.join()
    return int(struct.unpack("<q", os.read(out, 8))[0])


if __name__ == "__main__":
    samples.small_scene()
    main(int(sys.argv[1]))
