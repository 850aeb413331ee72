"""The planes of surfels against the brute-force renderer's weights, pixel by pixel."""

import itertools

import torch
from oracles import brute_force, random_scene

from reference_trainer.compat.rasterizer import rasterizer_module


def test_depth_normals_and_distortion_are_sums_over_the_weights(settings_of):
    n, width, height = 12, 14, 9
    scene = random_scene(n, width, height, seed=5, size=0.2)
    flat = scene._replace(scales=scene.scales * torch.tensor([1.0, 1.0, 0.0]))
    rasterizer = rasterizer_module("diff_surfel_rasterization").GaussianRasterizer(settings_of(scene.camera))
    image, radii, allmap = rasterizer(
        means3D=scene.means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
        colors_precomp=scene.colors, scales=scene.scales[:, :2], rotations=scene.quaternions,
    )  # fmt: skip
    torch.testing.assert_close(image, brute_force(*flat)[0], rtol=0, atol=1e-9)
    assert radii.shape == (n,)

    weights, alpha = brute_force(*flat[:4], torch.eye(n).double(), scene.camera)
    pose = scene.camera.world_to_camera
    local = scene.means @ pose[:3, :3].T + pose[:3, 3]
    w, x, y, z = torch.nn.functional.normalize(scene.quaternions).unbind(1)
    normals = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1) @ pose[:3, :3].T
    normals = normals * -(normals * local).sum(1, keepdim=True).sign()  # to the camera
    mapped = 100 / (100 - 0.2) * (1 - 0.2 / local[:, 2])
    distortion = sum(
        weights[i] * weights[j] * (mapped[i] - mapped[j]) ** 2 for i, j in itertools.combinations(range(n), 2)
    )
    depth = torch.einsum("nhw,n->hw", weights, local[:, 2])
    torch.testing.assert_close(allmap[0], depth, rtol=0, atol=1e-9)
    torch.testing.assert_close(allmap[1], alpha, rtol=0, atol=1e-9)
    torch.testing.assert_close(allmap[2:5], torch.einsum("nhw,nc->chw", weights, normals), rtol=0, atol=1e-9)
    seen = alpha > 0
    torch.testing.assert_close(allmap[5][seen], (depth / alpha)[seen], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(allmap[6], distortion, rtol=0, atol=1e-9)
    assert allmap[6].max() > 1e-4


def test_pixels_without_surfels_have_no_gradient_that_is_nan(settings_of):
    scene = random_scene(4, 30, 20, seed=5, size=0.05)
    rasterizer = rasterizer_module("diff_surfel_rasterization").GaussianRasterizer(settings_of(scene.camera))
    means, quaternions = scene.means.clone().requires_grad_(), scene.quaternions.clone().requires_grad_()
    _, _, allmap = rasterizer(
        means3D=means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
        colors_precomp=scene.colors, scales=scene.scales[:, :2], rotations=quaternions,
    )  # fmt: skip
    torch.nan_to_num(allmap / allmap[1:2]).square().sum().backward()
    assert (allmap[1] == 0).any()
    assert means.grad.isfinite().all()
    assert means.grad.any()
    assert quaternions.grad.isfinite().all()
