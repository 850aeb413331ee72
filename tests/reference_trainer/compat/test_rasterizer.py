"""The stand-in rasterizer against the brute-force float64 renderer."""

import math

import pytest
import torch
from oracles import GaussianScene, brute_force, random_scene
from scipy.spatial.transform import Rotation

from reference_trainer.camera import Camera
from reference_trainer.compat.rasterizer import camera_of, rasterizer_module
from reference_trainer.render.torch.projection import evaluate_sh

NAME = "diff_gaussian_rasterization"
DEPTH_ALPHA = ("depth", "alpha")


def _call(settings, scene, members=(), *, screen=None, **changes):
    """Call a stand-in with keywords, as the repositories do."""
    arguments = {
        "means3D": scene.means,
        "means2D": torch.zeros_like(scene.means) if screen is None else screen,
        "opacities": scene.opacities[:, None],
        "shs": None,
        "colors_precomp": scene.colors,
        "scales": scene.scales,
        "rotations": scene.quaternions,
        "cov3D_precomp": None,
    }
    module = rasterizer_module(NAME, outputs=("image", "radii", *members))
    rasterizer = module.GaussianRasterizer(raster_settings=settings)
    return rasterizer(**{**arguments, **changes})


def _weights(height, width):
    """Random weights of image, depth and alpha in a loss."""
    return torch.randn(5, height, width, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_every_output_equals_brute_force(settings_of):
    scene = random_scene(80, 33, 21, seed=1)
    background = torch.tensor([0.2, 0.5, 0.9]).double()
    settings = settings_of(scene.camera, bg=background, scale_modifier=0.7)
    z = (scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3])[:, 2:]
    sums, alpha = brute_force(
        scene.means, scene.quaternions, 0.7 * scene.scales, scene.opacities,
        torch.cat([scene.colors, z, 1 / z], dim=1), scene.camera,
    )  # fmt: skip
    image = sums[:3] + (1 - alpha) * background[:, None, None]
    values = {"depth": sums[3:4], "inverse_depth": sums[4:], "alpha": alpha[None]}
    for members in ((), ("depth",), ("inverse_depth",), DEPTH_ALPHA, ("depth", "inverse_depth")):
        tensors = [image, *(values[member] for member in members)]
        color, radii, *rest = _call(settings, scene, members)
        assert (radii > 0).any()
        for ours, slow in zip([color, *rest], tensors, strict=True):
            torch.testing.assert_close(ours, slow, rtol=0, atol=1e-9)


@pytest.mark.parametrize("confident", [False, True])
def test_gradients_equal_brute_force_also_those_on_the_screen(settings_of, moved_brute_force, confident):
    scene = random_scene(40, 26, 18, seed=4)
    confidence = torch.rand(40, 1, generator=torch.Generator().manual_seed(3)).double() if confident else None
    settings = settings_of(scene.camera, confidence=confidence)
    weights = _weights(18, 26)
    leaves = scene._replace(**{k: getattr(scene, k).clone().requires_grad_() for k in scene._fields[:5]})
    screen = torch.zeros(40, 3).double().requires_grad_()
    image, _, depth, alpha = _call(settings, leaves, DEPTH_ALPHA, screen=screen)
    (torch.cat([image, depth, alpha]) * weights).sum().backward()

    slow = scene._replace(**{k: getattr(scene, k).clone().requires_grad_() for k in scene._fields[:5]})
    shifts = torch.zeros(40, 2).double().requires_grad_()
    z = (slow.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3])[:, 2:]
    sums, alpha = moved_brute_force(slow, torch.cat([slow.colors, z], dim=1), shifts)
    (torch.cat([sums, alpha[None]]) * weights).sum().backward()

    # The picture spans [-1, 1] in normalized device coordinates: a unit is half the width or height in pixels.
    expected = torch.nn.functional.pad(shifts.grad * torch.tensor([13.0, 9.0]), (0, 1))
    torch.testing.assert_close(screen.grad, expected, rtol=1e-8, atol=1e-9)
    assert screen.grad[:, :2].abs().max() > 0.1
    for name in scene._fields[:5]:
        factor = 1.0 if confidence is None else confidence.reshape(-1, *[1] * (getattr(scene, name).ndim - 1))
        torch.testing.assert_close(getattr(leaves, name).grad, getattr(slow, name).grad * factor, rtol=1e-7, atol=1e-8)


