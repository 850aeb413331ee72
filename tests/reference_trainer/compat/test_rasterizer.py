"""The stand-in rasterizer against the brute-force float64 renderer."""

import pytest
import torch
from oracles import brute_force, random_scene

from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.compat.settings import camera_of
from reference_trainer.render.eager.spherical_harmonics import evaluate_sh

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
    rasterizer = rasterizer_module(NAME, members).GaussianRasterizer(raster_settings=settings)
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
    for members in ((), ("depth",), ("inverse_depth",), DEPTH_ALPHA):
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

    # The picture spans [-1, 1] in normalised device coordinates: a unit is half the width or height in pixels.
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
    visible = rasterizer_module(NAME, ()).GaussianRasterizer(settings).markVisible(scene.means)
    camera = camera_of(settings)
    depths = scene.means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    assert torch.equal(visible, depths > 0.2)
    assert 0 < visible.sum() < 40


def test_a_patch_of_the_class_ends_with_its_module(settings_of):
    scene = random_scene(5, 8, 8, seed=3)
    module = rasterizer_module(NAME, ())
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
        ({"means2D": torch.zeros(4, 4)}, "must have 3 columns"),
        ({"means2D": torch.zeros(3, 3)}, r"\(4, 3\)"),
        ({"colors_precomp": None}, "either sh"),
        ({"shs": torch.zeros(4, 1, 3)}, "either sh"),
    ],
)
def test_errors_name_the_problem(settings_of, changes, words):
    scene = random_scene(4, 8, 8, seed=0)
    with pytest.raises(ValueError, match=words):
        _call(settings_of(scene.camera), scene, **changes)


def test_antialiasing_is_refused(settings_of):
    scene = random_scene(4, 8, 8, seed=0)
    with pytest.raises(ValueError, match="antialiasing=False"):
        _call(settings_of(scene.camera, antialiasing=True), scene)
