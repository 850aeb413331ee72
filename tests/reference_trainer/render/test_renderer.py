"""The renderer against the brute-force float64 renderer."""

import functools
from dataclasses import replace

import pytest
import torch
from oracles import GaussianScene, brute_force, random_scene

from reference_trainer.camera import Camera
from reference_trainer.render import rasterize, render, render_masks, splat


@functools.cache
def brute_force_gradients(n, width, height, size):
    """A random scene, random weights of its pixels, and the gradients of the weighted sum by the slow renderer."""
    scene = random_scene(n, width, height, seed=n, size=size)
    weights = torch.randn(4, height, width, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    leaves = [x.clone().requires_grad_() for x in scene.tensors()]
    image, alpha = brute_force(*leaves, scene.camera)
    (torch.cat([image, alpha[None]]) * weights).sum().backward()
    return scene, weights, [x.grad for x in leaves]


@pytest.mark.parametrize(("n", "width", "height"), [(60, 40, 24), (250, 37, 29), (1, 5, 3), (12, 1, 1)])
def test_image_and_alpha_equal_brute_force(n, width, height, any_case):
    scene, image, alpha = brute_force_images(n, width, height)
    *tensors, colors, camera = scene.to(any_case.dtype, any_case.device)
    out = render(*tensors, camera, colors=colors)
    assert out.splats.engine.name == any_case.engine
    any_case.agrees(out.image, image)
    any_case.agrees(out.alpha, alpha)


@functools.cache
def brute_force_images(n, width, height):
    scene = random_scene(n, width, height, seed=n)
    return scene, *brute_force(*scene)


def test_background_depth_and_sh_are_the_same_sums(case):
    scene = random_scene(80, 33, 17, seed=3)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    distance = (scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3])[:, 2:]
    sums, alpha = brute_force(*scene[:4], torch.cat([scene.colors, distance], dim=1), scene.camera)
    s = scene.to(case.dtype)
    out = render(*s[:4], s.camera, sh=(s.colors[:, None] - 0.5) / 0.28209479177387814,
                 background=background.to(case.dtype), depth=True)  # fmt: skip
    case.agrees(out.image, sums[:3] + (1 - alpha) * background[:, None, None])
    case._replace(pixel=5 * case.pixel).agrees(out.depth, sums[3])  # depths of up to 3


@pytest.mark.parametrize(("n", "size"), [(60, 0.08), (40, 0.3), (120, 0.02)])
def test_gradients_equal_autograd_through_brute_force(n, size, any_case):
    scene, weights, exact = brute_force_gradients(n, 26, 18, size)
    s = scene.to(any_case.dtype, any_case.device)
    leaves = [x.clone().requires_grad_() for x in s.tensors()]
    out = render(*leaves[:4], s.camera, colors=leaves[4])
    (torch.cat([out.image, out.alpha[None]]) * weights.to(out.image)).sum().backward()
    for mine, other in zip(leaves, exact, strict=True):
        any_case.same_gradient(mine.grad, other)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_of_harmonics_depth_and_background(degree, case):
    """Against the torch engine in float64, whose derivatives are autograd's."""
    scene = random_scene(50, 26, 18, seed=6, size=0.15)
    g = torch.Generator().manual_seed(degree)
    sh = 1.5 * torch.randn(50, 16, 3, generator=g, dtype=torch.float64)
    background = torch.rand(3, generator=g, dtype=torch.float64)
    weights = torch.randn(5, 18, 26, generator=g, dtype=torch.float64)
    gradients = []
    for dtype in (case.dtype, torch.float64):
        s = scene.to(dtype)
        leaves = [x.to(dtype).clone().requires_grad_() for x in (*s[:4], sh, background)]
        out = render(*leaves[:4], s.camera, sh=leaves[4], sh_degree=degree, background=leaves[5], depth=True)
        assert (out.splats.colors == 0).any()  # the clamp at 0 takes part
        (torch.cat([out.image, out.alpha[None], out.depth[None]]) * weights.to(dtype)).sum().backward()
        gradients.append([*(x.grad for x in leaves), out.splats.projection.means.grad])
    for mine, exact in zip(*gradients, strict=True):
        case.same_gradient(mine, exact)
    assert not gradients[0][4][:, (degree + 1) ** 2 :].any()  # bands that are not used


