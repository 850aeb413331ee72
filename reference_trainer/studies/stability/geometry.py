"""Stability cases on the shape, size and position of Gaussians, and on the camera."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.studies.stability.case import Case, Probe, decades, of_scene, single
from reference_trainer.studies.stability.quantities import reference_quantities, scene_quantities
from reference_trainer.studies.stability.scenes import StressScene, base_scene, camera_of

__all__ = ["geometry_cases"]

_SHAPE, _PLACE, _CAMERA = "shape and size", "place", "camera and image"
_RATIOS = (2.0, *decades(1, 8))
_FOCALS = (1.0, 10.0, *decades(2, 6))
_SIZES = ((1, 1), (1, 64), (64, 1), (4096, 4), (4, 4096))


def geometry_cases() -> list[Case]:
    """Return the cases; magnitudes are axis ratios, factors, distances, pixels or focal lengths, as the names say."""
    return [
        Case(_SHAPE, "needles, axis ratio, thin axes shrink", lambda x: _axes(0.3, 0.3 / x, 0.3 / x), _RATIOS),
        Case(_SHAPE, "pancakes, axis ratio, thin axis shrinks", lambda x: _axes(0.3, 0.3, 0.3 / x), _RATIOS),
        Case(
            _SHAPE, "needles, axis ratio, long axis grows",
            # Against the renderer itself in float64: tests in decimal arithmetic find the other reference inexact here.
            lambda x: _axes(0.02 * x, 0.02, 0.02, independent=False), _RATIOS,
        ),
        Case(_SHAPE, "pancakes, axis ratio, long axes grow", lambda x: _axes(0.02 * x, 0.02 * x, 0.02), _RATIOS),
        Case(_SHAPE, "scales divided by", lambda x: _scaled(1 / x), decades(0, 12)),
        Case(_SHAPE, "scales multiplied by", _scaled, decades(0, 6)),
        Case(
            _SHAPE, "scales multiplied by, beyond any scene", _scaled, decades(7, 21, 2), until=1e9,
            note="gradients of what is flat over the whole image; refused where squares overflow",
        ),
        single(_SHAPE, "scales of 0", partial(_scaled, 0.0)),
        Case(_SHAPE, "norm of the quaternions", _quaternions, decades(0, 36, 6)),
        Case(_SHAPE, "quaternions divided by", lambda x: _quaternions(1 / x), decades(0, 36, 6)),
        single(_SHAPE, "quaternions of 0: no rotation", _no_rotation),
        Case(_PLACE, "in front of the near plane by 1 / x of it", lambda x: _at_depth(0.2 + 0.2 / x), decades(0, 6)),
        Case(_PLACE, "behind the near plane by 1 / x of it", lambda x: _at_depth(0.2 - 0.2 / x), decades(0, 6)),
        Case(_PLACE, "behind the camera by", lambda x: _at_depth(-x), decades(-6, 6, 3)),
        single(_PLACE, "on the border of the image", _on_border),
        Case(_PLACE, "beside the image, pixels, as wide as that", _beside, decades(0, 6)),
        Case(_PLACE, "beside the image, pixels, ordinary width", lambda x: _beside(x, sigma=3.0), decades(0, 6)),
        Case(_PLACE, "depth and size multiplied by", _far, decades(0, 12)),
        Case(
            _PLACE, "world offset, scene sizes", _offset, decades(0, 8), until=1e3,
            note="float32 has 7 digits: recenter the scene; refused from a quarter of a pixel on",
        ),
        Case(_CAMERA, "focal length, scene shrinks with the field of view", _telephoto, _FOCALS),
        Case(_CAMERA, "focal length, camera backs away", _backs_away, _FOCALS),
        *(single(_CAMERA, f"{width}x{height} pixels", partial(_sized, width, height)) for width, height in _SIZES),
    ]  # fmt: skip


def _axes(a: float, b: float, c: float, *, independent: bool = True) -> Probe:
    """Give all Gaussians the same axis lengths; their orientations are random."""
    axes = torch.tensor([[a, b, c]], dtype=torch.float64)
    return of_scene(replace(base_scene(), scales=axes.expand(24, 3)), independent=independent)


def _scaled(factor: float) -> Probe:
    scene = base_scene()
    return of_scene(replace(scene, scales=scene.scales * factor))


def _quaternions(norm: float) -> Probe:
    scene = base_scene()
    return of_scene(replace(scene, quaternions=scene.quaternions / scene.quaternions.norm(dim=1, keepdim=True) * norm))


def _no_rotation() -> Probe:
    """Compare zero quaternions with the identity; their gradient is defined as 0."""
    scene = base_scene().rounded()
    zero = torch.zeros_like(scene.quaternions)
    identity = replace(scene, quaternions=zero + torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))
    return Probe(
        lambda: scene_quantities(replace(scene, quaternions=zero), torch.float32),
        lambda: {**reference_quantities(identity), "d quaternions": zero},
    )


def _replaced(point: Tensor, scale: float, scene: StressScene) -> Probe:
    """Move the first Gaussian of a scene to a point in camera coordinates and make it isotropic, of a given scale."""
    pose = scene.camera.world_to_camera
    means, scales = scene.means.clone(), scene.scales.clone()
    means[0] = pose[:3, :3].T @ (point - pose[:3, 3])
    scales[0] = scale
    return of_scene(replace(scene, means=means, scales=scales))


def _at_depth(depth: float) -> Probe:
    """Put a Gaussian near the optical axis; the camera looks along world z, so that no rotation rounds its depth."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 38.0, 15.0, 12.7, 32, 24)
    scene = base_scene(camera=camera)
    ahead = scene.means + torch.tensor([0.0, 0, 3], dtype=torch.float64)
    return _replaced(torch.tensor([0.01, -0.02, depth], dtype=torch.float64), 0.02, replace(scene, means=ahead))


