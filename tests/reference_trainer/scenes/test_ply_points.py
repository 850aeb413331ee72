from __future__ import annotations

import struct

import pytest
import torch

from reference_trainer.scenes.points import ply_points

POSITIONS = [(0.5, -1.0, 2.0), (3.0, 4.0, -5.5)]
COLORS = [(0, 51, 255), (102, 153, 204)]


def header(form, count=2, coordinate="float", extra=""):
    return (
        f"ply\nformat {form} 1.0\ncomment end of nothing\nelement vertex {count}\n"
        + "".join(f"property {coordinate} {axis}\n" for axis in "xyz")
        + extra
        + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        + "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()


def check(path):
    points = ply_points(path)
    assert points.positions.dtype == points.colors.dtype == torch.float32
    assert [tuple(p) for p in points.positions.tolist()] == POSITIONS
    torch.testing.assert_close(points.colors * 255, torch.tensor(COLORS, dtype=torch.float32))
    assert points.seen_by is None
    assert points.source == str(path)


@pytest.mark.parametrize(("coordinate", "code"), [("float", "3f"), ("double", "3d"), ("float32", "3f")])
def test_binary(tmp_path, coordinate, code):
    body = b"".join(struct.pack(f"<{code}3B", *p, *c) for p, c in zip(POSITIONS, COLORS, strict=True))
    (tmp_path / "p.ply").write_bytes(header("binary_little_endian", coordinate=coordinate) + body)
    check(tmp_path / "p.ply")


def test_binary_with_other_properties(tmp_path):
    body = b"".join(struct.pack("<3fd3B", *p, 7.0, *c) for p, c in zip(POSITIONS, COLORS, strict=True))
    (tmp_path / "p.ply").write_bytes(header("binary_little_endian", extra="property double quality\n") + body)
    check(tmp_path / "p.ply")


def test_ascii(tmp_path):
    body = "".join(f"{' '.join(map(str, (*p, *c)))}\n" for p, c in zip(POSITIONS, COLORS, strict=True)).encode()
    (tmp_path / "p.ply").write_bytes(header("ascii") + body)
    check(tmp_path / "p.ply")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"not a ply file",
        b"ply\nend_header\n",
        b"ply\nformat ascii 1.0\nend_header\n",
        b"ply\nformat ascii 1.0\nelement face 1\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n\n",
        header("binary_little_endian") + b"short",
        header("binary_little_endian", count=2**60) + b"short",
        header("binary_little_endian", count=-1) + b"short",
        header("binary_little_endian", count=0),
        header("binary_middle_endian") + bytes(30),
        header("ascii") + b"1 2 3 4 5 6\n1 2 3 256 5 6\n",
        header("ascii") + b"1 2 3 4 5 6\n1 2 3 4 5 -6\n",
        header("ascii") + b"1 2 3 4 5 6\n",
        header("ascii") + b"1 2 3 4 5 6\n1 2\n",
        header("ascii") + b"1 2 3 4 5 6\nnan 2 3 4 5 6\n",
        header("ascii", coordinate="quad") + b"1 2 3 4 5 6\n1 2 3 4 5 6\n",
    ],
)
def test_bad_files_are_refused_with_their_path(tmp_path, data):
    (tmp_path / "p.ply").write_bytes(data)
    with pytest.raises(ValueError, match=r"p\.ply"):
        ply_points(tmp_path / "p.ply")


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="no point cloud"):
        ply_points(tmp_path / "p.ply")