def test_gradients_are_the_slopes_of_the_brute_force_image(case):
    # Broad splats: no edge of the 1/255 cut is crossed by the differences.
    scene = random_scene(6, 11, 9, seed=11, size=0.6)
    scene = scene._replace(means=scene.means * 0.3, opacities=scene.opacities * 0.4 + 0.2)
    g = torch.Generator().manual_seed(0)
    weights = torch.randn(3, 9, 11, generator=g, dtype=torch.float64)
    s = scene.to(case.dtype)
    leaves = [x.clone().requires_grad_() for x in s.tensors()]
    (render(*leaves[:4], s.camera, colors=leaves[4]).image * weights.to(case.dtype)).sum().backward()
    for which, leaf in enumerate(leaves):
        direction = torch.randn(leaf.shape, generator=g, dtype=torch.float64)
        values = []
        for step in (1e-5, -1e-5):
            moved = list(scene.tensors())
            moved[which] = moved[which] + step * direction
            values.append((brute_force(*moved, scene.camera)[0] * weights).sum())
        slope = (values[0] - values[1]) / 2e-5
        scale = leaf.grad.double().norm() * direction.norm()
        assert abs((leaf.grad.double() * direction).sum() - slope) < max(case.gradient, 1e-6) * scale


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


def test_a_pixel_ends_before_the_splat_that_would_leave_too_little_light(case):
    # Four opaque layers: 0.01^1 is kept, 0.01^2 = 1e-4 is the limit itself, the third layer would leave 1e-6.
    camera = Camera(torch.eye(4, dtype=torch.float64), 10.0, 10.0, 2.0, 2.0, 4, 4)
    means = torch.tensor([[0.0, 0, 1 + i] for i in range(4)], dtype=torch.float64)
    quaternions, scales = torch.eye(4).double()[:1].repeat(4, 1), torch.full((4, 3), 50.0).double()
    layers = GaussianScene(means, quaternions, scales, torch.ones(4).double(), torch.eye(4).double(), camera)
    if case.dtype == torch.float32:  # 0.01^2 is not 1e-4 there, on either side: a little more light
        layers = layers._replace(opacities=torch.tensor([0.9895, 1.0, 1.0, 1.0]).double())
    image, alpha = brute_force(*layers)
    s = layers.to(case.dtype)
    out = render(*s[:4], s.camera, colors=s.colors[:, :3])
    case.agrees(out.image, image[:3])
    case.agrees(out.alpha, alpha)
    assert image[2:].abs().max() == 0


def test_a_dropped_gaussian_is_as_if_it_were_not_there(case):
    scene = random_scene(100, 30, 20, seed=8).to(case.dtype)
    keep = torch.rand(100, generator=torch.Generator().manual_seed(4)) > 0.3
    opacities = (scene.opacities * keep).requires_grad_()
    dropped = render(*scene[:3], opacities, scene.camera, colors=scene.colors)
    removed = render(*(x[keep] for x in scene[:4]), scene.camera, colors=scene.colors[keep])
    torch.testing.assert_close(dropped.image, removed.image, rtol=0, atol=1e-12)
    assert keep[dropped.splats.indices].all()
    dropped.image.sum().backward()
    assert (opacities.grad[~keep] == 0).all()


