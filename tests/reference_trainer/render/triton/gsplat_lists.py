"""The exact score over gsplat's lists, in Triton's interpreter; run by `test_interpreted.py`.

``meta`` is made by gsplat's own torch functions, as its kernels need a card.
"""

import sys

import pytest
import torch
from oracles import random_scene
from stand_ins import gsplat as stand_in
from stand_ins.gsplat import centered, intrinsics

from ca_reg import CAScore, attribute
from ca_reg.functional import Multiplier
from ca_reg.integrations import gsplat_model as module
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


@pytest.mark.parametrize(("version", "clamp"), [("1.5.3", 0.999), ("1.6.0", 0.99)])
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
