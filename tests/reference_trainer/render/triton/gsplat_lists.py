"""The exact score over gsplat's lists, in Triton's interpreter; run by `test_interpreted.py`.

``meta`` is made by gsplat's own torch functions, as its kernels need a card.
"""

import sys

import pytest
import torch
from oracles import random_scene
from stand_ins import gsplat as stand_in
from stand_ins.gsplat import centered, intrinsics

from ca_reg import CAScore, GaussianDropout, attribute
from ca_reg.functional import Multiplier
from ca_reg.integrations import gsplat_model as module
from ca_reg.integrations.gsplat import regularized
from ca_reg.integrations.gsplat_model import GsplatModel, GsplatView
from ca_reg.lists import ListMoments
from reference_trainer.render.triton.gsplat import GsplatMoments

pytestmark = pytest.mark.slow
WIDTH, HEIGHT, TILE, N = 21, 18, 16, 24
BACKGROUND = torch.tensor([0.3, 0.9, 0.1])


@pytest.fixture
def package(monkeypatch):
    pytest.importorskip("gsplat.cuda._torch_impl", exc_type=ImportError)
    package = stand_in.package(max_alpha=0.999)
    monkeypatch.setattr(module, "load_gsplat", lambda device: package)
    module.largest_alpha.cache_clear()
    yield package
    module.largest_alpha.cache_clear()


@pytest.fixture
def scene():
    scene = centered(random_scene(N, WIDTH, HEIGHT, seed=5, size=0.15)).to(torch.float32)
    return scene._replace(opacities=(1.1 * scene.opacities).clamp(max=1))  # some beyond 0.99