def test_a_dropped_gaussian_has_a_radius_but_no_trace_and_no_gradient(settings_of):
    scene = random_scene(60, 30, 20, seed=8)
    keep = torch.rand(60, generator=torch.Generator().manual_seed(4)) > 0.4
    leaves = [x.clone().requires_grad_() for x in scene.tensors()]
    screen = torch.zeros(60, 3).double().requires_grad_()
    dropped = scene._replace(**dict(zip(scene._fields[:5], leaves, strict=True)))._replace(opacities=leaves[3] * keep)
    image, radii, depth, alpha = _call(settings_of(scene.camera), dropped, DEPTH_ALPHA, screen=screen)
    (image.square().sum() + depth.sum() + alpha.sum()).backward()
    for leaf in [*leaves, screen]:
        assert (leaf.grad[~keep] == 0).all()
        assert leaf.grad[keep].any()
    kept = scene._replace(**{k: getattr(scene, k)[keep] for k in scene._fields[:5]})
    torch.testing.assert_close(image, _call(settings_of(scene.camera), kept)[0], rtol=1e-12, atol=1e-12)
    assert torch.equal(radii, _call(settings_of(scene.camera), scene)[1])


def test_only_the_active_bands_of_spherical_harmonics_are_used(settings_of):
    scene = random_scene(30, 20, 16, seed=5)
    sh = torch.randn(30, 16, 3, generator=torch.Generator().manual_seed(6)).double()
    settings = settings_of(scene.camera, sh_degree=2)
    directions = torch.nn.functional.normalize(scene.means - settings.campos, dim=1)
    with_colors = _call(settings, scene, colors_precomp=evaluate_sh(sh[:, :9], directions, 2))[0]
    torch.testing.assert_close(_call(settings, scene, colors_precomp=None, shs=sh)[0], with_colors)


@pytest.mark.parametrize("count", [0, 5])
@pytest.mark.parametrize("members", [(), ("inverse_depth",), DEPTH_ALPHA])
def test_nothing_in_view_is_the_background_with_zero_gradients(settings_of, count, members):
    scene = random_scene(5, 12, 9, seed=5)
    away = scene._replace(**{k: getattr(scene, k)[:count] for k in scene._fields[:5]})
    away = away._replace(means=(away.means - 10 * scene.camera.forward).requires_grad_())
    screen = torch.zeros(count, 3).double().requires_grad_()
    image, radii, *_ = _call(settings_of(scene.camera, bg=torch.ones(3).double()), away, members, screen=screen)
    assert (image == 1).all()
    assert radii.tolist() == [0] * count
    image.sum().backward()
    assert torch.equal(screen.grad, torch.zeros(count, 3).double())


def test_mixed_precision_changes_nothing(settings_of):
    """As of the CUDA code, whose kernels know float32 alone."""
    scene = random_scene(200, 40, 30, seed=6, size=0.2).to(torch.float32)
    settings = settings_of(scene.camera, antialiasing=True, pixel_weights=torch.rand(30, 40))
    members = (*DEPTH_ALPHA, "normal", "mean_depth", "distortion", "weights", "pixels", "heaviest", "largest_weight")
    rasterizer = rasterizer_module(NAME).GaussianRasterizer(settings)
    axes = scene.means, scene.scales, scene.quaternions
    plain = [*_call(settings, scene, members), rasterizer.visible_filter(*axes), rasterizer.markVisible(axes[0])]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = [*_call(settings, scene, members), rasterizer.visible_filter(*axes), rasterizer.markVisible(axes[0])]
    for one, other in zip(plain, cast, strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)


def test_single_precision_as_the_repositories_use_it(settings_of):
    scene = random_scene(100, 40, 30, seed=6)
    slow = brute_force(*scene)[0]
    single = scene.to(torch.float32)
    image, radii = _call(settings_of(single.camera), single)
    # An alpha within rounding of the 1/255 cut may fall on the other side: allow that at few pixels.
    assert ((image.double() - slow).abs().amax(0) > 2e-4).double().mean() < 0.005
    assert image.dtype == torch.float32
    assert torch.equal(radii, _call(settings_of(scene.camera), scene)[1])


def test_mark_visible_is_the_near_plane(settings_of):
    scene = random_scene(40, 20, 20, seed=3)
    settings = settings_of(scene.camera)
    visible = rasterizer_module(NAME).GaussianRasterizer(settings).markVisible(scene.means)
    camera = camera_of(settings)
    depths = scene.means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    assert torch.equal(visible, depths > 0.2)
    assert 0 < visible.sum() < 40


