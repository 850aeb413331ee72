"""Cameras where no photograph was taken, around a model or between the training cameras, and where to measure it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Literal, TypeVar, get_args

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.camera import Camera
from reference_trainer.scenes.options import World
from reference_trainer.scenes.scene import Scene, Viewpoint

__all__ = [
    "VIRTUAL_VIEWS", "BoundingSphere", "CameraPath", "amid_views", "bounding_sphere", "camera_between",
    "cameras_between", "depth_bounds", "interpolate_cameras", "look_at", "measured_views", "orbit_views",
    "pseudo_cameras", "unseen_views",
]  # fmt: skip

T = TypeVar("T")

_log = logging.getLogger(__name__)

ELEVATION = math.radians(20)
"""Elevation of the cameras above the center: objects are mostly looked at from a little above."""

FIELD_OF_VIEW = math.radians(45)
"""Along the shorter side of the picture."""

INSIDE = 0.98
"""Share of the opacity that the picture must hold; with all of it, stray Gaussians would make the object tiny."""

SURROUNDINGS = 3.0
"""A model is an object with surroundings if the radius around its median point that holds `INSIDE` of the opacity is
more than this many times the radius that holds half: 1.6 to 1.9 for objects (a plant, a mesh, lego), 5 for fern."""

FEW_CAMERAS = 10
"""Training cameras, at most, between and beyond which the `unseen_views` are enough."""

NEIGHBORS = 3
"""Of a training camera, amid which there is a camera that nobody took."""

MOST_UNSEEN = 60
"""Cameras that nobody took, at most: a hundred photographs have 1,350, which would cost the guard hours on a CPU."""


@dataclass(frozen=True)
class BoundingSphere:
    """The part of a model to look at: center (3,), float64, and radius, world units.

    With ``surroundings`` it is the middle of a place, such as a room, rather than a whole object.
    """

    center: Tensor
    radius: float
    surroundings: bool


def orbit_views(
    means: Tensor,
    opacities: Tensor,
    *,
    count: int,
    width: int,
    height: int,
    fill: float = 1.0,
    world: World = "y-down",
    arc: float = 2 * math.pi,
) -> list[Camera]:
    """Place cameras on a circle around a model, all looking at its center.

    The `bounding_sphere` of means and opacities spans the share ``fill``, in (0, 1], of the shorter side of the
    picture, whose sides are in pixels. In a y-down world the first camera of a full circle faces +z, looking slightly
    down, and the others follow at equal angles, moving towards +x. An ``arc`` below 2 pi, radians, is centered on that
    first camera and has one at both ends: a model captured from one side (LLFF) looks sensible on a small one only.

    Convention: the world is y down and z forward (OpenCV) unless told otherwise, as in most captures: a PLY file does
    not say where up is, nor do the axes of inertia (a plant is longest along it, a table shortest). Blender and
    nerfstudio have z up. The cameras are OpenCV.
    The renderer clips at depth 0.2: models with a radius below about 0.13 must be enlarged first.

    Errors are those of `bounding_sphere`.

    Example:
        >>> corners = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
        >>> cameras = orbit_views(corners, torch.ones(8), count=4, width=64, height=48)
        >>> len(cameras), [round(x, 2) for x in cameras[0].forward.tolist()]  # 20 degrees downwards
        (4, [0.0, 0.34, 0.94])
    """
    sphere = bounding_sphere(means, opacities)
    center, half_angle = sphere.center, math.atan(fill * math.tan(0.5 * FIELD_OF_VIEW))
    # At this distance the cone of view touches the sphere; the tangent in place of the sine would cut it.
    distance = sphere.radius / math.sin(half_angle)
    focal = 0.5 * min(width, height) / math.tan(0.5 * FIELD_OF_VIEW)
    level, lift = distance * math.cos(ELEVATION), distance * math.sin(ELEVATION)
    # With a camera at both ends, a full circle would have its first one twice.
    full = arc > 2 * math.pi * (1 - 1e-9)
    start, step = (0.0, arc / count) if full else (-0.5 * arc if count > 1 else 0.0, arc / max(1, count - 1))
    axes = _axes(world).to(center)
    cameras = []
    for turn in (start + step * i for i in range(count)):
        offset = center.new_tensor([level * math.sin(turn), -lift, -level * math.cos(turn)])
        pose = look_at(center + axes @ offset, center, axes[:, 1])
        cameras.append(Camera(pose.float(), focal, focal, width / 2, height / 2, width, height))
    return cameras


def bounding_sphere(means: Tensor, opacities: Tensor) -> BoundingSphere:
    """Find where the Gaussians of a model are, robust to a few stray ones.

    For an object, the center is that of the box between the quantiles 1 - `INSIDE` and `INSIDE` of each coordinate, and
    the radius is the quantile `INSIDE` of the distances from it. For a place with `SURROUNDINGS`, where that sphere
    would be the room, the center is the median and the radius is twice the median distance from it. Quantiles are
    weighted by the activated opacities, (N,) or (N, 1); the means (N, 3) are finite world coordinates.

    Raises:
        ValueError: if the opacity is all 0 or concentrated at one point.

    Example:
        >>> sphere = bounding_sphere(torch.tensor([[1.0, 0, 0], [3.0, 0, 0]]), torch.ones(2))
        >>> sphere.center.tolist(), sphere.radius, sphere.surroundings
        ([2.0, 0.0, 0.0], 1.0, False)
    """
    n = len(means)
    points, weights = means.detach().double(), opacities.detach().double().reshape(n)
    if not bool(weights.sum() > 0):
        raise ValueError(f"there is nothing to look at: {n} Gaussians with a total opacity of 0.")
    median = torch.stack([_quantile(axis, weights, 0.5) for axis in points.unbind(1)])
    near, far = (float(_quantile((points - median).norm(dim=1), weights, share)) for share in (0.5, INSIDE))
    if near > 0 and far > SURROUNDINGS * near:
        return BoundingSphere(median, 2 * near, surroundings=True)
    center = torch.stack(
        [(_quantile(axis, weights, 1 - INSIDE) + _quantile(axis, weights, INSIDE)) / 2 for axis in points.unbind(1)]
    )
    radius = float(_quantile((points - center).norm(dim=1), weights, INSIDE))
    if not radius > 0:
        raise ValueError(f"the {n} Gaussians span no volume: {INSIDE:.0%} of the opacity lie on one point.")
    return BoundingSphere(center, radius, surroundings=False)


def _axes(world: World) -> Tensor:
    """Return the rotation whose columns are the directions right, down and forward in this world."""
    vertical, sign = "xyz".index(world[0]), 1.0 if world.endswith("down") else -1.0
    down = torch.eye(3, dtype=torch.float64)[vertical] * sign
    right = torch.eye(3, dtype=torch.float64)[1 if vertical == 0 else 0]
    return torch.stack([right, down, torch.linalg.cross(right, down)], dim=1)


def _quantile(values: Tensor, weights: Tensor, share: float) -> Tensor:
    """Return the weighted quantile: the smallest value that, with all below it, holds this share of the weight."""
    ordered, order = values.sort()
    held = weights[order].cumsum(0)
    return ordered[torch.searchsorted(held, share * held[-1])]


def look_at(position: Tensor, target: Tensor, down: Tensor) -> Tensor:
    """Return the view matrix (4, 4) of a camera that looks at a target, upright."""
    forward = normalize(target - position, dim=0)
    right = normalize(torch.linalg.cross(down, forward), dim=0)
    pose = torch.eye(4, dtype=position.dtype, device=position.device)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


CameraPath = Literal["line", "arc"]


def pseudo_cameras(scene: Scene) -> Callable[[torch.Generator], Camera]:
    """Return a function that draws random cameras among the training cameras, as CoR-GS does on LLFF and DTU.

    Positions are uniform in the box that is centered on the mean training position, has its edges along the axes of the
    mean orientation and just reaches every training camera. All cameras look at the point on the mean optical axis at
    the depth ``1 / (0.25 / (0.9 near) + 0.75 / (5 far))``. Size and focal lengths are those of the first training
    camera, the principal point is the picture's center. ``near`` and ``far`` are the `depth_bounds` of the initial
    points; the sources read them from ``poses_bounds.npy``.

    Raises:
        ValueError: if no initial point lies in a training picture, or the viewing directions differ too much to have
            a mean, as around an object.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> draw = pseudo_cameras(synthetic_scene(width=32, height=24, points=50))
        >>> draw(torch.Generator().manual_seed(0)).width
        32
    """
    cameras = [view.camera for view in scene.train]
    rotations = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    positions = torch.stack([camera.position.double() for camera in cameras])
    down, forward = rotations[:, 1].mean(0), rotations[:, 2].mean(0)
    # The more unit vectors disagree, the shorter is their mean.
    if forward.norm() < 0.5:
        raise ValueError(
            f"pseudo views need training cameras that look to one side; the mean of their axes is {forward.norm():.2f} "
            "long and should be near 1: leave out what compares at pseudo views."
        )
    near, far = depth_bounds(scene)
    center = positions.mean(0)
    axes = look_at(center, center + forward, down)[:3, :3]
    reach = ((positions - center) @ axes.T).abs().amax(0)
    target = center + normalize(forward, dim=0) / (0.25 / (0.9 * near) + 0.75 / (5 * far))
    first = cameras[0]

    def draw(generator: torch.Generator) -> Camera:
        place = 2 * torch.rand(3, generator=generator, device=generator.device).to(reach) - 1
        pose = look_at(center + (place * reach) @ axes, target, down)
        cx, cy = first.width / 2, first.height / 2
        return replace(first, world_to_camera=pose.to(generator.device, first.world_to_camera.dtype), cx=cx, cy=cy)

    return draw


def cameras_between(
    scene: Scene, path: CameraPath = "arc", *, past: float = -0.15
) -> Callable[[torch.Generator], Camera]:
    """Return a function that draws cameras between two random training cameras, with the intrinsics of one of them.

    The path from one to the other is that of `camera_between`; ``past`` is how far beyond either end a camera may
    stand, as a share of it, by default 0.15 short of both. Raises ValueError if the scene has fewer than two training
    cameras.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> draw = cameras_between(synthetic_scene(width=32, height=24, points=50))
        >>> draw(torch.Generator().manual_seed(0)).width
        32
    """
    cameras = [view.camera for view in scene.train]
    if len(cameras) < 2:
        raise ValueError(f"virtual views lie between two training cameras, and {scene.name!r} has {len(cameras)}.")

    def draw(generator: torch.Generator) -> Camera:
        first, second = torch.randperm(len(cameras), generator=generator, device=generator.device)[:2].tolist()
        along = (1 + 2 * past) * torch.rand((), generator=generator, device=generator.device).item() - past
        return camera_between(cameras[first], cameras[second], along, path).to(generator.device)

    return draw


@torch.no_grad()
def camera_between(first: Camera, second: Camera, along: float, path: CameraPath = "line") -> Camera:
    """Return the first camera moved and turned towards the second; ``along`` is 0 at the first and 1 at the second.

    Orientations are interpolated along the great arc. Positions follow the straight line, or the ``"arc"`` of the screw
    motion between the poses: cameras that look at a common point from one distance move around it, facing it.

    Example:
        >>> pose = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # half a turn around the origin, 2 in front of both
        >>> one, other = (Camera(p, 9, 9, 4, 4, 8, 8) for p in (torch.eye(4), pose))
        >>> for camera in (one, other):
        ...     camera.world_to_camera[2, 3] = 2
        >>> for path in get_args(CameraPath):
        ...     [round(x, 3) for x in camera_between(one, other, 0.5, path).position.abs().tolist()]
        [0.0, 0.0, 0.0]
        [2.0, 0.0, 0.0]
    """
    from kornia.geometry.liegroup import Se3

    # The screw motion exp(s log(end start^-1)) start turns along the great arc at a steady rate. A line keeps that
    # rotation R and has its position p by t = -R p.
    start, end = (Se3.from_matrix(camera.world_to_camera.double()) for camera in (first, second))
    pose = (Se3.exp(along * (end * start.inverse()).log()) * start).matrix()
    if path == "line":
        pose[:3, 3] = -pose[:3, :3] @ torch.lerp(first.position, second.position, along).to(pose)
    return replace(first, world_to_camera=pose.to(first.world_to_camera))


VIRTUAL_VIEWS = {"box": pseudo_cameras} | {path: partial(cameras_between, path=path) for path in get_args(CameraPath)}
VIRTUAL_VIEWS["beyond"] = partial(cameras_between, past=0.5)
"""Where virtual cameras may stand, by name: functions from a scene to a function that draws such cameras."""


def depth_bounds(scene: Scene) -> tuple[float, float]:
    """Return the smallest and the largest depth of the initial points, robust to one outlier in a thousand per end.

    Convention: LLFF's ``poses_bounds.npy`` holds these two percentiles, 0.1 and 99.9, for every photograph.

    Raises:
        ValueError: if no initial point lies within a training picture.
    """
    seen = (view.camera.depths_of(scene.points.positions) for view in scene.train)
    bounds = [depths.quantile(depths.new_tensor([0.001, 0.999])).tolist() for depths in seen if len(depths)]
    if not bounds:
        raise ValueError(f"scene {scene.name!r} has no initial point in a training picture: give other points.")
    return min(near for near, _ in bounds), max(far for _, far in bounds)


def interpolate_cameras(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Move through cameras in order, in equal steps: positions along straight lines, orientations along great arcs.

    ``frames`` includes the first and the last camera; intrinsics and size are those of the first. Raises ValueError if
    there are fewer than two cameras or frames.

    Example:
        >>> first = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> pose = torch.eye(4)
        >>> pose[0, 3] = 1.0
        >>> [c.position[0].item() for c in interpolate_cameras([first, replace(first, world_to_camera=pose)], 3)]
        [0.0, -0.5, -1.0]
    """
    if len(cameras) < 2 or frames < 2:
        raise ValueError(f"a path needs at least 2 cameras and 2 frames, got {len(cameras)} and {frames}.")
    path = []
    for along in torch.linspace(0, len(cameras) - 1, frames).tolist():
        i = min(int(along), len(cameras) - 2)
        pose = camera_between(cameras[i], cameras[i + 1], along - i).world_to_camera
        path.append(replace(cameras[0], world_to_camera=pose))
    return path


