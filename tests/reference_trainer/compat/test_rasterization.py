"""The stand-in for `gsplat.rasterization` against gsplat's own projection in torch, composited pixel by pixel."""

import inspect
import math

import pytest
import torch
from oracles import random_scene
from stand_ins.gsplat import centered, intrinsics

from reference_trainer.compat.gsplat import make_rasterization, quat_scale_to_covar_preci

rendering = pytest.importorskip("gsplat.rendering")
own = pytest.importorskip("gsplat.cuda._torch_impl")

N, WIDTH, HEIGHT = 24, 22, 14
LEARNED = ("means", "quats", "scales", "opacities", "colors")
rasterization = make_rasterization(rendering.rasterization, per_axis=True)


def given(seed=3, n=N, dtype=torch.float64, **changes):
    """Arguments of a call: two views of one scene, one Gaussian in six behind them."""
    scene = centered(random_scene(n, WIDTH, HEIGHT, seed=seed, size=0.15)).to(dtype)
    poses = torch.stack([scene.camera.world_to_camera] * 2)
    poses[1, :2, 3] += torch.tensor([0.4, -0.2], dtype=dtype)
    lens = intrinsics(scene.camera).expand(2, 3, 3)
    tensors = dict(zip(LEARNED, scene.tensors(), strict=True))
    return {**tensors, "viewmats": poses, "Ks": lens, "width": WIDTH, "height": HEIGHT, **changes}


def slow(a):
    """Render with gsplat's torch projection and harmonics, one Gaussian after the other at all pixels."""
    covariances, _ = own._quat_scale_to_covar_preci(a["quats"], a["scales"], True, False)
    radii, means2d, depths, conics, compensations = own._fully_fused_projection(
        a["means"], covariances, a["viewmats"], a["Ks"], WIDTH, HEIGHT, eps2d=a.get("eps2d", 0.3),
        near_plane=a.get("near_plane", 0.01), far_plane=a.get("far_plane", 1e10), calc_compensations=True,
    )  # fmt: skip
    y, x = torch.meshgrid(torch.arange(HEIGHT).double() + 0.5, torch.arange(WIDTH).double() + 0.5, indexing="ij")
    sums, alphas, colors = [], [], a["colors"]
    for c in range(2):
        opacities = a["opacities"] * (compensations[c] if a.get("rasterize_mode") == "antialiased" else 1)
        if a.get("sh_degree") is not None:
            directions = a["means"] - torch.linalg.inv(a["viewmats"][c])[:3, 3]
            colors = (own._spherical_harmonics(a["sh_degree"], directions, a["colors"]) + 0.5).clamp_min(0)
        values = torch.cat([colors if colors.ndim == 2 else colors[c], depths[c][:, None]], dim=1)
        light, total = torch.ones_like(y).to(values), torch.zeros(HEIGHT, WIDTH, 4).to(values)
        for i in depths[c].argsort().tolist():
            if (radii[c, i] == 0).any():
                continue
            dx, dy = x - means2d[c, i, 0], y - means2d[c, i, 1]
            p, q, r = conics[c, i]
            alpha = opacities[i] * torch.exp(-0.5 * (p * dx * dx + 2 * q * dx * dy + r * dy * dy))
            alpha = torch.where(alpha >= 1 / 255, alpha, 0)
            total = total + (light * alpha)[..., None] * values[i]
            light = light * (1 - alpha)
        assert light.min() > 1e-4  # else the order in which a pixel ends would have to be imitated
        sums.append(total)
        alphas.append(1 - light)
    return torch.stack(sums), torch.stack(alphas)[..., None], radii, means2d, depths, conics


def expected(a, sums, alpha):
    """What gsplat returns for a mode, of sums of colors and depths."""
    mode = a.get("render_mode", "RGB")
    depth = sums[..., 3:] / (alpha.clamp_min(1e-10) if "ED" in mode else 1)
    behind = a.get("backgrounds")
    color = sums[..., :3] if behind is None else sums[..., :3] + (1 - alpha) * behind[:, None, None]
    return torch.cat([*([color] if "RGB" in mode else []), *([depth] if "D" in mode else [])], dim=-1)


def harmonics(count, seed=4):
    return torch.randn(count, 16, 3, generator=torch.Generator().manual_seed(seed)).double()


