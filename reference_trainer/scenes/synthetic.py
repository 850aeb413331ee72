"""The built-in scene: a small ray-traced courtyard seen by a forward-facing rig; it needs no files."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes.orbit import look_at
from reference_trainer.scenes.raytrace import Box, Round, Solid, render_solids
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.scenes.textures import Noise, Texture, checker, color_ramp

__all__ = ["synthetic_scene"]

FIELD_OF_VIEW = math.radians(52)  # horizontal
TARGET = (0.0, 0.15, 5.0)  # the point that all cameras look at
RIG_HALF_WIDTH = 1.1
OUTSIDE = 1.35  # position of the extrapolating test camera, in half widths of the training rig
DEPTH_NOISE = 0.005  # standard deviation of the initial points along the ray, relative to their depth
GROUND = 1.0
TEXTURE_SEED = 0


def synthetic_scene(
    width: int = 160,
    height: int = 120,
    *,
    train_views: int = 3,
    test_views: int = 3,
    points: int = 3000,
    seed: int = 0,
) -> Scene:
    """Ray-trace the built-in scene: columns, spheres and a box on a tiled floor in front of a painted wall.

    The training cameras, at least 2, stand side by side in a slightly bent row and look at one point, as in LLFF
    captures. All test cameras but the last stand between them (interpolation), the last one beyond the end of the row
    (extrapolation, the hardest). Every view has its exact depth. The initial points lie on surfaces seen by training
    views, with a depth error of 0.5 %, as if triangulated. ``seed`` affects the points alone: the photographs are the
    same for every seed, so that runs can be compared. No ray reaches the background, which is black.

    Convention: OpenCV world: x right, y down, z forward; the floor is at y = 1.

    Raises:
        ValueError: if there are too few views or no points.

    Example:
        >>> scene = synthetic_scene(width=40, height=30, points=100)
        >>> [view.name for view in scene.train], [view.name for view in scene.test]
        (['train_0', 'train_1', 'train_2'], ['test_0', 'test_1', 'test_outside'])
    """
    if train_views < 2 or test_views < 1 or points < 1:
        raise ValueError(
            "the built-in scene needs at least 2 training views, 1 test view and 1 point, "
            f"got {train_views}, {test_views} and {points}."
        )
    solids = _courtyard(Noise(torch.Generator().manual_seed(TEXTURE_SEED)))
    grid = torch.linspace(-0.45, 0.45, 3)
    light = torch.tensor([-4.5, -5.0, 0.8]) + torch.stack(
        [grid.repeat_interleave(3), torch.zeros(9), grid.repeat(3)], dim=1
    )

    def shoot(name: str, camera: Camera) -> View:
        image, depth = render_solids(camera, solids, light)
        return View(name, camera, image, depth=depth)

    places = torch.linspace(-1, 1, train_views).tolist()
    train = [shoot(f"train_{i}", _camera(s, (-1) ** i * 0.12, width, height)) for i, s in enumerate(places)]
    between = _between(places, test_views - 1)
    test = [shoot(f"test_{i}", _camera(s, 0.0, width, height)) for i, s in enumerate(between)]
    test.append(shoot("test_outside", _camera(OUTSIDE, 0.0, width, height)))
    cloud = _surface_points(train, points, torch.Generator().manual_seed(seed))
    return Scene("synthetic", tuple(train), tuple(test), cloud, torch.zeros(3))


def _between(places: list[float], count: int) -> list[float]:
    """Choose distinct places in the gaps between the training cameras, spread over as many gaps as possible."""
    gaps = list(itertools.pairwise(places))
    rounds = max(1, math.ceil(count / len(gaps)))
    chosen = []
    for i in range(count):
        left, right = gaps[i % len(gaps)] if count > len(gaps) else gaps[i * len(gaps) // count]
        chosen.append(left + (right - left) * (i // len(gaps) + 1) / (rounds + 1))
    return chosen


def _camera(place: float, lift: float, width: int, height: int) -> Camera:
    """Stand at ``place`` on the row, in half widths, and look at the target with the horizon level."""
    position = torch.tensor([RIG_HALF_WIDTH * place, -0.75 - lift, 0.25 * place * place], dtype=torch.float64)
    pose = look_at(position, position.new_tensor(TARGET), position.new_tensor([0.0, 1.0, 0.0]))
    focal = 0.5 * width / math.tan(0.5 * FIELD_OF_VIEW)
    return Camera(pose.to(torch.float32), focal, focal, width / 2, height / 2, width, height)


def _surface_points(views: list[View], count: int, generator: torch.Generator) -> PointCloud:
    """Draw pixels of the training views and lift them to the surface, with noise along the ray."""
    height, width = views[0].image.shape[1:]
    chosen = torch.randint(len(views) * height * width, (count,), generator=generator)
    error = 1 + DEPTH_NOISE * torch.randn(count, generator=generator)
    positions, colors = torch.empty(count, 3), torch.empty(count, 3)
    for number, view in enumerate(views):
        mine = chosen // (height * width) == number
        pixel = chosen[mine] % (height * width)
        assert view.depth is not None
        depth = view.depth.flatten()[pixel] * error[mine]
        positions[mine] = view.camera.lift(torch.stack([pixel % width, pixel // width], dim=1) + 0.5, depth)
        colors[mine] = view.image.flatten(1)[:, pixel].T
    return PointCloud(positions, colors, source="synthetic", seen_by=frozenset(view.name for view in views))


def _courtyard(noise: Noise) -> list[Solid]:
    """Return the surfaces of the scene. Reflectances are linear; the renderer applies the display gamma."""

    def floor(p: Tensor) -> Tensor:
        which, joint = checker(p[:, 0] / 0.8 + 0.35, p[:, 2] / 0.8, joint=0.05)
        light = color_ramp(noise(p * 5, octaves=4), [(0.42, 0.33, 0.22), (0.86, 0.77, 0.60)])
        dark = color_ramp(noise(p * 6 + 11, octaves=4), [(0.22, 0.06, 0.03), (0.62, 0.24, 0.12)])
        tiles = torch.where((which == 0)[:, None], light, dark)
        return torch.where(joint[:, None], 0.25 * light, tiles)

    def wall(p: Tensor) -> Tensor:
        warp = noise(p * 0.55, octaves=4)
        bands = 0.5 + 0.5 * torch.sin(4.0 * p[:, 1] + 9.0 * warp)
        paint = color_ramp(bands, [(0.03, 0.11, 0.17), (0.06, 0.24, 0.30), (0.20, 0.42, 0.42), (0.52, 0.52, 0.38)])
        return paint * (0.55 + 0.7 * noise(p * 8, octaves=3))[:, None]

    def marble(p: Tensor) -> Tensor:
        veins = (torch.sin(7 * p[:, 0] + 5 * p[:, 1] + 14 * noise(p * 2.2, octaves=4))).abs()
        return color_ramp(veins, [(0.90, 0.86, 0.80), (0.10, 0.28, 0.52), (0.02, 0.08, 0.25)])

    def citrus(p: Tensor) -> Tensor:
        stripes = 0.5 + 0.5 * torch.sin(34 * p[:, 1] + 10 * p[:, 0] + 3 * noise(p * 6, octaves=2))
        paint = color_ramp(stripes, [(0.78, 0.13, 0.03), (0.95, 0.48, 0.06), (0.98, 0.80, 0.45)])
        return paint * (0.6 + 0.55 * noise(p * 24, octaves=2))[:, None]

    def moss(p: Tensor) -> Tensor:
        spots = noise(p * 9, octaves=3)
        return color_ramp(spots * 1.6 - 0.3, [(0.02, 0.12, 0.06), (0.16, 0.42, 0.12), (0.75, 0.82, 0.35)])

    def stone(tint: tuple[float, float, float]) -> Texture:
        def texture(p: Tensor) -> Tensor:
            grain = 0.45 + 0.55 * noise(p * 14, octaves=3)
            ring = torch.where(((p[:, 1] * 2.5) % 1) < 0.08, 0.35, 1.0)
            return p.new_tensor(tint) * (grain * ring)[:, None]

        return texture

    def mosaic(p: Tensor) -> Tensor:
        at = crate.local(p) / 0.14
        which, _ = checker(at[:, 0], at[:, 2], joint=0.0)
        layer = (at[:, 1].floor().long() + which) % 2
        shade = noise(at.floor() * 3.7 + 0.5)
        tiles = color_ramp(shade, [(0.55, 0.08, 0.14), (0.90, 0.45, 0.30), (0.95, 0.80, 0.62)])
        return tiles * torch.where(layer == 0, 1.0, 0.45)[:, None] * (0.75 + 0.4 * noise(p * 20))[:, None]

    crate = Box((1.35, 0.55, 5.6), (0.45, 0.45, 0.45), 0.6, mosaic)
    columns = [Round((x, 0.0, 7.0), 0.2, stone((0.80, 0.72, 0.60)), (-6.0, GROUND)) for x in (-3.3, -1.1, 1.1, 3.3)]
    return [
        Box((0.0, GROUND + 20, 0.0), (40.0, 20.0, 40.0), 0.0, floor),
        Box((0.0, 0.0, 28.5), (40.0, 40.0, 20.0), 0.0, wall),
        Round((-0.95, 0.25, 4.7), 0.75, marble),
        Round((0.42, 0.60, 3.6), 0.40, citrus),
        Round((-0.25, 0.72, 6.0), 0.28, moss),
        Round((1.35, -0.22, 5.6), 0.32, moss),
        crate,
        *columns,
    ]