def meta_of(package, scene, opacity, packed):
    """What `gsplat.rasterization` returns as ``meta``, by the names of its lists."""
    view = GsplatView(scene.camera.world_to_camera, intrinsics(scene.camera), WIDTH, HEIGHT)
    radii, means2d, depths, conics, _ = package.fully_fused_projection(
        scene.means, None, scene.quaternions, scene.scales, view.viewmat[None], view.K[None], WIDTH, HEIGHT, 0.3, 0.01,
        False, False, opacity,
    )  # fmt: skip
    columns, rows = -(-WIDTH // TILE), -(-HEIGHT // TILE)
    _, ids, flatten = package.isect_tiles(means2d, radii, depths, TILE, columns, rows)
    offsets = package.isect_offset_encode(ids, 1, columns, rows).reshape(1, rows, columns)
    meta = {"means2d": means2d, "conics": conics, "opacities": opacity.reshape(1, -1)}
    if packed:
        which = flatten.long().unique()
        place = torch.zeros(N, dtype=flatten.dtype)
        place[which] = torch.arange(len(which), dtype=flatten.dtype)
        meta = {name: x[0, which] for name, x in meta.items()} | {"gaussian_ids": which}
        flatten = place[flatten.long()]
    return meta | {
        "isect_offsets": offsets,
        "flatten_ids": flatten,
        "tile_size": TILE,
        "width": WIDTH,
        "height": HEIGHT,
    }


@pytest.mark.parametrize("packed", [False, True])
def test_score_map_and_shares_are_those_of_listed_pixels(package, scene, packed):
    view = GsplatView(scene.camera.world_to_camera, intrinsics(scene.camera), WIDTH, HEIGHT)
    model = GsplatModel(scene.means, scene.quaternions, scene.scales, scene.colors, background=BACKGROUND)
    theirs = ListMoments(model.lists)
    ours = GsplatMoments(
        lambda opacity, _: (scene.colors, meta_of(package, scene, opacity, packed)),
        background=BACKGROUND,
        max_alpha=0.999,
    )
    each = torch.rand(2, N, generator=torch.Generator().manual_seed(1))
    for multiplier in (Multiplier.dropout(0.5), Multiplier(*each)):
        with torch.no_grad():
            a, b = (x(scene.opacities, view, multiplier, None) for x in (ours, theirs))
        for mine, listed in zip(a, b, strict=True):
            assert (mine - listed).abs().max() < 1e-5
    scores = [CAScore.exact(x, drop_rate=0.5, threshold=0.3) for x in (ours, theirs)]
    mine, listed = (
        attribute(score, x.shares, scene.opacities, view).shares
        for score, x in zip(scores, (ours, theirs), strict=True)
    )
    assert (mine - listed).abs().max() <= 1e-4 * listed.max()


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_score_of_a_model_in_one_pass_is_that_of_its_lists(package, scene, antialiased):
    """Of spherical harmonics, though gsplat's function is regularized."""
    sh = torch.randn(N, 4, 3, generator=torch.Generator().manual_seed(2)) / 4
    model = GsplatModel(scene.means, scene.quaternions, scene.scales, sh, 1, BACKGROUND, antialiased=antialiased)
    view = GsplatView(scene.camera.world_to_camera, intrinsics(scene.camera), WIDTH, HEIGHT)
    drawn = package.rasterization

    def rasterization(means, quats, scales, opacities, viewmats, **options):
        *images, _ = drawn(means=means, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, **options)
        compensated = opacities
        if options["rasterize_mode"] == "antialiased":
            *_, compensations = package.fully_fused_projection(
                means, None, quats, scales, viewmats, view.K[None], WIDTH, HEIGHT, 0.3, 0.01, False, True, opacities
            )
            compensated = opacities * compensations[0]
        return *images, meta_of(package, scene, compensated, False)

    package.rasterization = regularized(rasterization, GaussianDropout(0.5))
    one_pass = GsplatMoments(model.rasterized, background=BACKGROUND, max_alpha=0.999)
    scores = [CAScore.exact(x, threshold=0.3) for x in (one_pass, ListMoments(model.lists))]
    mine, listed = (score(scene.opacities, view).value for score in scores)
    assert mine == pytest.approx(listed, rel=1e-4)


def test_a_regularizer_of_gsplats_function_is_bypassed(package, scene):
    hooked = regularized(
        lambda opacities, viewmats: (None, meta_of(package, scene, opacities, False)), GaussianDropout(0.5)
    )
    given = scene.opacities, None, Multiplier.dropout(0.5), None
    plain, mine = (
        GsplatMoments(lambda opacity, _: (scene.colors, function(opacity, None)[1]), max_alpha=0.999)(*given)  # noqa: B023
        for function in (hooked.rasterization, hooked)
    )
    assert all(torch.equal(a, b) for a, b in zip(plain, mine, strict=True))
    with torch.no_grad():
        assert (hooked(scene.opacities, None)[1]["opacities"][0] == 0.5 * scene.opacities).all()  # again, afterwards


@pytest.mark.parametrize(("version", "clamp"), [("1.5.3", 0.999), ("1.6.0", 0.99), ("1.6rc1", 0.99)])
def test_alphas_are_clamped_where_the_gsplat_that_is_there_does_so(
    package, scene, version, clamp, unnamed, monkeypatch
):
    """By whatever name it was installed: the one for AMD's cards is amd-gsplat."""
    unnamed("gsplat")
    monkeypatch.setattr(sys.modules["gsplat"], "__version__", version)
    given = scene.opacities, None, Multiplier.dropout(0.5), None
    told, itself = (
        GsplatMoments(lambda opacity, _: (scene.colors, meta_of(package, scene, opacity, False)), max_alpha=clamped)(
            *given
        )
        for clamped in (clamp, None)
    )
    assert all(torch.equal(one, other) for one, other in zip(told, itself, strict=True))


def test_several_cameras_are_refused(package, scene):
    def rasterize(opacity, view):
        meta = meta_of(package, scene, opacity, False)
        return scene.colors, meta | {"isect_offsets": meta["isect_offsets"].repeat(2, 1, 1)}

    with pytest.raises(ValueError, match="one camera"):
        GsplatMoments(rasterize)(scene.opacities, None, Multiplier.dropout(0.5), None)


def test_tiles_that_no_kernel_has_are_refused(package, scene):
    def rasterize(opacity, view):
        return scene.colors, meta_of(package, scene, opacity, False) | {"tile_size": 12}

    with pytest.raises(ValueError, match="tile_size must be a power of two, got 12"):
        GsplatMoments(rasterize)(scene.opacities, None, Multiplier.dropout(0.5), None)
