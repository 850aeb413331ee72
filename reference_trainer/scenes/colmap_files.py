"""COLMAP's files ``cameras``, ``images`` and ``points3D``, binary (little-endian throughout) and text."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_trainer.scenes.colmap_model import (
    CAMERA_MODELS,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    PointRecords,
    add_camera,
    view_matrix_from_quaternion,
)

__all__ = ["READERS"]

_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK = np.dtype([("image", "<i4"), ("feature", "<i4")])


class _Cursor:
    """Reads a file front to back; a record beyond its end is refused before memory is allocated for it."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def need(self, size: int, what: str) -> None:
        if size > len(self.data) - self.at:
            raise ValueError(
                f"{self.path} is truncated or not a COLMAP file: {what} needs {size} bytes at offset {self.at}, "
                f"but {len(self.data) - self.at} are left."
            )

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self.need(size, what)
        self.at += size
        return struct.unpack_from("<" + layout, self.data, self.at - size)

    def count(self, smallest: int, what: str) -> int:
        """Read how many records follow, each of at least ``smallest`` bytes."""
        count: int = self.take("Q", f"the number of {what}")[0]
        self.need(count * smallest, f"{count} {what}")
        return count

    def array(self, dtype: np.dtype[np.void], what: str) -> np.ndarray:
        """Read a count and that many records."""
        count = self.count(dtype.itemsize, what)
        self.at += count * dtype.itemsize
        return np.frombuffer(self.data, dtype, count, self.at - count * dtype.itemsize)

    def text(self, what: str) -> str:
        end = self.data.find(b"\0", self.at)
        self.need(end + 1 - self.at if end >= 0 else len(self.data) + 1, what)
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", errors="replace")

    def records(self, smallest: int, what: str) -> Iterator[None]:
        """Yield once per announced record; refuse trailing bytes: a damaged count would pass for a smaller scene."""
        for _ in range(self.count(smallest, what)):
            yield
        if self.at != len(self.data):
            raise ValueError(
                f"{self.path} is damaged or not a COLMAP file: {len(self.data) - self.at} bytes are left after the "
                "announced number of records."
            )


