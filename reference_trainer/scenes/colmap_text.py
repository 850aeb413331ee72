"""COLMAP's text files: ``cameras.txt``, ``images.txt``, ``points3D.txt``."""

from __future__ import annotations

import re
from collections.abc import Iterator
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
)

__all__ = ["read_cameras_text", "read_images_text", "read_points_text"]

_ANNOUNCED = re.compile(r"#\s*Number of \w+:\s*(\d{1,18})\b")


def _lines(path: Path, lines_each: int = 1) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines without comments; empty ones stay, since an image without features has one.

    Text has no other sign of being complete than the number of records in COLMAP's comment, so where that is given it
    is held against the lines at the end. Files made by hand need not have it, and a file without any lines may have no
    comment.
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
    """Read words as numbers, one after the other: all words at once would take 30 times the text."""
    words = (kind(word[0]) for word in re.finditer(r"\S+", text))
    return np.fromiter(words, np.float64 if kind is float else np.int64)


def _damaged(path: Path, number: int, error: Exception) -> ValueError:
    """Say which line could not be read."""
    return ValueError(f"{path}, line {number}, is truncated or not COLMAP text: {error}")


def read_cameras_text(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.txt``. Raises ValueError if it is damaged or has an unknown camera model."""
    models = {model.name: model for model in CAMERA_MODELS}
    cameras = {}
    for number, line in _records(path):
        try:
            words = line.split()
            camera_id, width, height = int(words[0]), int(words[2]), int(words[3])
            if words[1] not in models:
                raise ValueError(f"camera {camera_id} has the unknown camera model {words[1]}.")
            parameters = tuple(float(word) for word in words[4:])
            if camera_id in cameras:
                raise ValueError(f"it has camera {camera_id} twice.")
            cameras[camera_id] = ColmapCamera(camera_id, models[words[1]], width, height, parameters)
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
        if not line:  # or at the end
            continue
        try:
            words = line.split(maxsplit=9)  # a name may contain spaces
            matrix = ColmapImage.pose(tuple(map(float, words[1:5])), tuple(map(float, words[5:8])))
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
                raise ValueError(f"a colour must be three numbers from 0 to 255, got {color}.")
            float(words[7])  # the reprojection error, which nobody here uses, but which must be there
            track = _numbers(words[8] if len(words) > 8 else "", int).reshape(-1, 2)[:, 0]
            points.add(int(words[0]), [float(word) for word in words[1:4]], color, track)
        except (ValueError, IndexError, OverflowError) as error:
            raise _damaged(path, number, error) from error
    return points.finish()
