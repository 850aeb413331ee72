"""The built-in scene: a small ray-traced courtyard seen by a forward-facing rig; it needs no files."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from reference_trainer.camera import Camera
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.scenes.virtual_cameras import look_at

__all__ = [
    "Box", "Noise", "Round", "Solid", "Texture", "checker", "color_ramp", "nearest_hit", "render_solids",
    "synthetic_scene",
]  # fmt: skip

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
    train = [shoot(f"train_{i}", _rig_camera(s, (-1) ** i * 0.12, width, height)) for i, s in enumerate(places)]
    between = _between(places, test_views - 1)
    test = [shoot(f"test_{i}", _rig_camera(s, 0.0, width, height)) for i, s in enumerate(between)]
    test.append(shoot("test_outside", _rig_camera(OUTSIDE, 0.0, width, height)))
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


def _rig_camera(place: float, lift: float, width: int, height: int) -> Camera:
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


SAMPLES = 3  # a side per pixel; odd, so that one ray passes through the pixel center and gives its depth
SHADOW_OFFSET = 1e-3  # shadow rays start this far off the surface, so that rounding does not make it shadow itself
AMBIENT = 0.3
GAMMA = 2.2


@dataclass(frozen=True)
class Round:
    """A sphere or, given two heights, the open upright cylinder between them."""

    center: tuple[float, float, float]
    radius: float
    texture: Texture
    heights: tuple[float, float] | None = None

    def _across(self, points: Tensor) -> Tensor:
        """Return vectors without their vertical part for a cylinder, unchanged for a sphere."""
        return points if self.heights is None else points * points.new_tensor([1.0, 0.0, 1.0])

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Return the ray parameters (R,) of the first hits in front of the origins, inf for none."""
        offset, along = self._across(origins - origins.new_tensor(self.center)), self._across(directions)
        a, half_b, c = along.square().sum(1), (offset * along).sum(1), offset.square().sum(1) - self.radius**2
        disc = half_b * half_b - a * c
        root = disc.clamp_min(0).sqrt()
        near, far = (-half_b - root) / a, (-half_b + root) / a
        t = torch.where(near > 0, near, far)
        hit = (disc > 0) & (t > 0)
        if self.heights is not None:
            y = origins[:, 1] + t * directions[:, 1]
            hit &= (y > self.heights[0]) & (y < self.heights[1])
        return torch.where(hit, t, torch.inf)

    def normals(self, points: Tensor) -> Tensor:
        """Return the outward unit normals (R, 3) at surface points (R, 3)."""
        return self._across(points - points.new_tensor(self.center)) / self.radius


@dataclass(frozen=True)
class Box:
    """A box turned about the vertical axis by ``turn`` radians."""

    center: tuple[float, float, float]
    half_size: tuple[float, float, float]
    turn: float
    texture: Texture

    def _axes(self, like: Tensor) -> Tensor:
        """Return the box's axes in world coordinates, one per row."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        return like.new_tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])

    def local(self, points: Tensor) -> Tensor:
        """Return world points (R, 3) in the box's own coordinates, centered and along its axes."""
        return (points - points.new_tensor(self.center)) @ self._axes(points).T

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """See `Round`."""
        offset, along = self.local(origins), directions @ self._axes(directions).T
        half = origins.new_tensor(self.half_size)
        one, other = (-half - offset) / along, (half - offset) / along
        enter = torch.minimum(one, other).amax(1)
        leave = torch.maximum(one, other).amin(1)
        return torch.where((enter < leave) & (enter > 0), enter, torch.inf)

    def normals(self, points: Tensor) -> Tensor:
        """See `Round`."""
        share = self.local(points) / points.new_tensor(self.half_size)
        face = share.abs().argmax(1, keepdim=True)
        return torch.zeros_like(share).scatter(1, face, share.gather(1, face).sign()) @ self._axes(points)


Solid = Round | Box


