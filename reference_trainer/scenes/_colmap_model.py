"""A COLMAP reconstruction as plain data: camera models, and COLMAP's files, binary (little-endian) and text."""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from reference_trainer.camera import Camera
from reference_trainer.rotations import rotation_matrices

__all__ = [
    "CAMERA_MODELS", "READERS", "ColmapCamera", "ColmapImage", "ColmapModel", "ColmapPoints", "PointRecords",
    "add_camera", "view_matrix_from_quaternion",
]  # fmt: skip


class CameraModel(NamedTuple):
    """A camera model: its name and its numbers of focal lengths and distortion parameters.

    A fisheye model is no pinhole even where its distortion parameters are 0, so no pinhole approximates it.
    """

    name: str
    focal_lengths: int
    distortion: int
    fisheye: bool = False

    @property
    def parameters(self) -> int:
        """Number of parameters: focal lengths, principal point, distortion."""
        return self.focal_lengths + 2 + self.distortion


# Indexed by model id: COLMAP, src/colmap/sensor/models.h. The distortion of the models that are no fisheyes is
# k1 k2 p1 p2 k3 k4 k5 k6 or a prefix of it.
CAMERA_MODELS = (
    CameraModel("SIMPLE_PINHOLE", 1, 0),
    CameraModel("PINHOLE", 2, 0),
    CameraModel("SIMPLE_RADIAL", 1, 1),
    CameraModel("RADIAL", 1, 2),
    CameraModel("OPENCV", 2, 4),
    CameraModel("OPENCV_FISHEYE", 2, 4, fisheye=True),
    CameraModel("FULL_OPENCV", 2, 8),
    CameraModel("FOV", 2, 1, fisheye=True),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 1, 1, fisheye=True),
    CameraModel("RADIAL_FISHEYE", 1, 2, fisheye=True),
    CameraModel("THIN_PRISM_FISHEYE", 2, 8, fisheye=True),
)
_MODELS: dict[int | str, CameraModel] = {k: m for n, m in enumerate(CAMERA_MODELS) for k in (n, m.name)}


class ColmapCamera(NamedTuple):
    """Intrinsics of one camera: its pinhole part, posed at the world origin, float64, and its distortion.

    Convention: half-pixel centers, as in the rest of the program; the distortion is in COLMAP's order, empty for the
    pinhole models.
    """

    model: CameraModel
    pinhole: Camera
    distortion: tuple[float, ...]

    def at(self, world_to_camera: NDArray[np.float64]) -> Camera:
        """Return the pinhole part at a pose (4, 4).

        Raises:
            ValueError: if the model is a fisheye.
        """
        if self.model.fisheye:
            raise ValueError(
                f"a camera is {self.model.name}, which no pinhole camera approximates. Undistort the images first "
                "(colmap image_undistorter)."
            )
        return replace(self.pinhole, world_to_camera=torch.from_numpy(world_to_camera))


def add_camera(
    cameras: dict[int, ColmapCamera],
    number: int,
    model: int | str,
    width: int,
    height: int,
    parameters: tuple[float, ...],
) -> None:
    """Add a camera under its number; the model is a number or a name, the parameters are in COLMAP's order.

    Raises:
        ValueError: if the number is taken, the model is unknown, or the size or a parameter is invalid.
    """
    if number in cameras:
        raise ValueError(f"it has camera {number} twice.")
    if model not in _MODELS:
        raise ValueError(f"camera {number} has the unknown camera model {model}.")
    known = _MODELS[model]
    if len(parameters) != known.parameters or not np.isfinite(parameters).all():
        raise ValueError(f"camera {number}: {known.name} needs {known.parameters} finite parameters, got {parameters}.")
    *focal, cx, cy = parameters[: known.focal_lengths + 2]
    try:
        pinhole = Camera(torch.eye(4, dtype=torch.float64), focal[0], focal[-1], cx, cy, width, height)
    except ValueError as error:
        raise ValueError(f"camera {number}: {error}") from error
    cameras[number] = ColmapCamera(known, pinhole, parameters[known.focal_lengths + 2 :])


def view_matrix_from_quaternion(qvec: Sequence[float], tvec: Sequence[float]) -> NDArray[np.float64]:
    """Build the view matrix (4, 4) from COLMAP's quaternion, wxyz, and translation.

    Raises:
        ValueError: if they are not finite, or the quaternion is zero.
    """
    with np.errstate(over="ignore"):  # overflow gives inf, which is refused
        norm = np.linalg.norm(qvec)
    if not (np.isfinite(tvec).all() and 0 < norm < np.inf):
        raise ValueError(f"the pose must be a finite non-zero quaternion and translation, got {qvec} and {tvec}.")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(torch.from_numpy(np.array([qvec]) / norm))[0].numpy()
    matrix[:3, 3] = tvec
    return matrix


class ColmapImage(NamedTuple):
    """One registered image: its number, path within the image folder, camera number and pose (4, 4), float64.

    Its 2D features, most of the file, are not read.
    """

    id: int
    name: str
    camera_id: int
    world_to_camera: NDArray[np.float64]


