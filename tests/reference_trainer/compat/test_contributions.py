"""The scores of Taming 3DGS against the brute-force renderer's weights, pixel by pixel."""

import torch
from oracles import brute_force, random_scene

from reference_trainer.camera import Camera
from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.render.torch.projection import project


def test_scores_are_sums_over_the_pixels_at_which_a_gaussian_is_rendered(settings_of):
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
    covered = weights > 0
    local = scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3]
    front = local[:, 2] > 0.2
    centers = torch.zeros(n, 2).double()
    centers[front] = project(scene.means[front], scene.quaternions[front], scene.scales[front], scene.camera).means
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    distances = torch.hypot(columns - centers[:, 0, None, None], rows - centers[:, 1, None, None])
    torch.testing.assert_close(accum_blend, weights.sum((1, 2)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(accum_count, covered.sum((1, 2)).double(), rtol=0, atol=0)
    torch.testing.assert_close(accum_weights, (covered * image).sum((1, 2)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(accum_dist, (covered * distances).sum((1, 2)), rtol=1e-9, atol=1e-9)
    seen = accum_count > 0
    torch.testing.assert_close(depths[seen], local[seen, 2], rtol=1e-12, atol=0)
    assert 5 < seen.sum() < n
    assert torch.equal(my_radii, radii)


def test_pixels_are_those_at_which_a_gaussian_is_rendered(settings_of):
    scene = random_scene(30, 21, 17, seed=11, size=0.05)
    rasterizer = rasterizer_module("diff_gaussian_rasterization").GaussianRasterizer(settings_of(scene.camera))
    _, _, pixels = rasterizer(
        means3D=scene.means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
        colors_precomp=scene.colors, scales=scene.scales, rotations=scene.quaternions,
    )  # fmt: skip
    weights, _ = brute_force(*scene[:4], torch.eye(30).double(), scene.camera)
    assert torch.equal(pixels, (weights > 0).sum((1, 2))[:, None].double())


def test_what_antialiasing_makes_invisible_is_rendered_at_no_pixel(settings_of):
    """Specks in the very middle of pixels, as pixel-aligned models have: there alone rounding could decide."""
    camera = Camera(torch.eye(4), 40.0, 40.0, 20.0, 20.0, 40, 40)
    rows, columns = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    means = camera.lift(torch.stack([columns, rows], -1), torch.full((40, 40), 2.0)).reshape(-1, 3)
    module = rasterizer_module("diff_gaussian_rasterization", outputs=("image", "alpha", "radii", "pixels"))
    _, alpha, radii, pixels = module.GaussianRasterizer(settings_of(camera, antialiasing=True))(
        means3D=means, means2D=torch.zeros_like(means), opacities=torch.full((1600, 1), 0.5),
        colors_precomp=torch.ones(1600, 3), scales=torch.full((1600, 3), 1e-5),
        rotations=torch.eye(4)[:1].repeat(1600, 1),
    )  # fmt: skip
    assert (radii > 0).all()
    assert not alpha.any()
    assert not pixels.any()


def _weights(scene):
    return brute_force(*scene[:4], torch.eye(30).double(), scene.camera)[0]


def test_pixels_of_a_map_are_counted_where_a_gaussian_is_rendered(settings_of):
    """As FastGS does, if its flag is set."""
    scene = random_scene(30, 21, 17, seed=11, size=0.05)
    chosen = torch.rand(17, 21, generator=torch.Generator().manual_seed(3)) > 0.6
    for flag in (True, None):
        settings = settings_of(scene.camera, get_flag=flag, metric_map=chosen.int().flatten())
        rasterizer = rasterizer_module("diff_gaussian_rasterization_fastgs").GaussianRasterizer(settings)
        _, _, accum_metric_counts = rasterizer(
            means3D=scene.means, means2D=torch.zeros(30, 4), opacities=scene.opacities[:, None],
            colors_precomp=scene.colors, scales=scene.scales, rotations=scene.quaternions,
        )  # fmt: skip
        expected = ((_weights(scene) > 0) & chosen).sum((1, 2)) if flag else torch.zeros(30)
        assert torch.equal(accum_metric_counts, expected.int())
    assert ((_weights(scene) > 0) & chosen).any()


def test_every_pixel_names_the_gaussian_of_the_largest_weight(settings_of):
    """As LoopSparseGS asks; some pixels show none."""
    scene = random_scene(30, 21, 17, seed=11, size=0.05)
    rasterizer = rasterizer_module("diff_gaussian_rasterization_weights").GaussianRasterizer(settings_of(scene.camera))
    _, _, _, _, max_weights_idx, max_weights = rasterizer(
        means3D=scene.means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
        colors_precomp=scene.colors, scales=scene.scales, rotations=scene.quaternions,
    )  # fmt: skip
    largest, index = _weights(scene).max(0)
    torch.testing.assert_close(max_weights[0], largest, rtol=1e-9, atol=1e-12)
    assert torch.equal(max_weights_idx[0], torch.where(largest > 0, index, -1).int())
    assert (largest > 0).any()
    assert not (largest > 0).all()
