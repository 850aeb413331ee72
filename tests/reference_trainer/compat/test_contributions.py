"""The scores of Taming 3DGS against the brute-force renderer's weights, pixel by pixel."""

import torch
from oracles import brute_force, random_scene

from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.render.torch.projection import project


def test_scores_are_sums_over_the_pixels_at_which_a_gaussian_is_drawn(settings_of):
    n, width, height = 30, 21, 17
    scene = random_scene(n, width, height, seed=11, size=0.05)
    image = torch.rand(height, width, generator=torch.Generator().manual_seed(1)).double()
    rasterizer = rasterizer_module("diff_gaussian_rasterization").GaussianRasterizer(
        settings_of(scene.camera, pixel_weights=image)
    )
    _, radii, depths, my_radii, accum_weights, accum_count, accum_blend, accum_dist = rasterizer(
        means3D=scene.means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
        colors_precomp=scene.colors, scales=scene.scales, rotations=scene.quaternions,
    )  # fmt: skip
    weights, _ = brute_force(*scene[:4], torch.eye(n).double(), scene.camera)
    drawn = weights > 0
    local = scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3]
    front = local[:, 2] > 0.2
    centers = torch.zeros(n, 2).double()
    centers[front] = project(scene.means[front], scene.quaternions[front], scene.scales[front], scene.camera).means
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    distances = torch.hypot(columns - centers[:, 0, None, None], rows - centers[:, 1, None, None])
    torch.testing.assert_close(accum_blend, weights.sum((1, 2)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(accum_count, drawn.sum((1, 2)).double(), rtol=0, atol=0)
    torch.testing.assert_close(accum_weights, (drawn * image).sum((1, 2)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(accum_dist, (drawn * distances).sum((1, 2)), rtol=1e-9, atol=1e-9)
    seen = accum_count > 0
    torch.testing.assert_close(depths[seen], local[seen, 2], rtol=1e-12, atol=0)
    assert 5 < seen.sum() < n
    assert torch.equal(my_radii, radii)


def test_pixels_are_those_at_which_a_gaussian_is_drawn(settings_of):
    scene = random_scene(30, 21, 17, seed=11, size=0.05)
    rasterizer = rasterizer_module("diff_gaussian_rasterization").GaussianRasterizer(settings_of(scene.camera))
    _, _, pixels = rasterizer(
        means3D=scene.means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
        colors_precomp=scene.colors, scales=scene.scales, rotations=scene.quaternions,
    )  # fmt: skip
    weights, _ = brute_force(*scene[:4], torch.eye(30).double(), scene.camera)
    assert torch.equal(pixels, (weights > 0).sum((1, 2))[:, None].double())
