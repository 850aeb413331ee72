"""What AbsGS sums per Gaussian, against the brute-force renderer differentiated pixel by pixel."""

import torch
from oracles import brute_force, random_scene

from reference_trainer.compat.rasterizer import rasterizer_module


def _call(settings, scene, screen):
    rasterizer = rasterizer_module("diff_gaussian_rasterization_abs").GaussianRasterizer(settings)
    image, radii, gs_w = rasterizer(
        means3D=scene.means, means2D=screen, opacities=scene.opacities, colors_precomp=scene.colors,
        scales=scene.scales, rotations=scene.quaternions,
    )  # fmt: skip
    return image, radii, gs_w


def test_signed_and_absolute_gradients_and_weights(settings_of, moved_brute_force):
    n, width, height = 9, 10, 5
    scene = random_scene(n, width, height, seed=21, size=0.2)
    background = torch.tensor([0.3, 0.1, 0.8]).double()
    upstream = torch.randn(3, height, width, generator=torch.Generator().manual_seed(2)).double()
    screen = torch.zeros(n, 4).double().requires_grad_()
    image, radii, weights = _call(settings_of(scene.camera, bg=background), scene, screen)
    (image * upstream).sum().backward()

    shifts = torch.zeros(n, 2).double().requires_grad_()
    sums, alpha = moved_brute_force(scene, scene.colors, shifts)
    loss = ((sums + (1 - alpha) * background[:, None, None]) * upstream).sum(0)
    pixels = torch.stack([torch.autograd.grad(x, shifts, retain_graph=True)[0] for x in loss.flatten()])
    half = torch.tensor([0.5 * width, 0.5 * height]).double()
    torch.testing.assert_close(screen.grad[:, :2], pixels.sum(0) * half, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(screen.grad[:, 2:], pixels.abs().sum(0) * half, rtol=1e-8, atol=1e-9)
    # Signs differ between the pixels, or the test would not tell the two apart.
    assert (screen.grad[:, 2:] > 1.5 * screen.grad[:, :2].abs()).any()

    shares, _ = brute_force(*scene[:4], torch.eye(n).double(), scene.camera)
    torch.testing.assert_close(weights, shares.sum((1, 2)), rtol=1e-9, atol=1e-12)
    assert radii.shape == (n,)
    assert not weights.requires_grad


def test_a_dropped_gaussian_gets_nothing(settings_of):
    scene = random_scene(30, 20, 15, seed=3)
    keep = torch.arange(30) % 3 > 0
    screen = torch.zeros(30, 4).double().requires_grad_()
    image, _, weights = _call(settings_of(scene.camera), scene._replace(opacities=scene.opacities * keep), screen)
    image.square().sum().backward()
    assert (screen.grad[~keep] == 0).all()
    assert (weights[~keep] == 0).all()
    assert screen.grad[keep].any()


def test_they_may_be_asked_for_in_an_argument_of_their_own(settings_of):
    """As the rasterizer of Deformable-3D-Gaussians: the same sums as those of AbsGS, in the first two columns."""
    scene = random_scene(30, 20, 15, seed=3)
    four = torch.zeros(30, 4).double().requires_grad_()
    _call(settings_of(scene.camera), scene, four)[0].square().sum().backward()
    signed, absolute = (torch.zeros(30, 3).double().requires_grad_() for _ in range(2))
    rasterizer = rasterizer_module("diff_gaussian_rasterization").GaussianRasterizer(settings_of(scene.camera))
    image, radii, depth = rasterizer(
        means3D=scene.means, means2D=signed, means2D_densify=absolute, opacities=scene.opacities,
        colors_precomp=scene.colors, scales=scene.scales, rotations=scene.quaternions,
    )  # fmt: skip
    image.square().sum().backward()
    assert radii.shape == (30,)
    assert depth.shape == (1, 15, 20)
    torch.testing.assert_close(signed.grad[:, :2], four.grad[:, :2], rtol=1e-12, atol=0)
    torch.testing.assert_close(absolute.grad[:, :2], four.grad[:, 2:], rtol=1e-12, atol=0)
    assert (absolute.grad[:, :2] > signed.grad[:, :2].abs()).any()