def test_a_patch_of_the_class_ends_with_its_module(settings_of):
    scene = random_scene(5, 8, 8, seed=3)
    module = rasterizer_module(NAME, outputs=("image", "radii"))
    plain = module.GaussianRasterizer.__dict__["forward"]
    module.GaussianRasterizer.forward = lambda self, **arguments: plain(self, **arguments)[::-1]
    rasterizer = module.GaussianRasterizer(settings_of(scene.camera))
    tensors = dict(opacities=scene.opacities, colors_precomp=scene.colors, scales=scene.scales)
    patched = rasterizer(means3D=scene.means, means2D=scene.means, rotations=scene.quaternions, **tensors)
    assert patched[0].shape == (5,)
    assert _call(settings_of(scene.camera), scene)[0].shape == (3, 8, 8)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cov3D_precomp": torch.zeros(4, 6), "scales": None, "rotations": None}, "compute_cov3D_python"),
        ({"means2D": torch.zeros(4, 5)}, "or 4 columns"),
        ({"means2D": torch.zeros(3, 3)}, r"\(4, 3\)"),
        ({"colors_precomp": None}, "either sh"),
        ({"shs": torch.zeros(4, 1, 3)}, "either sh"),
    ],
)
def test_errors_name_the_problem(settings_of, changes, words):
    scene = random_scene(4, 8, 8, seed=0)
    with pytest.raises(ValueError, match=words):
        _call(settings_of(scene.camera), scene, **changes)


@pytest.mark.parametrize(
    ("asked", "blur", "floor"),
    [({"antialiasing": True}, 0.3, 2.5e-5), ({"kernel_size": 0.1}, 0.1, 1e-6), ({"kernel_size": 0.0}, 0.0, 1.0)],
)
def test_antialiasing_makes_up_for_the_blur(settings_of, asked, blur, floor):
    """Against the covariances of the projections, one by one, with and without the blur, in square pixels."""
    scene = random_scene(40, 30, 20, seed=8, size=0.05)
    camera = scene.camera
    pose, shares = camera.world_to_camera, []
    for mean, quaternion, scale in zip(scene.means, scene.quaternions, scene.scales, strict=True):
        x, y, z = pose[:3, :3] @ mean + pose[:3, 3]
        x, y = (z * (a / z).clamp(-1.3 * b, 1.3 * b) for a, b in ((x, 15 / camera.fx), (y, 10 / camera.fy)))
        turn = torch.from_numpy(Rotation.from_quat(quaternion.numpy(), scalar_first=True).as_matrix())
        lens = pose.new_tensor([[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]])
        half = lens @ pose[:3, :3] @ turn @ torch.diag(scale)
        plain = half @ half.T
        shares.append((plain.det() / (plain + blur * torch.eye(2).double()).det()).clamp_min(floor).sqrt())
    faint = scene._replace(opacities=scene.opacities * torch.stack(shares))
    plain, (blurred, radii, *_) = (_call(settings_of(camera, **each), scene) for each in ({}, asked))
    torch.testing.assert_close(blurred, brute_force(*faint, blur=blur)[0], rtol=0, atol=1e-9)
    assert (plain[0] - blurred).abs().max() > 0.05
    assert (radii <= plain[1]).all()
    assert torch.equal(radii, plain[1]) == (blur == 0.3)


@pytest.mark.parametrize("length", [10.0, 1e3, 1e5])
def test_antialiasing_keeps_its_digits_in_float32_where_splats_are_needles(settings_of, length):
    """A tenth of a pixel wide, on the optical axis, at 45 degrees: the closed form of its two variances, in pixels."""
    camera = Camera(torch.eye(4), 20.0, 20.0, 8.5, 8.5, 17, 17)
    variances, angle = torch.tensor([length, 0.1], dtype=torch.float64).square(), math.pi / 8
    scales = torch.tensor([[length / 10, 0.01, 0.01]], requires_grad=True)  # at depth 2: ten pixels per unit
    needle = GaussianScene(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[math.cos(angle), 0.0, 0.0, math.sin(angle)]]), scales,
        torch.tensor([0.9]), torch.ones(1, 3), camera,
    )  # fmt: skip
    peak = _call(settings_of(camera, antialiasing=True), needle)[0][0, 8, 8]
    expected = 0.9 * (variances / (variances + 0.3)).prod().sqrt()
    assert peak.item() == pytest.approx(expected.item(), rel=1e-4)
    (slope,) = torch.autograd.grad(peak, scales)
    assert slope[0, 1].item() == pytest.approx((expected * 0.3 / 0.31 / 0.01).item(), rel=1e-3)


def test_more_blur_than_the_renderers_is_refused(settings_of):
    scene = random_scene(4, 8, 8, seed=0)
    with pytest.raises(ValueError, match=r"kernel_size, eps2d\) .*\[0, 0\.3\] .*got 0\.5"):
        _call(settings_of(scene.camera, kernel_size=0.5), scene)


