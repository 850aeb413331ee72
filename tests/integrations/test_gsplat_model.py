"""A gsplat model's renders and lists, through gsplat's own torch functions and, on a GPU, through its kernels.

On a machine with a CUDA device: ``pip install 'gsplat>=1.5' && pytest tests/integrations/test_gsplat_model.py``.
"""

import inspect
import itertools

import pytest
import torch
from oracles import brute_force, random_scene
from stand_ins import gsplat as gsplat_stand_in
from stand_ins.gsplat import centered, intrinsics

from ca_reg import CAScore, GaussianDropout, attribute
from ca_reg.attribution import hanging
from ca_reg.functional import Multiplier
from ca_reg.integrations import gsplat_model as module
from ca_reg.integrations.gsplat import regularized
from ca_reg.integrations.gsplat_model import GsplatModel, GsplatView
from ca_reg.lists import ListMoments
from reference_trainer.render import render

WIDTH, HEIGHT = 18, 14
BACKGROUND = torch.tensor([0.3, 0.9, 0.1])


def model_of(scene, **options):
    camera = scene.camera
    view = GsplatView(camera.world_to_camera, intrinsics(camera), camera.width, camera.height)
    given = {"colors": scene.colors, "background": BACKGROUND.to(scene.means), "near_plane": 0.2} | options
    return GsplatModel(scene.means, scene.quaternions, scene.scales, **given), view


@pytest.fixture
def package(monkeypatch):
    """The module gsplat for `GsplatModel`, with the clamp of 1.6."""
    pytest.importorskip("gsplat.cuda._torch_impl", exc_type=ImportError)
    package = gsplat_stand_in.package(max_alpha=0.99)
    monkeypatch.setattr(module, "load_gsplat", lambda device: package)
    module.largest_alpha.cache_clear()
    yield package
    module.largest_alpha.cache_clear()


def test_render_is_what_a_score_takes_and_is_not_regularized(package):
    scene = random_scene(50, WIDTH, HEIGHT, seed=4).to(torch.float32)
    package.rasterization = regularized(package.rasterization, GaussianDropout(0.5))
    model, view = model_of(scene)
    with torch.no_grad():
        image, alpha = model.render(scene.opacities[:, None], view)
        ours = render(*scene[:4], scene.camera, colors=scene.colors, background=BACKGROUND)
    torch.testing.assert_close(image, ours.image)
    torch.testing.assert_close(alpha, ours.alpha.clamp(max=0.99))
    assert package.rasterization.tally.regularized == package.rasterization.tally.scaled == 0
    result = CAScore(model.render, threshold=0.3)(scene.opacities, view)
    assert result.value > 0


def test_exact_moments_are_those_of_all_masks(package):
    scene = centered(random_scene(7, WIDTH, HEIGHT, seed=9, size=0.25))
    scene = scene._replace(opacities=scene.opacities.clamp(max=0.7))  # no render reaches the early stop
    model, view = model_of(scene)
    p = 0.3
    moments = ListMoments(model.lists)(scene.opacities, view, Multiplier.dropout(p), None)
    mean, square, total = 0.0, 0.0, 0.0
    for keep in itertools.product((0.0, 1.0), repeat=7):
        chance = (1 - p) ** sum(keep) * p ** (7 - sum(keep))
        opacities = scene.opacities * torch.tensor(keep).double()
        image, alpha = brute_force(scene.means, scene.quaternions, scene.scales, opacities, scene.colors, scene.camera)
        image = image + (1 - alpha) * BACKGROUND.double()[:, None, None]
        mean, square, total = mean + chance * image, square + chance * image**2, total + chance * alpha
    torch.testing.assert_close(moments.mean, mean, rtol=0, atol=1e-5)
    torch.testing.assert_close(moments.alpha_mean, total, rtol=0, atol=1e-5)
    torch.testing.assert_close(moments.variance, square - mean**2, rtol=0, atol=1e-5)
    assert moments.variance.max() > 0.01


