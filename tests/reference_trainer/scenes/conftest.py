"""Scenes written by hand: the writers follow the format descriptions, not the readers under test."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

# Two cameras, three images (one without features), two points. Values are dyadic, so text keeps them exactly.
CAMERAS = [
    (1, "PINHOLE", 1, 64, 48, (50.5, 51.25, 32.0, 24.0)),
    (7, "SIMPLE_RADIAL", 2, 32, 24, (40.0, 16.0, 12.0, 0.125)),
]
IMAGES = [
    (3, (0.5, 0.5, 0.5, 0.5), (1.0, -2.0, 3.5), 1, "b.png", [(1.5, 2.5, 10), (3.25, 4.75, -1)]),
    (2, (1.0, 0.0, 0.0, 0.0), (0.0, 0.25, 4.0), 7, "a b.png", []),
    (9, (0.0, 1.0, 0.0, 0.0), (0.5, 0.0, 2.0), 1, "c.png", [(8.5, 9.5, 11)]),
]
POINTS = [
    (10, (0.5, -1.5, 2.25), (255, 0, 17), 0.5, [(3, 0), (9, 0)]),
    (11, (-4.0, 8.0, 0.125), (1, 2, 3), 0.25, [(9, 0)]),
]


def write_binary(folder: Path) -> None:
    cameras = struct.pack("<Q", len(CAMERAS))
    for number, _, model, width, height, parameters in CAMERAS:
        cameras += struct.pack(f"<iiQQ{len(parameters)}d", number, model, width, height, *parameters)
    images = struct.pack("<Q", len(IMAGES))
    for number, q, t, camera, name, features in IMAGES:
        images += (
            struct.pack("<i7di", number, *q, *t, camera) + name.encode() + b"\0" + struct.pack("<Q", len(features))
        )
        images += b"".join(struct.pack("<ddq", *feature) for feature in features)
    points = struct.pack("<Q", len(POINTS))
    for number, xyz, rgb, error, track in POINTS:
        points += struct.pack("<Q3d3BdQ", number, *xyz, *rgb, error, len(track))
        points += b"".join(struct.pack("<ii", *element) for element in track)
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(data)


def write_text(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "1 PINHOLE 64 48 50.5 51.25 32 24\n7 SIMPLE_RADIAL 32 24 40 16 12 0.125\n"
    )
    (folder / "images.txt").write_text(
        "# Image list with two lines of data per image:\n"
        "3 0.5 0.5 0.5 0.5 1 -2 3.5 1 b.png\n1.5 2.5 10 3.25 4.75 -1\n"
        "2 1 0 0 0 0 0.25 4 7 a b.png\n\n"
        "9 0 1 0 0 0.5 0 2 1 c.png\n8.5 9.5 11\n"
    )
    (folder / "points3D.txt").write_text(
        "# 3D point list\n10 0.5 -1.5 2.25 255 0 17 0.5 3 0 9 0\n11 -4 8 0.125 1 2 3 0.25 9 0\n"
    )


@pytest.fixture
def colmap_binary() -> Callable[[Path], None]:
    return write_binary


@pytest.fixture
def colmap_text() -> Callable[[Path], None]:
    return write_text


@pytest.fixture
def save_image() -> Callable[[Path, np.ndarray], None]:
    def save(path: Path, pixels: np.ndarray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)

    return save


@pytest.fixture
def blender_scene(tmp_path: Path, save_image: Callable[[Path, np.ndarray], None]) -> Path:
    """Three training frames and two test frames, 8x6 RGBA, looking at the origin from 4 units along +z (OpenGL)."""
    rng = np.random.default_rng(0)
    root = tmp_path / "cube"
    for kind, count in (("train", 3), ("test", 2)):
        frames: list[dict[str, Any]] = []
        for i in range(count):
            matrix = np.eye(4)
            matrix[2, 3] = 4 + i
            frames.append({"file_path": f"./{kind}/r_{i}", "transform_matrix": matrix.tolist()})
            save_image(root / kind / f"r_{i}.png", rng.integers(0, 256, (6, 8, 4), dtype=np.uint8))
        content = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames}
        (root / f"transforms_{kind}.json").write_text(json.dumps(content))
    return root
