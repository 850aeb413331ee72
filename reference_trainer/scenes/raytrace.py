"""A small ray tracer for textured Lambertian surfaces with soft shadows and exact depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes.textures import Texture

__all__ = ["Box", "Round", "Solid", "nearest_hit", "render_solids"]

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
