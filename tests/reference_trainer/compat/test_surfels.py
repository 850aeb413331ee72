"""The planes of surfels against the brute-force renderer's weights, pixel by pixel."""

import itertools

import torch
from oracles import brute_force, random_scene
from scipy.spatial.transform import Rotation

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


def test_the_distortion_of_a_thin_wall_keeps_its_digits_in_float32(settings_of):
    """A hundredth thick at a depth of 4: against the pairs in float64, and the derivatives of their sum."""
    n, g = 12, torch.Generator().manual_seed(0)
    scene = random_scene(n, 14, 9, seed=5, size=0.3)
    depths = 4 + 0.01 * torch.randn(n, generator=g, dtype=torch.float64)
    pixels = torch.rand(n, 2, generator=g, dtype=torch.float64) * torch.tensor([14, 9])
    scene = scene._replace(means=scene.camera.lift(pixels, depths), scales=scene.scales * torch.tensor([1, 1, 0]))
    single, exact = (
        scene.to(dtype)._replace(means=scene.means.to(dtype).requires_grad_())
        for dtype in (torch.float32, torch.float64)
    )
    module = rasterizer_module("diff_surfel_rasterization", outputs=("image", "radii", "distortion"))
    ours = module.GaussianRasterizer(settings_of(single.camera))(
        means3D=single.means, means2D=torch.zeros_like(single.means), opacities=single.opacities[:, None],
        colors_precomp=single.colors, scales=single.scales, rotations=single.quaternions,
    )[2]  # fmt: skip
    weights, _ = brute_force(*exact[:4], torch.eye(n).double(), exact.camera)
    local = exact.means @ exact.camera.world_to_camera[2, :3] + exact.camera.world_to_camera[2, 3]
    mapped = 100 / (100 - 0.2) * (1 - 0.2 / local)
    pairs = sum(weights[i] * weights[j] * (mapped[i] - mapped[j]) ** 2 for i, j in itertools.combinations(range(n), 2))
    assert (ours[0] - pairs).norm() < 1e-3 * pairs.norm()
    ours.sum().backward()
    pairs.sum().backward()
    assert (single.means.grad - exact.means.grad).norm() < 1e-3 * exact.means.grad.norm()


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


def test_further_channels_of_the_image_are_those_of_the_planes(settings_of):
    scene = random_scene(12, 14, 9, seed=5, size=0.2)
    lengths = scene.scales * torch.tensor([1.0, 0.0, 1.0])  # flat along the second axis

    def rendered(*outputs):
        module = rasterizer_module("diff_gaussian_rasterization", outputs=outputs)
        return module.GaussianRasterizer(settings_of(scene.camera))(
            means3D=scene.means, means2D=torch.zeros_like(scene.means), opacities=scene.opacities[:, None],
            colors_precomp=scene.colors, scales=lengths, rotations=scene.quaternions,
        )  # fmt: skip

    picture, radii = rendered("image+normal+depth+alpha+distortion", "radii")
    apart = rendered("image", "radii", "normal", "depth", "alpha", "distortion")
    assert torch.equal(picture, torch.cat([apart[0], *apart[2:]]))
    assert torch.equal(radii, apart[1])
    weights, _ = brute_force(*scene[:2], lengths, scene.opacities, torch.eye(12).double(), scene.camera)
    pose = scene.camera.world_to_camera
    local = scene.means @ pose[:3, :3].T + pose[:3, 3]
    axes = Rotation.from_quat(scene.quaternions.numpy(), scalar_first=True).as_matrix()[:, :, 1]
    normals = torch.from_numpy(axes) @ pose[:3, :3].T
    normals = normals * -(normals * local).sum(1, keepdim=True).sign()
    torch.testing.assert_close(picture[3:6], torch.einsum("nhw,nc->chw", weights, normals), rtol=0, atol=1e-9)
    planes = rendered("image", "radii", "inverse_depth", "normal", "mean_depth", "distortion")[2:]
    inverse_depth = torch.einsum("nhw,n->hw", weights, 1 / local[:, 2])
    torch.testing.assert_close(planes[0][0], inverse_depth, rtol=0, atol=1e-9)
    assert torch.equal(planes[1], apart[2])
    assert torch.equal(planes[3], apart[5])
