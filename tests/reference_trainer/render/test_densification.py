"""Radii against the rule of the INRIA code, and absolute gradients against a sum over pixels."""

import math

import pytest
import torch
from oracles import random_scene

from reference_trainer.render import rasterize, render, splat
from reference_trainer.render.densification import in_front, visible_radii, with_absolute_gradients


def _definition(mean, quaternion, scale, camera) -> int:
    """Radius and visibility of one Gaussian, from the definitions."""
    local = camera.world_to_camera[:3, :3] @ mean + camera.world_to_camera[:3, 3]
    x, y, z = local.tolist()
    if z <= 0.2:
        return 0
    w, i, j, k = (quaternion / quaternion.norm()).tolist()
    skew = torch.tensor([[0, -k, j], [k, 0, -i], [-j, i, 0]]).double()
    rotation = torch.eye(3).double() + 2 * w * skew + 2 * skew @ skew
    covariance = rotation @ torch.diag(scale**2) @ rotation.T
    limit_x, limit_y = 0.65 * camera.width / camera.fx, 0.65 * camera.height / camera.fy
    u, v = min(limit_x, max(-limit_x, x / z)), min(limit_y, max(-limit_y, y / z))
    jacobian = torch.tensor([[camera.fx / z, 0, -camera.fx * u / z], [0, camera.fy / z, -camera.fy * v / z]]).double()
    chain = jacobian @ camera.world_to_camera[:3, :3]
    small, large = torch.linalg.eigvalsh(chain @ covariance @ chain.T + 0.3 * torch.eye(2).double()).tolist()
    middle, spread = 0.5 * (large + small), 0.5 * (large - small)
    radius = math.ceil(3 * math.sqrt(middle + math.sqrt(max(0.1, spread**2))))
    center = (camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5)
    meets = all(
        any(16 * tile + 1 <= c + radius and 16 * tile + 16 > c - radius for tile in range(math.ceil(size / 16)))
        for c, size in zip(center, (camera.width, camera.height), strict=True)
    )
    return radius if meets else 0


@pytest.mark.parametrize("size", [0.002, 0.05, 0.3])
def test_radii_equal_the_definition(size):
    scene = random_scene(150, 70, 45, seed=2, size=size)
    means = scene.means * 1.6  # so that many lie off the picture
    radii = visible_radii(means, scene.quaternions, scene.scales, scene.camera)
    expected = [_definition(*rows, scene.camera) for rows in zip(means, scene.quaternions, scene.scales, strict=True)]
    assert radii.dtype == torch.int32
    assert radii.tolist() == expected
    assert 0 < expected.count(0) < 150


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_has_the_radii_of_its_numbers(dtype):
    """As the picture has: in half precision itself a large splat's variance is infinite, and its radius -2147483648."""
    scene = random_scene(150, 700, 450, seed=2, size=0.3)
    means, quaternions, scales = (x.to(dtype) for x in (1.6 * scene.means, scene.quaternions, scene.scales))
    expected = visible_radii(means.float(), quaternions.float(), scales.float(), scene.camera)
    assert expected.max() > 3_000
    assert torch.equal(visible_radii(means, quaternions, scales, scene.camera), expected)
    assert torch.equal(visible_radii(means.float(), quaternions, scales, scene.camera), expected)


def test_the_radius_of_a_diverged_gaussian_is_no_negative_number():
    scene = random_scene(30, 20, 20, seed=3)
    means = torch.zeros_like(scene.means)
    radii = visible_radii(means, scene.quaternions, 1e10 * torch.ones_like(means), scene.camera)
    assert radii.tolist() == [2**31 - 128] * 30


def test_in_front_is_the_near_plane():
    scene = random_scene(60, 20, 20, seed=3)
    depths = [(scene.camera.world_to_camera[:3, :3] @ x + scene.camera.world_to_camera[:3, 3])[2] for x in scene.means]
    assert in_front(scene.means, scene.camera).tolist() == [bool(z > 0.2) for z in depths]


WIDTH, HEIGHT = 13, 9  # more than one tile, not of whole tiles


def picture(rendering):
    return torch.cat([rendering.image, rendering.depth[None], rendering.alpha[None]])


def test_every_pixel_adds_the_absolute_value_of_its_gradient(case):
    exact = random_scene(30, WIDTH, HEIGHT, seed=21, size=0.2)
    upstream = torch.randn(5, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    background = torch.tensor([0.3, 0.1, 0.8], dtype=torch.float64)
    splats = splat(*exact[:4], exact.camera, colors=exact.colors)
    means = splats.projection.means.detach().requires_grad_()
    moved = splats._replace(projection=splats.projection._replace(means=means))
    of_pixels = (picture(rasterize(moved, background=background, depth=True)) * upstream).sum(0).flatten()
    each = torch.stack([torch.autograd.grad(x, means, retain_graph=True)[0] for x in of_pixels])

    scene = exact.to(case.dtype)
    rendering = render(*scene[:4], scene.camera, colors=scene.colors, background=background.to(case.dtype), depth=True)
    sink = torch.zeros_like(rendering.splats.projection.means).requires_grad_()
    out = with_absolute_gradients(rendering, sink, background.to(case.dtype))
    assert torch.equal(picture(out), picture(rendering))
    (picture(out) * upstream.to(case.dtype)).sum().backward()
    assert rendering.splats.engine.name == case.engine
    case.same_gradient(sink.grad, each.abs().sum(0))
    assert (each.abs().sum(0) > 1.5 * each.sum(0).abs()).any()  # signs differ between the pixels
