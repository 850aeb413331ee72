"""A small ray tracer for textured, matt surfaces with soft shadows; it knows the exact depth of every pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes.textures import Texture

__all__ = ["Box", "Cylinder", "Plane", "Solid", "Sphere", "nearest_hit", "render_solids"]

SAMPLES = 3  # a side per pixel; odd, so that one ray passes through the pixel centre and gives its depth
SHADOW_OFFSET = 1e-3  # shadow rays start this far off the surface, lest rounding make it shadow itself
AMBIENT = 0.3
GAMMA = 2.2


class Solid(Protocol):
    """A surface that rays can hit."""

    @property
    def texture(self) -> Texture:
        """The reflectance of its points."""
        ...

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Return the ray parameters (R,) of the first hits in front of the origins, inf for none."""
        ...

    def normals(self, points: Tensor) -> Tensor:
        """Return the outward unit normals (R, 3) at surface points (R, 3)."""
        ...


def _first_root(a: Tensor, half_b: Tensor, c: Tensor) -> Tensor:
    """Smallest positive root of ``a t^2 + 2 half_b t + c = 0``, inf where there is none."""
    disc = half_b * half_b - a * c
    root = disc.clamp_min(0).sqrt()
    near, far = (-half_b - root) / a, (-half_b + root) / a
    t = torch.where(near > 0, near, far)
    return torch.where((disc > 0) & (t > 0), t, torch.inf)


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    center: tuple[float, float, float]
    radius: float
    texture: Texture

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """See ``Solid``."""
        offset = origins - origins.new_tensor(self.center)
        a, half_b = directions.square().sum(1), (offset * directions).sum(1)
        return _first_root(a, half_b, offset.square().sum(1) - self.radius**2)

    def normals(self, points: Tensor) -> Tensor:
        """See ``Solid``."""
        return (points - points.new_tensor(self.center)) / self.radius


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder without ends, between two heights."""

    x: float
    z: float
    radius: float
    top: float
    bottom: float
    texture: Texture

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """See ``Solid``."""
        ox, oz = origins[:, 0] - self.x, origins[:, 2] - self.z
        dx, dz = directions[:, 0], directions[:, 2]
        t = _first_root(dx * dx + dz * dz, ox * dx + oz * dz, ox * ox + oz * oz - self.radius**2)
        y = origins[:, 1] + t * directions[:, 1]
        return torch.where((y > self.top) & (y < self.bottom), t, torch.inf)

    def normals(self, points: Tensor) -> Tensor:
        """See ``Solid``."""
        across = points - points.new_tensor([self.x, 0.0, self.z])
        across[:, 1] = 0
        return across / self.radius


@dataclass(frozen=True)
class Plane:
    """An endless plane: the points with ``normal . x = offset``."""

    normal: tuple[float, float, float]
    offset: float
    texture: Texture

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """See ``Solid``."""
        normal = origins.new_tensor(self.normal)
        t = (self.offset - origins @ normal) / (directions @ normal)
        return torch.where(t > 0, t, torch.inf)

    def normals(self, points: Tensor) -> Tensor:
        """See ``Solid``."""
        return points.new_tensor(self.normal).expand_as(points)


@dataclass(frozen=True)
class Box:
    """A box turned about the vertical axis by ``turn`` radians."""

    center: tuple[float, float, float]
    half_size: tuple[float, float, float]
    turn: float
    texture: Texture

    def _axes(self, like: Tensor) -> Tensor:
        """Rows: the box's axes in world coordinates."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        return like.new_tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])

    def local(self, points: Tensor) -> Tensor:
        """Return world points (R, 3) in the box's own coordinates, centred and along its axes."""
        return (points - points.new_tensor(self.center)) @ self._axes(points).T

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        """See ``Solid``."""
        offset, along = self.local(origins), directions @ self._axes(directions).T
        half = origins.new_tensor(self.half_size)
        one, other = (-half - offset) / along, (half - offset) / along
        enter = torch.minimum(one, other).amax(1)
        leave = torch.maximum(one, other).amin(1)
        return torch.where((enter < leave) & (enter > 0), enter, torch.inf)

    def normals(self, points: Tensor) -> Tensor:
        """See ``Solid``."""
        share = self.local(points) / points.new_tensor(self.half_size)
        face = share.abs().argmax(1, keepdim=True)
        return torch.zeros_like(share).scatter(1, face, share.gather(1, face).sign()) @ self._axes(points)


def nearest_hit(solids: Sequence[Solid], origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Intersect rays with solids.

    Args:
        solids: the surfaces.
        origins: where the rays start, shape (R, 3).
        directions: where they go, any length, shape (R, 3).

    Returns:
        The ray parameters of the nearest hits, shape (R,), inf for none, and the numbers of the solids, shape (R,).
    """
    return torch.stack([solid.intersect(origins, directions) for solid in solids]).min(0)


def render_solids(camera: Camera, solids: Sequence[Solid], light: Tensor) -> tuple[Tensor, Tensor]:
    """Render solids, 3x3 rays a pixel.

    Surfaces are matt, so their colour does not depend on the view. The light is a small square; each of a pixel's nine
    rays sees another of its nine points, which makes the shadows soft.

    Args:
        camera: the camera.
        solids: the surfaces.
        light: positions of the nine points of the light, shape (9, 3).

    Returns:
        The image, shape (3, H, W), in [0, 1], black where nothing is hit, and the depth along the camera's z axis of
        the surface at each pixel centre, shape (H, W), 0 where nothing is hit; float32.
    """
    pose = camera.world_to_camera.to(torch.float32)
    steps = (torch.arange(SAMPLES) + 0.5) / SAMPLES
    shape = (camera.height, camera.width, SAMPLES, SAMPLES)
    y = (torch.arange(camera.height)[:, None, None, None] + steps[:, None]).expand(shape)
    x = (torch.arange(camera.width)[:, None, None] + steps).expand(shape)
    local = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones(shape)], dim=-1)
    directions = local.reshape(-1, 3) @ pose[:3, :3]
    origins = camera.position.to(torch.float32).expand_as(directions)
    t, index = nearest_hit(solids, origins, directions)  # directions have unit z in the camera, so t is the depth
    radiance = torch.zeros_like(directions)
    targets = light.repeat(camera.height * camera.width, 1)
    for number, solid in enumerate(solids):
        mine = (index == number) & t.isfinite()
        points = origins[mine] + t[mine, None] * directions[mine]
        normals = solid.normals(points)
        start = points + SHADOW_OFFSET * normals
        to_light = targets[mine] - start
        lit = nearest_hit(solids, start, to_light)[0] > 1
        cosine = (normals * torch.nn.functional.normalize(to_light, dim=1)).sum(1).clamp_min(0)
        radiance[mine] = solid.texture(points) * (AMBIENT + (1 - AMBIENT) * cosine * lit)[:, None]
    image = radiance.reshape(camera.height, camera.width, SAMPLES**2, 3).mean(2).clamp(0, 1).pow(1 / GAMMA)
    depth = t.reshape(camera.height, camera.width, SAMPLES**2)[:, :, SAMPLES**2 // 2]
    return image.permute(2, 0, 1).contiguous(), torch.where(depth.isfinite(), depth, 0)