def test_a_mask_renders_what_a_fresh_render_does(case):
    scene = random_scene(150, 30, 21, seed=8, size=0.15).to(case.dtype)
    g = torch.Generator().manual_seed(4)
    whole = splat(*scene[:4], scene.camera, colors=scene.colors)
    for lower in (scene.opacities * (torch.rand(150, generator=g) > 0.5), scene.opacities * 0.3, 0 * scene.opacities):
        opacities = lower.clone().requires_grad_()
        fresh = lower.clone().requires_grad_()
        one = rasterize(whole.engine.masked(whole, opacities[whole.indices]))
        other = render(*scene[:3], fresh, scene.camera, colors=scene.colors)
        torch.testing.assert_close(one.image, other.image, rtol=0, atol=10 * torch.finfo(case.dtype).eps)
        torch.testing.assert_close(one.alpha, other.alpha, rtol=0, atol=10 * torch.finfo(case.dtype).eps)
        for out in (one, other):
            if out.image.requires_grad:
                out.image.square().sum().backward()
        expected = torch.zeros_like(fresh) if fresh.grad is None else fresh.grad
        torch.testing.assert_close(opacities.grad, expected, rtol=1e-4, atol=1e-5)


def test_several_masks_at_once_render_what_fresh_renders_do(case):
    """Dropped, lowered, all, none, and long lists in which some pictures end before others."""
    scene = random_scene(300, 37, 21, seed=9, size=0.3).to(case.dtype)
    background = torch.tensor([0.3, 0.6, 0.1], dtype=case.dtype)
    g = torch.Generator().manual_seed(5)
    factors = [torch.rand(300, generator=g) > p for p in (0.5, 0.98)]
    factors += [torch.rand(300, generator=g), torch.ones(300), torch.zeros(300), torch.full((300,), 0.02)]
    opacities = scene.opacities * torch.stack([x.to(case.dtype) for x in factors])
    whole = splat(*scene[:4], scene.camera, colors=scene.colors)
    for some in (opacities, opacities[:2], opacities[1:2], opacities[:0]):
        images, alphas = render_masks(whole, some, background=background)
        assert images.shape == (len(some), 3, 21, 37)
        assert alphas.shape == (len(some), 21, 37)
        for image, alpha, opacity in zip(images, alphas, some, strict=True):
            fresh = render(*scene[:3], opacity, scene.camera, colors=scene.colors, background=background)
            crossing = (image - fresh.image).abs().amax(0) > 100 * torch.finfo(case.dtype).eps
            assert crossing.double().mean() <= case.crossing  # at the cut, alphas of lowered opacities round otherwise
            torch.testing.assert_close(image, fresh.image, rtol=0, atol=case.pixel if not crossing.any() else 1 / 255)
            torch.testing.assert_close(alpha, fresh.alpha, rtol=0, atol=case.pixel if not crossing.any() else 1 / 255)


@pytest.mark.parametrize("shape", [(7,), (7, 1)])
def test_opacity_shapes(shape, case):
    scene = random_scene(7, 16, 16, seed=1).to(case.dtype)
    image = render(*scene[:3], scene.opacities.reshape(shape), scene.camera, colors=scene.colors).image
    assert torch.equal(image, render(*scene[:4], scene.camera, colors=scene.colors).image)


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_in_view_is_the_background(n, case):
    scene = random_scene(3, 9, 7, seed=1).to(case.dtype)
    tensors = [x[:n].clone().requires_grad_() for x in scene.tensors()]
    out = render(tensors[0] - 10 * scene.camera.forward, *tensors[1:4], scene.camera, colors=tensors[4],
                 background=torch.ones(3, dtype=case.dtype), depth=True)  # fmt: skip
    assert torch.equal(out.image, torch.ones(3, 7, 9, dtype=case.dtype))
    assert out.alpha.abs().max() == 0
    assert out.depth.abs().max() == 0
    out.image.sum().backward()
    assert all((x.grad is None or not x.grad.any()) for x in tensors)


