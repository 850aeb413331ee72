import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from reference_trainer.camera import Camera
from reference_trainer.cli import main
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.dense import SOURCE, dense_points, source_views
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.scene import View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import make_plan

pytest.importorskip("numba")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def courtyard():
    return synthetic_scene()


def off(cloud, views):
    """The relative error of every point's depth, in the view where it is least: the others may see it hidden."""
    found = []
    for view in views:
        pixels, depths = view.camera.project(cloud.positions)
        inside = view.camera.inside(pixels, depths)
        column, row = pixels.where(inside[:, None], 0).long().unbind(1)
        true = view.depth[row, column]
        found.append(((depths / true - 1).abs()).where(inside & (true > 0), torch.inf))
    return torch.stack(found).amin(0)


def covered(cloud, view):
    """The share of the 8 x 8 cells of a picture in which there is a point."""
    pixels, depths = view.camera.project(cloud.positions)
    cells = (pixels[view.camera.inside(pixels, depths)] / 8).long()
    return len(torch.unique(cells, dim=0)) / (math.ceil(view.camera.width / 8) * math.ceil(view.camera.height / 8))


@pytest.mark.parametrize("guided", [True, False])
def test_points_lie_on_the_surfaces_of_the_built_in_scene(courtyard, guided):
    cloud = dense_points(courtyard.train, courtyard.points if guided else None)
    errors = off(cloud, courtyard.train)
    print(len(errors), (errors > 0.02).float().mean(), (errors > 0.1).float().mean(), [covered(cloud, v) for v in courtyard.train])
    half = cloud.confidence >= cloud.confidence.median()
    print((errors[half] > 0.02).float().mean(), (errors[~half] > 0.02).float().mean(), cloud.confidence.median())
    assert 0


def looking(x, *, turn=0.0, width=160, height=120, focal=150.0):
    """A camera at (x, 0, 0) that looks along z, turned about the vertical axis by an angle."""
    axes = torch.tensor([[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ torch.tensor([x, 0.0, 0.0])
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


WAVES = torch.randn(40, 3, generator=torch.Generator().manual_seed(3)) * torch.tensor([4.0, 4.0, 0.0])
PHASES = torch.rand(40, 3, generator=torch.Generator().manual_seed(4)) * 2 * math.pi


def plane_view(name, camera, slope, distance=5.0):
    """Photograph the plane z = distance + slope x, painted with waves, by intersecting it with every pixel's ray."""
    row, column = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    far = camera.lift(torch.stack([column, row], -1), torch.ones(camera.height, camera.width)) - camera.position
    z0 = distance + slope * camera.position[0] - camera.position[2]
    depth = z0 / (far[..., 2] - slope * far[..., 0])
    points = camera.position + far * depth[..., None]
    waves = torch.sin((points @ WAVES.T)[..., None] + PHASES)  # (H, W, 40, 3)
    image = (0.5 + 0.06 * waves.sum(2)).clamp(0, 1).permute(2, 0, 1).contiguous()
    return View(name, camera, image, depth=depth)


@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_depth_of_a_tilted_plane(slope):
    views = [plane_view(str(i), looking(x, turn=t), slope) for i, (x, t) in enumerate([(-0.6, 0.1), (0, 0), (0.6, -0.1)])]
    cloud = dense_points(views)
    x, _, z = cloud.positions.unbind(1)
    errors = ((5 + slope * x) / z - 1).abs()
    print(len(x), errors.median(), errors.quantile(0.99), (errors > 0.02).float().mean(), [covered(cloud, v) for v in views])
    assert 0