class ColmapPoints(NamedTuple):
    """The M triangulated points: world coordinates (M, 3), float64, and RGB (M, 3), uint8.

    ``tracks`` holds, for each point, an int64 array of the numbers of the images that observe it; the array is empty
    if the reconstruction does not say.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    tracks: tuple[NDArray[np.int64], ...]


class PointRecords:
    """Accumulates the points of a file in compact arrays: as Python objects they would take ten times the memory."""

    def __init__(self) -> None:
        self._positions, self._colors, self._images, self._ends = array("d"), array("B"), array("q"), array("q")

    def add(self, position: Sequence[float], color: Sequence[int], images: NDArray[np.integer]) -> None:
        """Add a point: three coordinates, three bytes of color, and the numbers of the images in its track."""
        self._positions.extend(position)
        self._colors.extend(color)
        self._images.frombytes(images.astype(np.int64).tobytes())
        self._ends.append(len(self._images))

    def finish(self) -> ColmapPoints:
        """Return the points. Raises ValueError if a position is not finite."""
        images = np.asarray(self._images, np.int64)
        positions = np.asarray(self._positions, np.float64).reshape(-1, 3)
        if bad := int((~np.isfinite(positions)).any(axis=1).sum()):
            raise ValueError(f"{bad} of {len(positions)} points have no finite position.")
        return ColmapPoints(
            positions,
            np.asarray(self._colors, np.uint8).reshape(-1, 3),
            tuple(images[start:end] for start, end in zip([0, *self._ends], self._ends, strict=False)),
        )


@dataclass(frozen=True)
class ColmapModel:
    """A reconstruction: cameras by number, images sorted by name, and points, possibly none.

    Raises ValueError if an image refers to a missing camera, or two images share a name or number.
    """

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    points: ColmapPoints

    def __post_init__(self) -> None:
        for image in self.images:
            if image.camera_id not in self.cameras:
                raise ValueError(
                    f"image {image.name!r} has camera {image.camera_id}; there are {sorted(self.cameras)}."
                )
        if len({image.name for image in self.images}) != len(self.images):
            raise ValueError("two images have the same name.")
        if len({image.id for image in self.images}) != len(self.images):
            raise ValueError("two images have the same number.")

    def seen_by(self) -> frozenset[str]:
        """Return the names of the images that the points come from: those in their tracks.

        A point without a track may come from any image, so one such point makes it all images of the reconstruction.
        """
        if any(len(track) == 0 for track in self.points.tracks):
            return frozenset(image.name for image in self.images)
        used = set(np.concatenate(self.points.tracks).tolist()) if self.points.tracks else set()
        names = {image.id: image.name for image in self.images}
        return frozenset(names.get(i, f"<image {i}>") for i in used)


_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
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
        name = cursor.text("the name of an image")
        cursor.array(_FEATURE, "features")
        images.append(ColmapImage(number, name, camera, view_matrix_from_quaternion(pose[:4], pose[4:])))
    return images


def read_points_binary(path: Path) -> ColmapPoints:
    """Read ``points3D.bin``. Raises ValueError if it is damaged."""
    cursor = _Cursor(path)
    points = PointRecords()
    for _ in cursor.records(43 + 8, "points"):
        _number, *numbers, _error = cursor.take("q3d3Bd", "a point")
        points.add(numbers[:3], numbers[3:], cursor.array(_TRACK, "track elements")["image"])
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
    """Read ``images.txt``, two lines for each image. Raises ValueError if it is damaged or a second one is missing."""
    lines = _lines(path, lines_each=2)
    images: list[ColmapImage] = []
    for number, line in lines:
        if not line and not images:  # blank lines at the beginning
            continue
        _, features = next(lines, (0, ""))
        if not line:  # and at the end
            continue
        try:
            if features and not features.rsplit(maxsplit=1)[-1].lstrip("-").isdecimal():  # they end in a point's number
                raise ValueError(f"the line after it must hold its features, or be empty, and is {features[:80]!r}.")
            words = line.split(maxsplit=9)  # a name may contain spaces
            matrix = view_matrix_from_quaternion([*map(float, words[1:5])], [*map(float, words[5:8])])
            images.append(ColmapImage(int(words[0]), words[9], int(words[8]), matrix))
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
            # One word at a time: a list of all of them would take 30 times the memory of the text.
            track = (int(word[0]) for word in re.finditer(r"\S+", words[8] if len(words) > 8 else ""))
            images = np.fromiter(track, np.int64).reshape(-1, 2)[:, 0]
            points.add([float(word) for word in words[1:4]], color, images)
        except (ValueError, IndexError, OverflowError) as error:
            raise _damaged(path, number, error) from error
    return points.finish()


READERS: dict[str, dict[str, Callable[[Path], Any]]] = {
    "cameras": {".bin": read_cameras_binary, ".txt": read_cameras_text},
    "images": {".bin": read_images_binary, ".txt": read_images_text},
    "points3D": {".bin": read_points_binary, ".txt": read_points_text},
}
"""Readers by file stem and suffix."""