def test_a_gaussian_at_the_cut_is_rendered_at_its_center_or_not_at_all(case):
    """An alpha of exactly 1/255 may fall to either side, and to no third one."""
    camera = Camera(torch.eye(4), 10.0, 10.0, 4.5, 4.5, 9, 9)
    for factor, seen in ((1.0, None), (1.001, True), (0.999, False)):
        opacity = torch.tensor([factor / 255], dtype=case.dtype)
        out = render(torch.tensor([[0.0, 0, 2]], dtype=case.dtype), torch.tensor([[1.0, 0, 0, 0]], dtype=case.dtype),
                     torch.full((1, 3), 0.01, dtype=case.dtype), opacity, camera, colors=torch.ones(1, 3))  # fmt: skip
        covered = out.alpha > 0
        assert covered.sum() == int(covered[4, 4])
        assert seen is None or bool(covered[4, 4]) == seen


@pytest.mark.parametrize(
    ("scales", "opacity"),
    [([1e-9] * 3, 0.9), ([1e6] * 3, 0.5), ([3.0, 1e-6, 1e-6], 0.8), ([1e3, 1e-3, 1.0], 0.6), ([0.3] * 3, 7.0)],
    ids=["tiny", "huge", "needle", "sheet", "opacity above 1"],
)
def test_extreme_gaussians(scales, opacity, case):
    g = torch.Generator().manual_seed(2)
    scene = random_scene(8, 21, 13, seed=3)._replace(
        scales=torch.tensor([scales] * 8, dtype=torch.float64) * (0.5 + torch.rand(8, 1, generator=g)),
        # Two that are clamped would leave 0.01 x 0.01 = 1e-4, where pixels end: rounding would decide.
        opacities=torch.tensor([0.5] * 7 + [opacity], dtype=torch.float64),
    )
    s = scene.to(case.dtype)
    rounded = GaussianScene(*(x.double() for x in s[:5]), scene.camera)  # positions round by parts of a needle's width
    image, alpha = brute_force(*rounded)
    out = render(*s[:4], s.camera, colors=s.colors)
    wide = case
    if case.dtype == torch.float64:  # the oracle inverts covariances, whose condition is up to 1e12
        wide = case._replace(pixel=1e-9)
    wide.agrees(out.image, image)
    wide.agrees(out.alpha, alpha)


def test_errors_name_the_problem():
    scene = random_scene(4, 8, 8, seed=0)
    with pytest.raises(ValueError, match="either sh"):
        render(*scene[:4], scene.camera)
    with pytest.raises(ValueError, match=r"\(4,\) or \(4, 1\)"):
        render(*scene[:3], scene.opacities[:2], scene.camera, colors=scene.colors)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"sh": torch.zeros(4, 1, 3), "sh_degree": 3},
            r"degree 3, of at most 3, needs 16 coefficients, got sh of \(4, 1, 3\)",
        ),
        ({"sh": torch.zeros(4, 25, 3)}, "degree 4, of at most 3"),
        ({"sh": torch.zeros(4, 4, 3), "sh_degree": -1}, "degree -1, of at most 3"),
        ({"sh": torch.zeros(5, 4, 3)}, r"sh must have shape \(4, 4, 3\)"),
        ({"sh": torch.zeros(4, 3)}, r"sh .*shape \(N, K, 3\)"),
        ({"colors": torch.zeros(4, 1)}, r"colors .*shape \(N, 3\)"),
        ({"colors": torch.zeros(5, 3)}, r"colors .*shape \(4, 3\), got \(5, 3\)"),
        ({"scales": torch.ones(4, 1)}, r"scales must have shape \(4, 3\)"),
        ({"quaternions": torch.ones(4, 3)}, r"quaternions must have shape \(4, 4\)"),
        ({"means": torch.ones(4, 2)}, r"means must have shape \(4, 3\)"),
    ],
)
def test_other_shapes_are_refused_before_a_loop_reads_beyond_them(change, message):
    scene = random_scene(4, 8, 8, seed=0).to(torch.float32)
    inputs = dict(zip(("means", "quaternions", "scales", "opacities"), scene[:4], strict=True))
    inputs |= change if "sh" in change or "colors" in change else {"colors": scene.colors} | change
    with pytest.raises(ValueError, match=message):
        render(**inputs, camera=scene.camera)


