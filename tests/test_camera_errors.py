"""Errors of cameras whose answer is known."""

from __future__ import annotations

import math

import pytest
import torch
from camera_errors import camera_errors

from reference_trainer.camera import Camera


def camera(center: tuple[float, float, float], degrees: float = 0.0) -> Camera:
    """Return a camera at a place, turned about its vertical axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    view = torch.eye(4)
    view[:3, :3] = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    view[:3, 3] = -view[:3, :3] @ torch.tensor(center)
    return Camera(view, fx=100.0, fy=100.0, cx=32.0, cy=24.0, width=64, height=48)


TRUE = [camera((0.0, 0.0, 0.0)), camera((1.0, 0.0, 0.0)), camera((0.0, 2.0, 0.0))]


def test_another_world_is_no_error() -> None:
    """Turned by 90 degrees about the vertical axis, three times as large, moved."""
    found = [camera((5.0, 3 * y, 3 * x), 90.0) for x, y in ((0.0, 0.0), (1.0, 0.0), (0.0, 2.0))]
    assert camera_errors(found, TRUE) == pytest.approx((0, 0), abs=1e-4)


def test_one_turned_camera() -> None:
    """The mean of the three rotations takes a third of the error, and leaves two thirds."""
    found = [camera((0.0, 0.0, 0.0), 3.0), *TRUE[1:]]
    assert camera_errors(found, TRUE)[0] == pytest.approx(2, abs=0.02)
