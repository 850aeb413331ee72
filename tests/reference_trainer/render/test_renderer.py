"""The renderer against the brute-force float64 renderer."""

import pytest
import torch
from oracles import GaussianScene, brute_force, random_scene

from reference_trainer.camera import Camera
from reference_trainer.render import render

TOLERANCE = {torch.float64: 1e-12, torch.float32: 2e-4}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("n", "width", "height"), [(60, 40, 24), (250, 37, 29), (1, 5, 3), (12, 1, 1)])
def test_image_and_alpha_equal_brute_force(n, width, height, dtype, device):
    scene = random_scene(n, width, height, seed=n)
    image, alpha = brute_force(*scene)
    *tensors, colors, camera = scene.to(dtype, device)
    out = render(*tensors, camera, colors=colors)
    # In float32 an alpha within rounding of the 1/255 cut may fall on the other side: allow that at few pixels.
    error = (out.image.double().cpu() - image).abs().amax(0)
    assert (error > TOLERANCE[dtype]).double().mean() <= (0 if dtype == torch.float64 else 0.005)
    assert error.max() < 1 / 255
    assert ((out.alpha.double().cpu() - alpha).abs() > TOLERANCE[dtype]).double().mean() <= 0.005


def test_background_depth_and_sh_are_the_same_sums():
    scene = random_scene(80, 33, 17, seed=3)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    distance = (scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3])[:, 2:]
    sums, alpha = brute_force(*scene[:4], torch.cat([scene.colors, distance], dim=1), scene.camera)
    out = render(*scene[:4], scene.camera, sh=(scene.colors[:, None] - 0.5) / 0.28209479177387814,
                 background=background, depth=True)  # fmt: skip
    torch.testing.assert_close(out.image, sums[:3] + (1 - alpha) * background[:, None, None], rtol=0, atol=1e-12)
    torch.testing.assert_close(out.depth, sums[3], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("n", "size"), [(60, 0.08), (40, 0.3), (120, 0.02)])