def _on_border() -> Probe:
    """Put Gaussians on the four edges and the four corners of the image."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 32.0, 32.0, 16.0, 12.0, 32, 24)
    pixels = [(0, 0), (32, 0), (0, 24), (32, 24), (16, 0), (16, 24), (0, 12), (32, 12)]
    depths = 2.0 + 0.125 * torch.arange(8, dtype=torch.float64)
    slopes = (torch.tensor(pixels, dtype=torch.float64) - torch.tensor([16.0, 12.0])) / 32.0
    means = torch.cat([slopes * depths[:, None], depths[:, None]], dim=1)
    return of_scene(replace(base_scene(8, camera=camera), means=means))


def _beside(pixels: float, sigma: float | None = None) -> Probe:
    """Put a Gaussian outside the image, by default so wide that it still reaches in."""
    camera = camera_of()
    width = pixels if sigma is None else sigma
    slope = (pixels + camera.width - camera.cx) / camera.fx
    return _replaced(3.0 * torch.tensor([slope, 0.05, 1.0]).double(), 3.0 * width / camera.fx, base_scene())


def _far(factor: float) -> Probe:
    """Scale the scene and its distance: the same picture, at large depths."""
    scene = base_scene()
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] *= factor
    camera = replace(scene.camera, world_to_camera=pose)
    return of_scene(replace(scene, means=scene.means * factor, scales=scene.scales * factor, camera=camera))


def _offset(offset: float) -> Probe:
    """Shift scene and camera in the world; the reference stays unrounded, because float32's rounding is the subject."""
    scene = base_scene().rounded()
    shift = offset * torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ shift
    moved = replace(scene, means=scene.means + shift, camera=replace(scene.camera, world_to_camera=pose))
    return Probe(lambda: scene_quantities(moved, torch.float32), lambda: reference_quantities(moved))


def _telephoto(focal: float) -> Probe:
    """Shrink the scene across the optical axis as the focal length grows, so that it fills the image."""
    scene = base_scene(camera=Camera(torch.eye(4, dtype=torch.float64), focal, focal, 15.0, 12.7, 32, 24))
    across = torch.tensor([40.0 / focal, 40.0 / focal, 1.0], dtype=torch.float64)
    means = scene.means * across + torch.tensor([0.0, 0, 3], dtype=torch.float64)
    return of_scene(replace(scene, means=means, scales=scene.scales * min(40.0 / focal, 4.0)))


def _backs_away(focal: float) -> Probe:
    """Move the camera away as the focal length grows."""
    distance = math.ceil(3.0 * max(focal / 40.0, 0.5))
    return of_scene(base_scene(camera=camera_of(focal=focal, distance=distance)))


def _sized(width: int, height: int) -> Probe:
    return of_scene(base_scene(camera=camera_of(width, height, focal=40.0 * max(1.0, max(width, height) / 32))))