def test_the_first_band_may_stand_apart(settings_of):
    scene = random_scene(30, 20, 16, seed=5)
    sh = torch.randn(30, 4, 3, generator=torch.Generator().manual_seed(6)).double()
    settings = settings_of(scene.camera, sh_degree=1)
    whole = _call(settings, scene, colors_precomp=None, shs=sh)[0]
    assert torch.equal(_call(settings, scene, colors_precomp=None, dc=sh[:, :1], shs=sh[:, 1:])[0], whole)


def test_the_filter_of_scaffold_gs_returns_the_radii(settings_of):
    scene = random_scene(40, 20, 20, seed=3)
    settings = settings_of(scene.camera, scale_modifier=0.5)
    rasterizer = rasterizer_module(NAME).GaussianRasterizer(settings)
    radii = rasterizer.visible_filter(means3D=scene.means, scales=scene.scales, rotations=scene.quaternions)
    assert torch.equal(radii, _call(settings, scene)[1])
    assert 0 < (radii > 0).sum() < 40


def test_outputs_may_be_written_over_before_the_backward_pass(settings_of):
    scene = random_scene(20, 16, 12, seed=4)
    gradients = []
    for overwrite in (False, True):
        colors = scene.colors.clone().requires_grad_()
        image, _, depth = _call(settings_of(scene.camera), scene._replace(colors=colors), ("depth",))
        if overwrite:
            image[:, 3:5], depth[:, 2] = 0.0, 0.0
            image, depth = image.clone(), depth.clone()
        mask = torch.ones(1, 12, 16).double()
        mask[:, 3:5] = 0
        (image * mask).square().sum().backward()
        gradients.append(colors.grad)
    torch.testing.assert_close(*gradients)


def test_a_gradient_that_is_nan_where_nothing_is_rendered_does_no_harm(settings_of):
    scene = random_scene(6, 30, 20, seed=4, size=0.05)
    gradients = []
    for divide in (False, True):
        means = scene.means.clone().requires_grad_()
        _, _, depth, alpha = _call(settings_of(scene.camera), scene._replace(means=means), DEPTH_ALPHA)
        covered = alpha.detach() > 0
        ratio = depth / alpha if divide else depth / torch.where(covered, alpha, 1.0)
        torch.nan_to_num(ratio).sum().backward()
        gradients.append(means.grad)
    assert 0 < covered.sum() < covered.numel()
    assert gradients[0].any()
    torch.testing.assert_close(*gradients)


def test_unknown_arguments_are_ignored_with_one_warning(settings_of):
    scene = random_scene(5, 8, 8, seed=3)
    with pytest.warns(UserWarning, match="argument pose_of_the_test, .*ignores") as warned:
        images = [_call(settings_of(scene.camera), scene, pose_of_the_test=torch.eye(4))[0] for _ in range(2)]
    assert len(warned) == 1
    assert torch.equal(*images)
    assert torch.equal(images[0], _call(settings_of(scene.camera), scene, nothing_of_the_test=None)[0])


def test_zeros_that_wait_for_a_gradient_of_every_gaussian_are_refused(settings_of):
    scene = random_scene(5, 8, 8, seed=3)
    sink = torch.zeros(5, 3, 3, requires_grad=True) + 0
    with pytest.raises(ValueError, match=r"argument splits .*\(5, 3, 3\)"):
        _call(settings_of(scene.camera), scene, splits=sink)


def test_a_package_has_the_names_that_are_asked_for_and_refuses_others():
    module = rasterizer_module("my_rasterization", {"PlaneRasterizer", "PlaneRasterizationSettings"})
    assert issubclass(module.PlaneRasterizer, torch.nn.Module)
    assert module.PlaneRasterizer is not module.GaussianRasterizer
    assert module.PlaneRasterizationSettings is module.GaussianRasterizationSettings
    assert not hasattr(module, "__file__")
    with pytest.raises(ImportError, match="my_rasterization has no SparseGaussianAdam"):
        module.SparseGaussianAdam  # noqa: B018


def test_relocation_takes_the_table_of_3dgs_mcmc():
    """Four Gaussians of the new opacity at one place are as opaque as the one was; the table may be larger."""
    table = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=torch.float32)
    relocate = rasterizer_module(NAME).compute_relocation
    opacity, scales = relocate(torch.tensor([0.8]), torch.ones(1, 3), torch.tensor([4], dtype=torch.int32), table, 51)
    torch.testing.assert_close(1 - (1 - opacity) ** 4, torch.tensor([0.8]))
    assert ((scales > 0.4) & (scales < 1)).all()
