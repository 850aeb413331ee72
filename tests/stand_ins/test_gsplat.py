"""The stand-in for gsplat against the package itself: its signature, and its projection in torch."""

import inspect

import pytest
import torch
from oracles import random_scene
from stand_ins.gsplat import intrinsics, rasterization, rasterization_1_4

N, WIDTH, HEIGHT = 60, 24, 16


@pytest.fixture
def splats():
    scene = random_scene(N, WIDTH, HEIGHT, seed=3).to(torch.float32)
    return dict(zip(("means", "quats", "scales", "opacities", "colors"), scene.tensors(), strict=True))


@pytest.fixture
def cameras():
    """Two views of it."""
    camera = random_scene(N, WIDTH, HEIGHT, seed=3).camera
    poses = torch.stack([camera.world_to_camera, camera.world_to_camera]).float()
    poses[1, 0, 3] += 0.4
    return {"viewmats": poses, "Ks": intrinsics(camera).float().expand(2, 3, 3), "width": WIDTH, "height": HEIGHT}


def test_it_has_the_signature_of_the_package():
    gsplat = pytest.importorskip("gsplat", exc_type=ImportError)
    theirs = inspect.signature(gsplat.rasterization).parameters
    for stand_in in (rasterization, rasterization_1_4):
        ours = inspect.signature(stand_in).parameters
        assert list(theirs)[: len(ours)] == list(ours)
        assert {x: p.default for x, p in ours.items() if x != "tile_size"} == {  # 16, or None for 16, by version
            x: theirs[x].default for x in ours if x != "tile_size"
        }


def test_it_projects_as_the_package_does(splats, cameras):
    own = pytest.importorskip("gsplat.cuda._torch_impl", exc_type=ImportError)
    covariance = getattr(own, "_quat_scale_to_covar_preci", None)
    if covariance is None:
        pytest.skip("this gsplat keeps its torch version elsewhere")
    covars, _ = covariance(splats["quats"], splats["scales"], True, False, triu=False)
    camera = {"viewmats": cameras["viewmats"], "Ks": cameras["Ks"], "width": WIDTH, "height": HEIGHT}
    # 0.2 is the near plane of the stand-in.
    radii, means2d, depths, conics, _ = own._fully_fused_projection(splats["means"], covars, **camera, near_plane=0.2)
    _, _, info = rasterization(**splats, **cameras, packed=False)
    drawn = (info["radii"] > 0).all(-1)
    assert torch.equal(drawn, (radii > 0).all(-1))
    assert 10 < drawn.sum() < 2 * N
    assert (info["radii"] - radii)[drawn].abs().max() <= 1  # of a ceiling
    torch.testing.assert_close(info["means2d"][drawn], means2d[drawn], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(info["depths"], depths[drawn], rtol=1e-5, atol=1e-5)
    # The two differ off the axis, where the slope is clamped: by the picture's half size there, by its borders here.
    inside = ((means2d > 0) & (means2d < torch.tensor([WIDTH, HEIGHT]))).all(-1)[drawn]
    torch.testing.assert_close(info["conics"][inside], conics[drawn][inside], rtol=1e-3, atol=1e-4)


def test_depth_and_background(splats, cameras):
    """What the reference trainer's choice of gsplat asks for."""
    backgrounds = torch.tensor([[0.2, 0.4, 0.6]]).expand(2, 3)
    plain, alpha, _ = rasterization(**splats, **cameras)
    image, _, _ = rasterization(**splats, **cameras, backgrounds=backgrounds, render_mode="RGB+D")
    assert image.shape == (2, HEIGHT, WIDTH, 4)
    torch.testing.assert_close(image[..., :3], plain + (1 - alpha) * backgrounds[:, None, None])