def nearest_hit(solids: Sequence[Solid], origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Intersect rays with solids: parameters (R,) of the nearest hits, inf for none, and the solids' numbers (R,).

    Origins and directions have shape (R, 3); a direction may have any length.
    """
    return torch.stack([solid.intersect(origins, directions) for solid in solids]).min(0)


def render_solids(camera: Camera, solids: Sequence[Solid], light: Tensor) -> tuple[Tensor, Tensor]:
    """Render solids, 3x3 rays per pixel: the image (3, H, W) in [0, 1] and the depth (H, W) at pixel centers, float32.

    Surfaces are Lambertian, so their color does not depend on the view. The light is nine points (9, 3), one for each
    of a pixel's nine rays, which makes the shadows soft. Depth is along the camera's z axis; image and depth are 0
    where nothing is hit.
    """
    steps = (torch.arange(SAMPLES) + 0.5) / SAMPLES
    shape = (camera.height, camera.width, SAMPLES, SAMPLES)
    y = (torch.arange(camera.height)[:, None, None, None] + steps[:, None]).expand(shape)
    x = (torch.arange(camera.width)[:, None, None] + steps).expand(shape)
    position = camera.position.to(torch.float32)
    directions = (camera.lift(torch.stack([x, y], dim=-1), torch.ones(shape)) - position).reshape(-1, 3)
    origins = position.expand_as(directions)
    t, index = nearest_hit(solids, origins, directions)  # directions have unit z in the camera, so t is the depth
    hit = t.isfinite()
    points, index = (origins + t[:, None] * directions)[hit], index[hit]
    normals, reflectances = torch.empty_like(points), torch.empty_like(points)
    for number, solid in enumerate(solids):
        mine = index == number
        normals[mine], reflectances[mine] = solid.normals(points[mine]), solid.texture(points[mine])
    start = points + SHADOW_OFFSET * normals
    to_light = light.repeat(camera.height * camera.width, 1)[hit] - start
    lit = nearest_hit(solids, start, to_light)[0] > 1
    cosine = (normals * torch.nn.functional.normalize(to_light, dim=1)).sum(1).clamp_min(0)
    radiance = torch.zeros_like(directions)
    radiance[hit] = reflectances * (AMBIENT + (1 - AMBIENT) * cosine * lit)[:, None]
    image = radiance.reshape(camera.height, camera.width, SAMPLES**2, 3).mean(2).clamp(0, 1).pow(1 / GAMMA)
    depth = t.reshape(camera.height, camera.width, SAMPLES**2)[:, :, SAMPLES**2 // 2]
    return image.permute(2, 0, 1).contiguous(), torch.where(depth.isfinite(), depth, 0)


Texture = Callable[[Tensor], Tensor]
"""Maps points (R, 3) to linear RGB reflectances (R, 3), nominally in [0, 1]."""


class Noise:
    """Smooth noise in space: random values on a periodic integer lattice, interpolated, summed over octaves.

    Example:
        >>> noise = Noise(torch.Generator().manual_seed(0))
        >>> noise(torch.rand(10, 3), octaves=4).shape
        torch.Size([10])
    """

    PERIOD = 32

    def __init__(self, generator: torch.Generator) -> None:
        self.lattice = torch.rand((self.PERIOD,) * 3, generator=generator)
        self._wrapped = pad(self.lattice[None, None], (0, 1) * 3, mode="circular")

    def __call__(self, points: Tensor, octaves: int = 1) -> Tensor:
        """Return the noise at points (R, 3): values in [0, 1], shape (R,), with features of size 1 and smaller."""
        total, weight = points.new_zeros(points.shape[0]), 0.0
        for octave in range(octaves):
            # The shift keeps the lattice planes of the octaves apart.
            total += self._single(points * 2**octave + 7.3 * octave) * 0.5**octave
            weight += 0.5**octave
        return total / weight

    def _single(self, points: Tensor) -> Tensor:
        """One octave: trilinear interpolation with the smoothstep fade."""
        base = points.floor()
        fade = points - base
        at = (base % self.PERIOD + fade * fade * (3 - 2 * fade)) * (2 / self.PERIOD) - 1
        grid = at.flip(1)[None, None, None]  # the last axis of the lattice comes first
        return grid_sample(self._wrapped, grid, align_corners=True).flatten()


def color_ramp(values: Tensor, colors: Sequence[tuple[float, float, float]]) -> Tensor:
    """Map values in [0, 1], shape (R,), to colors (R, 3) on a piecewise linear path through ``colors``.

    Example:
        >>> color_ramp(torch.tensor([0.0, 0.5]), [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]).tolist()
        [[0.0, 0.0, 0.0], [0.5, 0.5, 0.5]]
    """
    table = torch.tensor(colors)
    at = values.clamp(0, 1) * (len(colors) - 1)
    index = at.floor().long().clamp(max=len(colors) - 2)
    return torch.lerp(table[index], table[index + 1], (at - index)[:, None])


def checker(u: Tensor, v: Tensor, joint: float) -> tuple[Tensor, Tensor]:
    """Return the color of a unit checkerboard at (u, v), 0 or 1, and whether the point is on a joint between tiles."""
    edge = torch.minimum((u - u.round()).abs(), (v - v.round()).abs())
    return (u.floor() + v.floor()).long() % 2, edge < joint / 2