def test_the_exact_score_is_the_limit_of_the_sampled_one(package):
    scene = random_scene(40, WIDTH, HEIGHT, seed=6, size=0.2).to(torch.float32)
    model, view = model_of(scene)
    exact = CAScore.exact(ListMoments(model.lists), drop_rate=0.3, threshold=0.3)(scene.opacities, view)
    sampled = CAScore.adaptive(model.render, drop_rate=0.3, threshold=0.3, relative_error=0.05, max_samples=64)
    result = sampled(scene.opacities, view)
    assert abs(exact.value - result.value) < 4 * result.std_error  # fixed seed; fails by chance once in 16,000 seeds


def test_no_gaussian_is_an_empty_list(package):
    scene = random_scene(3, WIDTH, HEIGHT, seed=1)
    model, view = model_of(scene._replace(**{x: getattr(scene, x)[:0] for x in scene._fields if x != "camera"}))
    lists = model.lists(torch.ones(0, 1), view)
    assert [x.shape for x in lists[:4]] == [(0,), (0,), (0,), (0, 3)]
    moments = ListMoments(model.lists)(torch.ones(0), view, Multiplier.dropout(0.5), None)
    assert torch.equal(moments.mean, BACKGROUND[:, None, None].expand(3, HEIGHT, WIDTH))
    assert moments.variance.max() == moments.alpha_mean.max() == 0


def test_the_colors_and_the_meta_of_a_render_are_not_regularized(package):
    scene = random_scene(50, WIDTH, HEIGHT, seed=4).to(torch.float32)
    sh = torch.randn(50, 4, 3, generator=torch.Generator().manual_seed(0))
    package.rasterization = regularized(package.rasterization, GaussianDropout(0.5))
    model, view = model_of(scene, colors=sh, sh_degree=1)
    with torch.no_grad():
        colors, meta = model.rasterized(scene.opacities[:, None], view)
    assert torch.equal(colors, model.lists(scene.opacities, view).colors)
    seen = (meta["radii"][0] > 0).all(-1)
    assert torch.equal(meta["opacities"][0, seen], scene.opacities[seen])
    assert package.rasterization.tally.regularized == package.rasterization.tally.scaled == 0


def test_lists_go_on_behind_an_opaque_surface(package):
    scene = random_scene(4, WIDTH, HEIGHT, seed=1, size=0.5)
    means = torch.zeros(4, 3, dtype=torch.float64)
    means[:, 2] = torch.arange(4)
    camera = type(scene.camera)(torch.eye(4).double(), 20.0, 20.0, 9.0, 7.0, WIDTH, HEIGHT)
    camera.world_to_camera[2, 3] = 2.0
    scene = scene._replace(means=means, opacities=torch.ones(4, dtype=torch.float64), camera=camera)
    model, view = model_of(scene)
    lists = model.lists(scene.opacities, view)
    middle = lists.pixels == 7 * WIDTH + 9
    assert lists.gaussians[middle].tolist() == [0, 1, 2, 3]  # gsplat's own lists end after two of 0.99
    assert float(lists.alphas.max()) == pytest.approx(0.99)


@pytest.mark.slow
def test_what_hangs_between_the_cameras_is_found(package):
    """A wall that both cameras see, and a veil between them that neither does, by the lines of docs/lists.md."""
    x, y = torch.meshgrid(torch.linspace(-3, 3, 13), torch.linspace(-1, 1, 5), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 4.0)], -1).reshape(-1, 3)
    means = torch.cat([wall, torch.tensor([[0.0, 0.0, 0.5]])])
    scales = torch.cat([torch.full((65, 3), 0.25), torch.full((1, 3), 0.1)])
    opacities = torch.cat([torch.full((65,), 0.5), torch.tensor([0.9])])
    colors = torch.rand(66, 3, generator=torch.Generator().manual_seed(0))
    model = GsplatModel(means, torch.eye(4)[0].expand(66, 4), scales, colors)

    def at(place):
        camera = torch.eye(4)
        camera[0, 3] = -place
        return GsplatView(camera, torch.tensor([[18.0, 0.0, 9.0], [0.0, 18.0, 7.0], [0.0, 0.0, 1.0]]), WIDTH, HEIGHT)

    moments, unseen, taken = ListMoments(model.lists), [at(0.0), at(-2.0), at(2.0)], [at(-1.0), at(1.0)]
    score = CAScore.exact(moments, p=0.2, threshold=0.3)
    shares = torch.stack([attribute(score, moments.shares, opacities, view).shares for view in unseen]).mean(0)
    there, here = (torch.stack([moments.weights(opacities, v) for v in views]).mean(0) for views in (unseen, taken))
    assert hanging(shares, there, here).nonzero().flatten().tolist() == [65]