def measured_views(scene: Scene) -> dict[str, Sequence[Viewpoint]]:
    """Return the views of a scene that a model is measured at, by split: ``"train"`` and ``"test"``.

    If all photographs are trained on, viewpoints without one replace the test views, and the log says so:
    ``"between"``, halfway from each training camera to its nearest neighbor, and ``"around"``, as far in the opposite
    direction. Orientations are inter- and extrapolated alike. A single camera has neither.
    """
    if scene.test:
        return {"train": scene.train, "test": scene.test}
    _log.info(
        "No test views: no quality at unseen views, only what needs no photograph there, such as exact CA, measured "
        "between and around the training views."
    )
    cameras = [view.camera for view in scene.train]
    if len(cameras) < 2:
        return {"train": scene.train}
    nearest = [first for (first,) in _nearest(cameras, 1)]
    # Two cameras that are nearest to each other have one middle, but each its own continuation.
    pairs = sorted({(min(pair), max(pair)) for pair in enumerate(nearest)})
    new = {
        "between": [camera_between(cameras[i], cameras[j], 0.5) for i, j in pairs],
        "around": [camera_between(cameras[i], cameras[j], -0.5) for i, j in enumerate(nearest)],
    }
    numbered = {split: [Viewpoint(f"{i:03d}", camera) for i, camera in enumerate(of)] for split, of in new.items()}
    return {"train": scene.train, **numbered}


