"""COLMAP's binary files: ``cameras.bin``, ``images.bin``, ``points3D.bin``. Little-endian throughout."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from reference_trainer.scenes.colmap_model import (
    CAMERA_MODELS,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    PointRecords,
)

__all__ = ["read_cameras_binary", "read_images_binary", "read_points_binary"]

_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK = np.dtype([("image", "<i4"), ("feature", "<i4")])


class _Cursor:
    """Reads a file from front to end, and refuses what is not there before anything is allocated for it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.at = 0

    def need(self, size: int, what: str) -> None:
        if size > len(self.data) - self.at:
            raise ValueError(
                f"{self.path} is truncated or not a COLMAP file: {what} needs {size} bytes at offset {self.at}, "
                f"but {len(self.data) - self.at} are left."
            )

    def take(self, layout: str, what: str) -> tuple[float, ...]:
        size = struct.calcsize("<" + layout)
        self.need(size, what)
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return values

    def count(self, smallest: int, what: str) -> int:
        """Read a number of records of at least ``smallest`` bytes each."""
        count = int(self.take("Q", f"the number of {what}")[0])
        self.need(count * smallest, f"{count} {what}")
        return count

    def array(self, dtype: np.dtype[np.void], count: int, what: str) -> np.ndarray:
        self.need(count * dtype.itemsize, what)
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += count * dtype.itemsize
        return values

    def finish(self) -> None:
        """Refuse what is left: a count that is too small would otherwise pass for a smaller scene."""
        if self.at != len(self.data):
            raise ValueError(
                f"{self.path} is damaged or not a COLMAP file: {len(self.data) - self.at} bytes are left after the "
                "announced number of records."
            )

    def text(self, what: str) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise ValueError(f"{self.path} is truncated or not a COLMAP file: {what} at offset {self.at} has no end.")
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", errors="replace")


def read_cameras_binary(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.bin``. Raises ValueError if it is damaged or has an unknown camera model."""
    cursor = _Cursor(path)
    cameras = {}
    for _ in range(cursor.count(24 + 3 * 8, "cameras")):
        number, model_id, width, height = (int(x) for x in cursor.take("iiQQ", "a camera"))
        if not 0 <= model_id < len(CAMERA_MODELS):
            raise ValueError(f"{path}: camera {number} has the unknown camera model {model_id}.")
        model = CAMERA_MODELS[model_id]
        parameters = cursor.take(f"{model.parameters}d", "the parameters of a camera")
        if number in cameras:
            raise ValueError(f"{path} has camera {number} twice.")
        cameras[number] = ColmapCamera(number, model, width, height, parameters)
    cursor.finish()
    return cameras


def read_images_binary(path: Path) -> list[ColmapImage]:
    """Read ``images.bin``. Raises ValueError if it is damaged."""
    cursor = _Cursor(path)
    images = []
    for _ in range(cursor.count(64 + 1 + 8, "images")):
        number, *pose, camera_id = cursor.take("i7di", "an image")
        name = cursor.text("the name of an image")
        keypoints = cursor.array(_KEYPOINT, cursor.count(_KEYPOINT.itemsize, "features"), "features")
        matrix = ColmapImage.pose(tuple(pose[:4]), tuple(pose[4:]))
        xy, points = keypoints["xy"].astype(np.float64), keypoints["point"].astype(np.int64)
        images.append(ColmapImage(int(number), name, int(camera_id), matrix, xy, points))
    cursor.finish()
    return images


def read_points_binary(path: Path) -> ColmapPoints:
    """Read ``points3D.bin``. Raises ValueError if it is damaged."""
    cursor = _Cursor(path)
    points = PointRecords()
    for _ in range(cursor.count(43 + 8, "points")):
        number, x, y, z, red, green, blue, _error = cursor.take("q3d3Bd", "a point")
        track = cursor.array(_TRACK, cursor.count(_TRACK.itemsize, "track elements"), "a track")
        points.add(int(number), (x, y, z), (int(red), int(green), int(blue)), track["image"])
    cursor.finish()
    return points.finish()
