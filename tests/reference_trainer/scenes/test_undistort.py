import math

import numpy as np
import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.scenes.frames import corner_displacement, undistort

CAMERA = Camera(torch.eye(4), fx=120.0, fy=110.0, cx=78.5, cy=62.0, width=160, height=120)
LENSES = {
    "SIMPLE_RADIAL, barrel": (-0.12,),
    "SIMPLE_RADIAL, pincushion": (0.15,),
    "RADIAL": (-0.2, 0.05),
    "OPENCV": (0.05, -0.02, 0.01, -0.008),
    "k3": (0.02, -0.03, 0.004, 0.002, 0.02),
    "FULL_OPENCV": (0.1, 0.02, 0.003, -0.002, 0.01, 0.05, 0.01, 0.002),
}


def lens(point, distortion):
    """Where the photograph has a point of the camera's coordinates: OpenCV's model as its manual has it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *[0.0] * (8 - len(distortion)))
    x, y = point[0] / point[2], point[1] / point[2]
    r = math.hypot(x, y)
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    u = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    v = y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return CAMERA.fx * u + CAMERA.cx, CAMERA.fy * v + CAMERA.cy


@pytest.mark.parametrize("name", LENSES)
def test_points_are_where_the_pinhole_camera_sees_them(name):
    distortion = LENSES[name]
    rows, columns = np.mgrid[:120, :160] + 0.5
    for point in [(0.0, 0.0, 2.0), (0.8, 0.5, 2.0), (-0.9, 0.6, 2.0), (0.6, -0.7, 2.0), (-0.8, -0.5, 2.0)]:
        u, v = lens(point, distortion)
        blob = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 2.0**2))
        straight, camera = undistort(torch.from_numpy(blob)[None], CAMERA, distortion)
        found = straight[0].numpy()
        center = (found * columns).sum() / found.sum(), (found * rows).sum() / found.sum()
        expected = camera.fx * point[0] / point[2] + camera.cx, camera.fy * point[1] / point[2] + camera.cy
        # A blob of 2 pixels is itself bent a little; half a pixel, the mistake of convention, would show.
        assert math.dist(center, expected) < 0.15


@pytest.mark.parametrize("name", LENSES)
def test_no_pixel_is_made_up(name):
    # Outside the photograph there is nothing: a white one stays white only where every pixel was seen.
    _, camera = undistort(torch.ones(1, 120, 160), CAMERA, LENSES[name])
    assert camera.fx / camera.fy == pytest.approx(CAMERA.fx / CAMERA.fy)
    assert camera.fx >= CAMERA.fx
    for x in (0.5, 80.5, 159.5):
        for y in (0.5, 60.5, 119.5):
            u, v = lens(((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0), LENSES[name])
            assert -1e-6 <= u <= 160 + 1e-6
            assert -1e-6 <= v <= 120 + 1e-6


def test_no_more_is_cut_off_than_needed():
    _, camera = undistort(torch.ones(1, 120, 160), CAMERA, (0.15,))
    border = [(x + 0.5, y) for x in range(160) for y in (0.5, 119.5)] + [
        (x, y + 0.5) for x in (0.5, 159.5) for y in range(120)
    ]
    seen = [lens(((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0), (0.15,)) for x, y in border]
    assert min(min(u, 160 - u, v, 120 - v) for u, v in seen) == pytest.approx(0, abs=1e-3)


def test_a_lens_that_folds_is_refused():
    with pytest.raises(ValueError, match=r"folds .*itself"):
        undistort(torch.ones(1, 120, 160), CAMERA, (-9.0,))


def test_corner_displacement_closed_forms():
    f, k = 200.0, 0.02
    camera = Camera(torch.eye(4), f, f, 80.0, 60.0, 160, 120)
    # The corner is 100 px from the center; a radial term moves it by k r^3 f with r = 100 / f.
    assert corner_displacement(camera, (k,)) == pytest.approx(k * (100 / f) ** 3 * f, rel=1e-12)
    x, y = 80 / f, 60 / f
    expected = f * math.hypot(2 * 0.01 * x * y, 0.01 * (x * x + y * y + 2 * y * y))
    assert corner_displacement(camera, (0.0, 0.0, 0.01, 0.0)) == pytest.approx(expected, rel=1e-12)
    assert corner_displacement(camera, ()) == 0