def unseen_views(scene: Scene) -> list[Viewpoint]:
    """Return cameras that nobody took: between every two training cameras, and beyond each, away from the other.

    They stand at a quarter, a half and three quarters of the way, and as far beyond as a third, two thirds and all of
    it, on the arc of the screw motion: around what the cameras look at, or along a line if they look the same way. Each
    training camera is paired with its two nearest. Of more than `MOST_UNSEEN` so many are returned, spread evenly.

    Raises:
        ValueError: if there are fewer than two training cameras.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> views = unseen_views(synthetic_scene(width=32, height=24, points=50))
        >>> len(views), views[0].name, views[-1].name
        (27, 'between train_0 and train_1', 'beyond train_2, away from train_1')
    """
    if len(scene.train) < 2:
        raise ValueError(f"there is no camera between or beyond {len(scene.train)} training views: it takes two.")
    cameras, names = [view.camera for view in scene.train], [view.name for view in scene.train]
    pairs = sorted({pair for i, of in enumerate(_nearest(cameras, 2)) for j in of for pair in ((i, j), (j, i))})
    ways = [
        (f"between {names[i]} and {names[j]}", i, j, along) for i, j in pairs if i < j for along in (0.25, 0.5, 0.75)
    ]
    ways += [
        (f"beyond {names[i]}, away from {names[j]}", i, j, -along) for i, j in pairs for along in (1 / 3, 2 / 3, 1.0)
    ]
    return [
        Viewpoint(name, camera_between(cameras[i], cameras[j], along, "arc")) for name, i, j, along in _spread(ways)
    ]


