from __future__ import annotations

import math

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.scenes.synthetic import AMBIENT, GAMMA, Box, Round, nearest_hit, render_solids


def white(points):
    return torch.ones_like(points)


SPHERE = Round((0.3, -0.2, 4.0), 0.8, white)
CYLINDER = Round((0.2, 5.0, 3.5), 0.6, white, (-0.7, 0.9))
FLOOR = Box((0.0, 21.0, 0.0), (40.0, 20.0, 40.0), 0.0, white)
BOX = Box((-0.2, 0.1, 4.0), (0.5, 0.7, 0.4), 0.6, white)


def inside(solid, p):
    """Whether points are inside, from the definition of each shape alone."""
    if solid is SPHERE:
        return (p - torch.tensor(solid.center).to(p)).norm(dim=-1) < solid.radius
    if solid is FLOOR:
        return p[..., 1] > 1
    c, s = math.cos(0.6), math.sin(0.6)
    x, y, z = (p - torch.tensor(solid.center).to(p)).unbind(-1)
    return ((c * x - s * z).abs() < 0.5) & (y.abs() < 0.7) & ((s * x + c * z).abs() < 0.4)


def rays(count):
    generator = torch.Generator().manual_seed(0)
    origins = 0.5 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins[:, 1].clamp_(max=0.9)  # above the ground plane
    targets = torch.tensor([0.0, 0.0, 4.0]) + torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return origins, targets - origins


@pytest.mark.parametrize("solid", [SPHERE, FLOOR, BOX])
def test_hits_are_where_marching_enters_the_solid(solid):
    origins, directions = rays(400)
    t = solid.intersect(origins, directions)
    steps = torch.linspace(0, 8, 4001, dtype=torch.float64)
    within = inside(solid, origins[:, None] + steps[:, None] * directions[:, None])
    assert not within[:, 0].any()
    entered = within.any(1)
    first = steps[within.int().argmax(1)]
    hit = t < 7.99
    # A grazing ray may slip between two steps of the march; there the chord is shorter than a step.
    assert (entered <= hit).all()
    assert (hit & ~entered).float().mean() < 0.01
    both = entered & hit
    assert both.sum() > 50
    assert ((first - t)[both].abs() <= 0.002 + 1e-9).all()


def test_cylinder_hits_lie_on_it_and_are_the_nearest():
    origins, directions = rays(400)
    t = CYLINDER.intersect(origins, directions)
    hit = t.isfinite()
    assert hit.sum() > 50
    points = origins[hit] + t[hit, None] * directions[hit]
    across = (points - torch.tensor([0.2, 0.0, 3.5])) * torch.tensor([1.0, 0.0, 1.0])
    torch.testing.assert_close(across.norm(dim=1), torch.full((len(points),), 0.6, dtype=torch.float64))
    assert ((points[:, 1] > -0.7) & (points[:, 1] < 0.9)).all()
    # Seen from outside, the side that is hit faces the viewer.
    assert ((across * directions[hit]).sum(1) < 0).all()


@pytest.mark.parametrize("solid", [SPHERE, CYLINDER, BOX, FLOOR])
def test_normals_are_unit_and_face_the_viewer(solid):
    origins, directions = rays(400)
    t = solid.intersect(origins, directions)
    hit = t.isfinite()
    normals = solid.normals(origins[hit] + t[hit, None] * directions[hit])
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(normals), dtype=torch.float64))
    assert ((normals * directions[hit]).sum(1) < 0).all()


def test_sphere_normals_are_radial():
    torch.testing.assert_close(SPHERE.normals(torch.tensor([[0.3, -0.2, 3.2]])), torch.tensor([[0.0, 0.0, -1.0]]))


def test_nearest_hit_is_the_nearest():
    origins, directions = torch.zeros(2, 3), torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    near, far = Round((0.0, 0.0, 3.0), 1.0, white), Round((0.0, 0.0, 9.0), 1.0, white)
    t, index = nearest_hit([far, near], origins, directions)
    assert t.tolist() == [2.0, math.inf]
    assert index[0] == 1


def test_depth_of_a_sphere_is_exact_at_pixel_centers():
    camera = Camera(torch.eye(4), fx=30.0, fy=30.0, cx=16.0, cy=12.0, width=32, height=24)
    image, depth = render_solids(camera, [Round((0.0, 0.0, 4.0), 1.0, white)], torch.zeros(9, 3))
    for row in range(24):
        for column in range(32):
            x, y = (column + 0.5 - 16) / 30, (row + 0.5 - 12) / 30
            # |z (x, y, 1) - (0, 0, 4)| = 1
            disc = 16 - 15 * (x * x + y * y + 1)
            expected = (4 - math.sqrt(disc)) / (x * x + y * y + 1) if disc > 0 else 0.0
            assert depth[row, column].item() == pytest.approx(expected, abs=1e-4 if disc > 0.01 else 0.05)
    assert torch.equal(image[0], image[2])
    assert image[:, 0, 0].tolist() == [0, 0, 0]


def test_shading_is_lambert_and_shadows_are_ambient():
    camera = Camera(torch.eye(4), fx=30.0, fy=30.0, cx=1.5, cy=1.5, width=3, height=3)
    wall = Box((0.0, 0.0, 25.0), (40.0, 40.0, 20.0), 0.0, white)
    oblique = torch.tensor([100.0, 0.0, -95.0]).expand(9, 3)  # 45 degrees off the wall's normal
    lit, _ = render_solids(camera, [wall], oblique)
    linear = lit[:, 1, 1] ** GAMMA
    torch.testing.assert_close(linear, torch.full((3,), AMBIENT + (1 - AMBIENT) * math.sqrt(0.5)), atol=5e-3, rtol=0)
    blocker = Round((10.0, 0.0, -5.0), 1.0, white)
    shadowed, _ = render_solids(camera, [wall, blocker], oblique)
    torch.testing.assert_close(shadowed[:, 1, 1] ** GAMMA, torch.full((3,), AMBIENT), atol=1e-5, rtol=0)