def test_harmonics_and_gradients(package):
    scene = centered(random_scene(30, WIDTH, HEIGHT, seed=2, size=0.15))
    g = torch.Generator().manual_seed(0)
    sh = torch.randn(30, 9, 3, generator=g, dtype=torch.float64) / 4
    opacities = scene.opacities.clone().requires_grad_()
    model, view = model_of(scene, colors=sh, sh_degree=2)
    out = ListMoments(model.lists)(opacities, view, Multiplier(1.0, 0.0), None)
    plain = render(scene.means, scene.quaternions, scene.scales, opacities, scene.camera, sh=sh, background=BACKGROUND)
    torch.testing.assert_close(
        out.mean, plain.image, rtol=0, atol=2e-4
    )  # the renderer stops at a transmittance of 1e-4
    weights = torch.randn(3, HEIGHT, WIDTH, generator=g, dtype=torch.float64)
    ours, theirs = (torch.autograd.grad((x * weights).sum(), opacities)[0] for x in (out.mean, plain.image))
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=2e-3)


def test_the_arguments_are_those_of_the_package():
    gsplat = pytest.importorskip("gsplat", exc_type=ImportError)
    package = gsplat_stand_in.package()
    for name in ("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_indices_in_range"):
        ours, theirs = (inspect.signature(getattr(x, name)).parameters for x in (package, gsplat))
        before = {"n_images": "n_cameras"} if "n_cameras" in theirs else {}  # before gsplat 1.5.3
        assert {before.get(argument, argument) for argument in ours} <= theirs.keys()


def test_lists_of_an_older_gsplat_are_refused(package, monkeypatch):
    monkeypatch.setattr(package, "fully_fused_projection", lambda means, quats, calc_compensations: None)  # 1.4
    model, view = model_of(random_scene(3, WIDTH, HEIGHT, seed=0))
    with pytest.raises(ImportError, match=r"gsplat 1\.5"):
        model.lists(torch.ones(3), view)


def test_a_cpu_is_refused():
    model, view = model_of(random_scene(3, WIDTH, HEIGHT, seed=0))
    for method in (model.render, model.rasterized, model.lists):
        with pytest.raises(RuntimeError, match=r"CUDA .*on cpu"):
            method(torch.ones(3), view)


@pytest.mark.gpu
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplats_kernels_list_what_they_render(antialiased):
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    pytest.importorskip("gsplat", exc_type=ImportError)
    scene = centered(random_scene(200, 64, 48, seed=4)).to(torch.float32, "cuda")
    sh = torch.randn(200, 9, 3, generator=torch.Generator().manual_seed(0)).cuda() / 4
    model, view = model_of(scene, colors=sh, sh_degree=2, antialiased=antialiased)
    with torch.no_grad():
        image, alpha = model.render(scene.opacities, view)
        moments = ListMoments(model.lists)(scene.opacities, view, Multiplier(1.0, 0.0), None)
    # The mean without any factors is the render. That ends at a transmittance of 1e-4 after the next splat, which is of
    # alpha 0.9 at most: less than 1e-3 is missing.
    torch.testing.assert_close(moments.mean, image, rtol=0, atol=2e-3)
    torch.testing.assert_close(moments.alpha_mean, alpha, rtol=0, atol=2e-3)
    exact = CAScore.exact(ListMoments(model.lists), drop_rate=0.5, threshold=0.3)(scene.opacities, view)
    sampled = CAScore(model.render, drop_rate=0.5, threshold=0.3, samples=256, ddof=1)(scene.opacities, view)
    # The region of the one is where the mean alpha is above the threshold, of the other where every alpha is.
    both = exact.visible & sampled.visible
    assert exact.variance[both].mean().item() == pytest.approx(sampled.variance[both].mean().item(), rel=0.1)