def read_cameras_binary(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.bin``. Raises ValueError if it is damaged or has an unknown camera model."""
    cursor = _Cursor(path)
    cameras: dict[int, ColmapCamera] = {}
    for _ in cursor.records(24 + 3 * 8, "cameras"):
        number, model, width, height = cursor.take("iiQQ", "a camera")
        parameters = CAMERA_MODELS[model].parameters if 0 <= model < len(CAMERA_MODELS) else 0
        values = cursor.take(f"{parameters}d", "the parameters of a camera")
        add_camera(cameras, number, model, width, height, values)
    return cameras


def read_images_binary(path: Path) -> list[ColmapImage]:
    """Read ``images.bin``. Raises ValueError if it is damaged."""
    cursor = _Cursor(path)
    images = []
    for _ in cursor.records(64 + 1 + 8, "images"):
        number, *pose, camera = cursor.take("i7di", "an image")
        name, keypoints = cursor.text("the name of an image"), cursor.array(_KEYPOINT, "features")
        xy, points = keypoints["xy"].astype(np.float64), keypoints["point"].astype(np.int64)
        images.append(ColmapImage(number, name, camera, view_matrix_from_quaternion(pose[:4], pose[4:]), xy, points))
    return images


def read_points_binary(path: Path) -> ColmapPoints:
    """Read ``points3D.bin``. Raises ValueError if it is damaged."""
    cursor = _Cursor(path)
    points = PointRecords()
    for _ in cursor.records(43 + 8, "points"):
        number, x, y, z, red, green, blue, _error = cursor.take("q3d3Bd", "a point")
        points.add(number, (x, y, z), (red, green, blue), cursor.array(_TRACK, "track elements")["image"])
    return points.finish()


_ANNOUNCED = re.compile(r"#\s*Number of \w+:\s*(\d{1,18})\b")


def _lines(path: Path, lines_each: int = 1) -> Iterator[tuple[int, str]]:
    """Yield the lines that are no comments, numbered; empty ones too, since an image without features has one.

    The number of records in COLMAP's comment is the only sign that a text file is complete. Where present, it is
    checked against the lines read; it may be absent, unless the file has comments or blank lines alone.
    """
    announced, number, found, line, blank = None, 0, 0, "\n", True
    with path.open(encoding="utf-8") as file:
        for number, line in enumerate(file, start=1):
            if line.startswith("#"):
                announced = announced or _ANNOUNCED.match(line)
            else:
                found += 1
                text = line.strip()
                blank = blank and not text
                yield number, text
    if announced is None and number > 0 and blank:
        raise ValueError(f"{path} is truncated, or lacks the line '# Number of ...: 0' that says that it is empty.")
    if announced is not None:
        expected, found = int(announced[1]), found // lines_each
        if found < expected or not line.endswith("\n"):
            raise ValueError(
                f"{path} is truncated: it announces {expected} records and has {found}"
                + ("." if line.endswith("\n") else ", and ends in the middle of a line.")
            )


def _records(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered non-empty lines."""
    return ((number, line) for number, line in _lines(path) if line)


def _numbers(text: str, kind: type[float] | type[int]) -> NDArray[Any]:
    """Read words as numbers, one at a time: a list of all words would take 30 times the memory of the text."""
    words = (kind(word[0]) for word in re.finditer(r"\S+", text))
    return np.fromiter(words, np.float64 if kind is float else np.int64)


def _damaged(path: Path, number: int, error: Exception) -> ValueError:
    """Return an error that names the line that could not be read."""
    return ValueError(f"{path}, line {number}, is truncated or not COLMAP text: {error}")


def read_cameras_text(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.txt``. Raises ValueError if it is damaged or has an unknown camera model."""
    cameras: dict[int, ColmapCamera] = {}
    for number, line in _records(path):
        try:
            words = line.split()
            size = int(words[2]), int(words[3])
            add_camera(cameras, int(words[0]), words[1], *size, tuple(map(float, words[4:])))
        except (ValueError, IndexError) as error:
            raise _damaged(path, number, error) from error
    return cameras


def read_images_text(path: Path) -> list[ColmapImage]:
    """Read ``images.txt``, two lines for each image. Raises ValueError if it is damaged."""
    lines = _lines(path, lines_each=2)
    images: list[ColmapImage] = []
    for number, line in lines:
        if not line and not images:  # blank lines at the beginning
            continue
        _, second = next(lines, (0, ""))
        if not line:  # and at the end
            continue
        try:
            words = line.split(maxsplit=9)  # a name may contain spaces
            matrix = view_matrix_from_quaternion([*map(float, words[1:5])], [*map(float, words[5:8])])
            features = _numbers(second, float).reshape(-1, 3)
            if not (np.abs(features[:, 2]) <= 2**53).all():  # also refuses nan
                raise ValueError("a feature has no number of a point.")
            # The ids go through float64, which is exact up to 2^53.
            points = features[:, 2].astype(np.int64)
            images.append(ColmapImage(int(words[0]), words[9], int(words[8]), matrix, features[:, :2], points))
        except (ValueError, IndexError) as error:
            raise _damaged(path, number, error) from error
    return images


def read_points_text(path: Path) -> ColmapPoints:
    """Read ``points3D.txt``. Raises ValueError if it is damaged."""
    points = PointRecords()
    for number, line in _records(path):
        try:
            words = line.split(maxsplit=8)
            color = [int(word) for word in words[4:7]]
            if not all(0 <= x <= 255 for x in color):
                raise ValueError(f"a color must be three numbers from 0 to 255, got {color}.")
            float(words[7])  # the reprojection error, unused but required
            track = _numbers(words[8] if len(words) > 8 else "", int).reshape(-1, 2)[:, 0]
            points.add(int(words[0]), [float(word) for word in words[1:4]], color, track)
        except (ValueError, IndexError, OverflowError) as error:
            raise _damaged(path, number, error) from error
    return points.finish()


READERS: dict[str, dict[str, Callable[[Path], Any]]] = {
    "cameras": {".bin": read_cameras_binary, ".txt": read_cameras_text},
    "images": {".bin": read_images_binary, ".txt": read_images_text},
    "points3D": {".bin": read_points_binary, ".txt": read_points_text},
}
"""Readers by file stem and suffix."""