def test_a_second_derivative_is_refused(case):
    scene = random_scene(4, 8, 8, seed=0).to(case.dtype)
    opacities = scene.opacities.clone().requires_grad_()
    image = render(*scene[:3], opacities, scene.camera, colors=scene.colors).image
    (slope,) = torch.autograd.grad(image.square().sum(), opacities, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


def test_a_pose_has_its_gradient_or_is_refused(case):
    """Loops and kernels have none: a pose that is optimized would stay where it is, without a word."""
    scene = random_scene(20, 9, 7, seed=5, size=0.3).to(case.dtype)
    pose = scene.camera.world_to_camera.clone().requires_grad_()
    moving = replace(scene.camera, world_to_camera=pose)
    means = scene.means.clone().requires_grad_()
    if case.engine == "torch":
        render(means, *scene[1:4], moving, colors=scene.colors).image.square().sum().backward()
        assert pose.grad.any()
    else:
        with pytest.raises(NotImplementedError, match=f"{case.engine} .*camera's pose: .*torch"):
            render(means, *scene[1:4], moving, colors=scene.colors)
    with torch.no_grad():  # as when such a pose is looked at
        still = render(means, *scene[1:4], moving, colors=scene.colors).image
    assert torch.equal(still, render(*scene[:4], scene.camera, colors=scene.colors).image)


def test_an_input_that_was_changed_before_the_backward_pass_does_not_falsify_it(case):
    scene = random_scene(4, 8, 8, seed=0).to(case.dtype)
    slopes = []
    for change in (0, 1):
        means = scene.means.clone().requires_grad_()
        image = render(means, *scene[1:4], scene.camera, colors=scene.colors).image
        with torch.no_grad():
            means.add_(change)
        if case.engine == "numba":  # which keeps what it was given, the other engine copies of it
            with pytest.raises(RuntimeError, match="inplace operation"):
                image.sum().backward()
            return
        image.sum().backward()
        slopes.append(means.grad)
    assert torch.equal(*slopes)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_short_inputs_are_rendered_in_float32_and_their_gradients_come_back_short(dtype, engine):
    scene = random_scene(60, 30, 20, seed=4).to(dtype)
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


def test_mixed_precision_changes_nothing(any_case):
    scene = random_scene(60, 30, 20, seed=4).to(any_case.dtype, any_case.device)
    plain = render(*scene[:4], scene.camera, colors=scene.colors).image
    with torch.autocast(scene.means.device.type, dtype=torch.bfloat16):
        cast = render(*scene[:4], scene.camera, colors=scene.colors).image
    assert torch.equal(plain, cast)


def test_a_backward_pass_inside_autocast_keeps_the_precision_of_the_compositing(any_case):
    """The rest of it is PyTorch's own: the rotation of the means comes out in bfloat16, as everywhere in PyTorch."""
    gradients = []
    for enabled in (False, True):
        scene = random_scene(60, 30, 20, seed=4).to(any_case.dtype, any_case.device)
        leaves = [x.clone().requires_grad_() for x in (*scene[:4], scene.colors)]
        loss = render(*leaves[:4], scene.camera, colors=leaves[4]).image.square().sum()
        with torch.autocast(scene.means.device.type, dtype=torch.bfloat16, enabled=enabled):
            loss.backward()
        gradients.append([x.grad for x in leaves])
    # A card adds up in any order; half precision would err by 1e-3.
    order = 1e-5 if scene.means.is_cuda else 0.0
    for plain, cast in zip(*(of[1:] for of in gradients), strict=True):
        torch.testing.assert_close(plain, cast, rtol=order, atol=order * plain.abs().max().item())


def test_tensors_of_whole_numbers_are_refused():
    scene = random_scene(6, 8, 8, seed=0)
    with pytest.raises(TypeError, match=r"scales .*got torch\.int64; .*\.float"):
        render(*scene[:2], scene.scales.long(), scene.opacities, scene.camera, colors=scene.colors)