def test_gradients_equal_autograd_through_brute_force(n, size, device):
    scene = random_scene(n, 26, 18, seed=n, size=size)
    weights = torch.randn(4, 18, 26, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours = [x.to(device).clone().requires_grad_() for x in scene.tensors()]
    slow = [x.clone().requires_grad_() for x in scene.tensors()]
    out = render(*ours[:4], scene.camera.to(device), colors=ours[4])
    (torch.cat([out.image, out.alpha[None]]) * weights.to(device)).sum().backward()
    image, alpha = brute_force(*slow, scene.camera)
    (torch.cat([image, alpha[None]]) * weights).sum().backward()
    for mine, other in zip(ours, slow, strict=True):
        torch.testing.assert_close(mine.grad.cpu(), other.grad, rtol=1e-9, atol=1e-10)


def test_float32_gradients_stay_close_to_float64():
    scene = random_scene(200, 40, 30, seed=5)
    target = torch.rand(3, 30, 40, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    gradients = {}
    for dtype in (torch.float32, torch.float64):
        s = scene.to(dtype)
        leaves = [x.clone().requires_grad_() for x in s.tensors()]
        (render(*leaves[:4], s.camera, colors=leaves[4]).image - target.to(dtype)).square().mean().backward()
        gradients[dtype] = [x.grad.double() for x in leaves]
    for single, double in zip(*gradients.values(), strict=True):
        assert (single - double).norm() / double.norm() < 1e-3


def test_gradcheck():
    # Broad splats keep every alpha at every pixel well above the 1/255 cut, so finite differences cross no edge.
    scene = random_scene(5, 6, 5, seed=11, size=0.6)
    scene = scene._replace(means=scene.means * 0.3, opacities=scene.opacities * 0.4 + 0.2)

    def function(*tensors):
        out = render(*tensors[:4], scene.camera, colors=tensors[4], depth=True)
        return out.image, out.alpha, out.depth

    inputs = tuple(x.clone().requires_grad_() for x in scene.tensors())
    assert function(*inputs)[1].min() > 0.3
    assert torch.autograd.gradcheck(function, inputs, eps=1e-6, atol=1e-6)


def test_a_pixel_ends_before_the_splat_that_would_leave_too_little_light():
    # Four opaque layers: 0.01^1 is kept, 0.01^2 = 1e-4 is the limit itself, the third layer would leave 1e-6.
    camera = Camera(torch.eye(4, dtype=torch.float64), 10.0, 10.0, 2.0, 2.0, 4, 4)
    means = torch.tensor([[0.0, 0, 1 + i] for i in range(4)], dtype=torch.float64)
    quaternions, scales = torch.eye(4).double()[:1].repeat(4, 1), torch.full((4, 3), 50.0).double()
    layers = GaussianScene(means, quaternions, scales, torch.ones(4).double(), torch.eye(4).double(), camera)
    image, alpha = brute_force(*layers)
    out = render(*layers[:4], camera, colors=layers.colors[:, :3])
    torch.testing.assert_close(out.image, image[:3])
    torch.testing.assert_close(out.alpha, alpha)
    assert image[2:].abs().max() == 0


def test_a_dropped_gaussian_is_as_if_it_were_not_there():
    scene = random_scene(100, 30, 20, seed=8)
    keep = torch.rand(100, generator=torch.Generator().manual_seed(4)) > 0.3
    opacities = (scene.opacities * keep).requires_grad_()
    dropped = render(*scene[:3], opacities, scene.camera, colors=scene.colors)
    removed = render(*(x[keep] for x in scene[:4]), scene.camera, colors=scene.colors[keep])
    torch.testing.assert_close(dropped.image, removed.image, rtol=0, atol=1e-12)
    assert keep[dropped.splats.indices].all()
    dropped.image.sum().backward()
    assert (opacities.grad[~keep] == 0).all()


@pytest.mark.parametrize("shape", [(7,), (7, 1)])
def test_opacity_shapes(shape):
    scene = random_scene(7, 16, 16, seed=1)
    image = render(*scene[:3], scene.opacities.reshape(shape), scene.camera, colors=scene.colors).image
    assert torch.equal(image, render(*scene[:4], scene.camera, colors=scene.colors).image)


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_in_view_is_the_background(n):
    scene = random_scene(3, 9, 7, seed=1)
    tensors = [x[:n].clone().requires_grad_() for x in scene.tensors()]
    out = render(tensors[0] - 10 * scene.camera.forward, *tensors[1:4], scene.camera, colors=tensors[4],
                 background=torch.ones(3).double())  # fmt: skip
    assert torch.equal(out.image, torch.ones(3, 7, 9).double())
    assert out.alpha.abs().max() == 0
    out.image.sum().backward()
    assert all((x.grad is None or not x.grad.any()) for x in tensors)


def test_errors_name_the_problem():
    scene = random_scene(4, 8, 8, seed=0)
    with pytest.raises(ValueError, match="either sh"):
        render(*scene[:4], scene.camera)
    with pytest.raises(ValueError, match=r"\(4,\) or \(4, 1\)"):
        render(*scene[:3], scene.opacities[:2], scene.camera, colors=scene.colors)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_short_inputs_are_rendered_in_float32_and_their_gradients_come_back_short(dtype, device):
    scene = random_scene(60, 30, 20, seed=4).to(dtype, device)
    camera = scene.camera.to(dtype=torch.float64)
    leaves = [x.clone().requires_grad_() for x in scene.tensors()]
    out = render(*leaves[:4], camera, colors=leaves[4])
    assert out.image.dtype == torch.float32
    exact = [x.detach().double().requires_grad_() for x in leaves]
    image = render(*exact[:4], camera, colors=exact[4]).image
    assert ((out.image.double() - image).abs() > 2e-4).double().mean() <= 0.005
    out.image.sum().backward()
    image.sum().backward()
    for short, long in zip(leaves, exact, strict=True):
        assert short.grad.dtype == dtype
        assert (short.grad.double() - long.grad).norm() < 0.01 * long.grad.norm()


def test_mixed_precision_changes_nothing(device):
    scene = random_scene(60, 30, 20, seed=4).to(torch.float32, device)
    plain = render(*scene[:4], scene.camera, colors=scene.colors).image
    with torch.autocast(device.type, dtype=torch.bfloat16):
        cast = render(*scene[:4], scene.camera, colors=scene.colors).image
    assert torch.equal(plain, cast)


def test_a_backward_pass_inside_autocast_keeps_the_precision_of_the_compositing(device):
    """The rest of it is PyTorch's own: the rotation of the means comes out in bfloat16, as everywhere in PyTorch."""
    gradients = []
    for enabled in (False, True):
        scene = random_scene(60, 30, 20, seed=4).to(torch.float32, device)
        leaves = [x.clone().requires_grad_() for x in (*scene[:4], scene.colors)]
        loss = render(*leaves[:4], scene.camera, colors=leaves[4]).image.square().sum()
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled):
            loss.backward()
        gradients.append([x.grad for x in leaves])
    for plain, cast in zip(*(of[1:] for of in gradients), strict=True):
        assert torch.equal(plain, cast)


def test_tensors_of_whole_numbers_are_refused():
    scene = random_scene(6, 8, 8, seed=0)
    with pytest.raises(TypeError, match=r"scales must be a floating-point tensor, got torch.int64; .*\.float"):
        render(*scene[:2], scene.scales.long(), scene.opacities, scene.camera, colors=scene.colors)