BACKGROUNDS = torch.tensor([[0.2, 0.5, 0.9], [0.7, 0.1, 0.0]]).double()
CASES = {
    "colors": {"backgrounds": BACKGROUNDS},
    "colors of each camera": {"colors": torch.stack([harmonics(N)[:, 0], harmonics(N)[:, 1]]), "packed": False},
    "harmonics": {"colors": harmonics(N), "sh_degree": 2, "packed": False, "backgrounds": BACKGROUNDS},
    "antialiased": {"rasterize_mode": "antialiased"},
    "less blur": {"eps2d": 0.1, "packed": False},
    "less blur, antialiased": {"eps2d": 0.1, "rasterize_mode": "antialiased"},
    "near and far": {"near_plane": 1.6, "far_plane": 2.3, "render_mode": "RGB+D", "packed": False},
    "depth": {"render_mode": "D", "backgrounds": BACKGROUNDS},
    "expected depth": {"render_mode": "ED", "packed": False},
    "with expected depth": {"render_mode": "RGB+ED", "backgrounds": BACKGROUNDS},
}


@pytest.mark.parametrize("case", CASES)
def test_pictures_and_gradients_are_gsplats(case):
    a = given(**CASES[case])
    ours, theirs = ({**a, **{k: a[k].clone().requires_grad_() for k in LEARNED}} for _ in range(2))
    image, alpha, info = rasterization(**ours)
    sums, slow_alpha, _, means2d, depths, _ = slow(theirs)
    slow_image = expected(a, sums, slow_alpha)
    torch.testing.assert_close(image, slow_image, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(alpha, slow_alpha, rtol=0, atol=1e-9)

    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1)).double()
    info["means2d"].retain_grad()
    means2d.retain_grad()
    for color, light in ((image, alpha), (slow_image, slow_alpha)):
        ((color * weights).sum() + (light * weights[..., :1]).sum()).backward()
    for name in LEARNED:
        if name != "colors" or "RGB" in a.get("render_mode", "RGB"):
            torch.testing.assert_close(ours[name].grad, theirs[name].grad, rtol=1e-6, atol=1e-7, msg=name)
    seen = (info["camera_ids"], info["gaussian_ids"]) if a.get("packed", True) else (info["radii"] > 0).all(-1)
    assert len(means2d[seen]) > N / 3
    pick = slice(None) if a.get("packed", True) else seen
    torch.testing.assert_close(info["means2d"][pick], means2d[seen], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(info["means2d"].grad[pick], means2d.grad[seen], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(info["depths"][pick], depths[seen], rtol=1e-9, atol=1e-9)
    # Who is not listed has got nothing: the fainter ones end before the rectangles that gsplat's torch code renders.
    unseen = torch.ones_like(depths, dtype=torch.bool)
    unseen[seen] = False
    assert not means2d.grad[unseen].any()


def test_in_single_precision_the_engine_of_the_machine_renders_the_same():
    a = given(colors=harmonics(N), sh_degree=3, render_mode="RGB+ED")
    single = {k: x.float() if isinstance(x, torch.Tensor) else x for k, x in a.items()}
    leaves = [x["means"].requires_grad_() for x in (a, single)]
    images = [rasterization(**x)[0] for x in (a, single)]
    torch.testing.assert_close(images[1].double(), images[0], rtol=1e-4, atol=1e-4)
    for image in images:
        image.sum().backward()
    torch.testing.assert_close(leaves[1].grad.double(), leaves[0].grad, rtol=1e-3, atol=2e-2)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_mixed_precision_changes_nothing(mode):
    """As with gsplat's kernels, which know float32 alone."""
    a = given(dtype=torch.float32, rasterize_mode=mode, eps2d=0.1)
    plain = [*rasterization(**a)[:2], *quat_scale_to_covar_preci(a["quats"], a["scales"])]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = [*rasterization(**a)[:2], *quat_scale_to_covar_preci(a["quats"], a["scales"])]
    assert all(torch.equal(one, other) for one, other in zip(plain, cast, strict=True))


@pytest.mark.parametrize("packed", [True, False])
def test_absolute_gradients_are_sums_over_the_pixels(packed):
    a = given(n=9, render_mode="RGB+D", packed=packed, absgrad=True, backgrounds=BACKGROUNDS)
    leaf = {**a, "means": a["means"].clone().requires_grad_()}
    image, alpha, info = rasterization(**leaf)
    weights = torch.randn(2, HEIGHT, WIDTH, 5, generator=torch.Generator().manual_seed(2)).double()
    weights *= (torch.arange(HEIGHT * WIDTH) % 11 == 0).view(HEIGHT, WIDTH, 1)  # all pixels would take half a minute
    (torch.cat([image, alpha], dim=-1) * weights).sum().backward()

    sums, light, _, means2d, _, _ = slow({**a, "means": a["means"].clone().requires_grad_()})
    loss = (torch.cat([expected(a, sums, light), light], dim=-1) * weights).sum(-1).flatten()
    absolute = sum(torch.autograd.grad(x, means2d, retain_graph=True)[0].abs() for x in loss[loss != 0])
    found = info["means2d"].absgrad
    if packed:
        absolute = absolute[info["camera_ids"], info["gaussian_ids"]]
    torch.testing.assert_close(found, absolute, rtol=1e-7, atol=1e-8)
    assert found.any()


def test_radii_of_either_version():
    a = given(near_plane=1.0)
    conics = slow(a)[-1]
    covariances = torch.linalg.inv(torch.stack([conics[..., :2], conics[..., 1:]], dim=-1))
    xx, xy, yy = (covariances[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    extent = (2 * (255 * a["opacities"]).log()).sqrt().clamp(max=3.33)
    since_1_5 = (extent[None, :, None] * torch.stack([xx, yy], dim=-1).sqrt()).ceil()
    middle, determinant = (xx + yy) / 2, xx * yy - xy * xy
    until_1_4 = (3 * (middle + (middle * middle - determinant).clamp(min=0.01).sqrt()).sqrt()).ceil()
    radii = rasterization(**a, packed=False)[2]["radii"]
    older = make_rasterization(rendering.rasterization, per_axis=False)
    radius = older(**a, packed=False)[2]["radii"]
    assert (radii.shape, radii.dtype, radius.shape) == ((2, N, 2), torch.int32, (2, N))
    for found, sides in ((radii, since_1_5), (radius, until_1_4)):
        seen = found > 0
        assert 0.3 < seen.double().mean() < 1
        assert torch.equal(found[seen], sides[seen].int())
    assert torch.equal(rasterization(**a)[2]["radii"], radii[(radii > 0).all(-1)])
    assert torch.equal(older(**a)[2]["radii"], radius[radius > 0])


@pytest.mark.parametrize("per_axis", [True, False])
def test_the_radius_of_a_diverged_gaussian_is_no_negative_number(per_axis):
    a = given(n=3, means=torch.zeros(3, 3).double(), scales=torch.full((3, 3), 1e10).double())
    radii = make_rasterization(rendering.rasterization, per_axis=per_axis)(**a)[2]["radii"]
    assert radii.min() == radii.max() == 2**31 - 128


def test_small_and_faint_gaussians_are_left_out():
    a = given()
    clip = 4
    small = (rasterization(**a, packed=False)[2]["radii"] <= clip).all(-1)
    assert small.any()
    assert not small.all()
    image, _, info = rasterization(**a, packed=False, radius_clip=clip)
    assert torch.equal((info["radii"] > 0).all(-1), ~small)
    for c in range(2):
        only = {**a, "viewmats": a["viewmats"][c : c + 1], "Ks": a["Ks"][:1]}
        without = rasterization(**{**only, "opacities": a["opacities"] * ~small[c]})
        torch.testing.assert_close(image[c], without[0][0], rtol=0, atol=1e-12)
        assert not small[c][without[2]["gaussian_ids"]].any()


def test_nothing_in_view_and_no_gradients():
    a = given(colors=torch.rand(N, 3).double(), backgrounds=BACKGROUNDS)
    away = {**a, "means": a["means"] - 100}
    image, alpha, info = rasterization(**away)
    assert torch.equal(image, BACKGROUNDS[:, None, None].expand(2, HEIGHT, WIDTH, 3))
    assert not alpha.any()
    assert info["means2d"].shape == (0, 2)
    assert not info["means2d"].requires_grad


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"eps2d": 0.5}, r"eps2d.* must be in \[0, 0.3\] .* got 0.5"),
        ({"camera_model": "fisheye"}, "camera_model .* got 'fisheye'"),
        ({"covars": torch.zeros(N, 3, 3)}, r"covars .* a tensor of shape \(24, 3, 3\)"),
        ({"distributed": True}, "distributed"),
        ({"with_ut": True}, "with_ut"),
        ({"radial_coeffs": torch.zeros(2, 4)}, "radial_coeffs"),
        ({"render_mode": "RGB-d"}, "render_mode .*RGB, D, ED"),
        ({"colors": torch.zeros(N, 8)}, "colors .* three channels"),
        ({"means": torch.zeros(2, N, 3)}, "means .* a single scene"),
        ({"viewmats": torch.eye(4).repeat(2, 1, 1).requires_grad_()}, "viewmats .*pose_opt"),
    ],
)
def test_what_the_renderer_has_not_is_refused_by_name(changes, message):
    if missing := set(changes) - set(inspect.signature(rasterization).parameters):
        pytest.skip(f"this gsplat has no {missing}")
    with pytest.raises(ValueError, match=message):
        rasterization(**given(**changes))


def test_what_only_says_how_fast_is_taken():
    a = given()
    image = rasterization(**a, tile_size=32, channel_chunk=8, sparse_grad=True)[0]
    assert torch.equal(image, rasterization(**a)[0])
    assert math.isclose(image.sum().item(), rasterization(*a.values())[0].sum().item())