def amid_views(scene: Scene, neighbors: int = NEIGHBORS) -> list[Viewpoint]:
    """Return cameras that nobody took amid neighbors of more than `FEW_CAMERAS` training cameras; of fewer, none.

    They stand amid every training camera and two of its nearest ``neighbors``: a third of the way from the middle of
    the first two to the last. Of more than `MOST_UNSEEN` so many are returned, spread evenly.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> amid_views(synthetic_scene(width=32, height=24, points=50, train_views=11))[0].name
        'amid train_0, train_1 and train_2'
    """
    cameras, names = [view.camera for view in scene.train], [view.name for view in scene.train]
    if len(cameras) <= FEW_CAMERAS:
        return []
    near = _nearest(cameras, neighbors)
    triples = sorted({tuple(sorted((i, *pair))) for i, of in enumerate(near) for pair in combinations(of, 2)})
    found = []
    for i, j, k in _spread(triples):
        middle = camera_between(cameras[i], cameras[j], 0.5, "arc")
        amid = camera_between(middle, cameras[k], 1 / 3, "arc")
        found.append(Viewpoint(f"amid {names[i]}, {names[j]} and {names[k]}", amid))
    return found


def _nearest(cameras: Sequence[Camera], count: int) -> list[list[int]]:
    """Return the numbers of so many others nearest to each camera, or of all others."""
    positions = torch.stack([camera.position for camera in cameras])
    numbers: list[list[int]] = nearest_neighbors(positions, min(count, len(cameras) - 1))[1].tolist()
    return numbers


def _spread(items: Sequence[T]) -> list[T]:
    """Return at most `MOST_UNSEEN` items, evenly through the list: so no region of many photographs is left out."""
    chosen = torch.linspace(0, len(items) - 1, min(len(items), MOST_UNSEEN)).round().int().tolist()
    return [items[number] for number in chosen]
