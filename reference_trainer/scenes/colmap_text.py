"""COLMAP's text files: ``cameras.txt``, ``images.txt``, ``points3D.txt``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reference_trainer.scenes.colmap_model import CAMERA_MODELS, ColmapCamera, ColmapImage, ColmapPoints

__all__ = ["read_cameras_text", "read_images_text", "read_points_text"]

_ANNOUNCED = re.compile(r"^#\s*Number of \w+:\s*(\d{1,18})\b", re.MULTILINE)


def _lines(path: Path, lines_each: int = 1) -> list[tuple[int, str]]:
    """Return the numbered lines without comments; empty ones stay, since an image without features has one.

    Text has no other sign of being complete than the number of records in COLMAP's comment, so where that is given it
    is held against the lines. Files made by hand need not have it, and a file without any lines may have no comment.
    """
    text = path.read_text(encoding="utf-8")
    numbered = list(enumerate(text.splitlines(), start=1))
    lines = [(number, line.strip()) for number, line in numbered if not line.startswith("#")]
    announced = _ANNOUNCED.search(text)
    if announced is None and numbered and not any(line for _, line in lines):
        raise ValueError(f"{path} is truncated, or lacks the line '# Number of ...: 0' that says that it is empty.")
    if announced is not None:
        expected = int(announced[1])
        found = len(lines) // lines_each
        if found < expected or not text.endswith("\n"):
            raise ValueError(
                f"{path} is truncated: it announces {expected} records and has {found}"
                + ("." if text.endswith("\n") else ", and ends in the middle of a line.")
            )
    return lines


def _records(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the numbered non-empty lines as words."""
    return ((number, line.split()) for number, line in _lines(path) if line)


def _damaged(path: Path, number: int, error: Exception) -> ValueError:
    """Say which line could not be read."""
    return ValueError(f"{path}, line {number}, is truncated or not COLMAP text: {error}")


def read_cameras_text(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.txt``. Raises ValueError if it is damaged or has an unknown camera model."""
    models = {model.name: model for model in CAMERA_MODELS}
    cameras = {}
    for number, words in _records(path):
        try:
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
    while lines and not lines[0][1]:
        lines.pop(0)
    images = []
    for at in range(0, len(lines), 2):
        number, line = lines[at]
        if not line:  # blank lines at the end of the file
            continue
        try:
            words = line.split(maxsplit=9)  # a name may contain spaces
            matrix = ColmapImage.pose(tuple(map(float, words[1:5])), tuple(map(float, words[5:8])))
            features = np.array(lines[at + 1][1].split() if at + 1 < len(lines) else [], np.float64).reshape(-1, 3)
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
    ids, positions, colors, tracks = [], [], [], []
    for number, words in _records(path):
        try:
            ids.append(np.int64(int(words[0])))
            positions.append([float(word) for word in words[1:4]])
            color = [int(word) for word in words[4:7]]
            if not all(0 <= x <= 255 for x in color):
                raise ValueError(f"a colour must be three numbers from 0 to 255, got {color}.")
            colors.append(color)
            float(words[7])  # the reprojection error, which nobody here uses, but which must be there
            tracks.append(np.array(words[8:], np.int64).reshape(-1, 2)[:, 0])
        except (ValueError, IndexError, OverflowError) as error:
            raise _damaged(path, number, error) from error
    return ColmapPoints(
        np.array(ids, np.int64).reshape(-1),
        np.array(positions, np.float64).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
        tuple(tracks),
    )
