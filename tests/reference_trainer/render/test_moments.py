"""Rendered moments against the closed form on brute-force alpha lists, and against sampling."""

import functools

import pytest
import torch
from oracles import GaussianScene, brute_force, random_scene

from ca_reg.functional import Multiplier, alpha_moments, pixel_moments
from reference_trainer.render import render, render_moments, splat

BACKGROUND = torch.tensor([0.3, 0.9, 0.1], dtype=torch.float64)


def backdrop(height, width):
    """A different background at every pixel."""
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(11), dtype=torch.float64)


def dense_moments(splats, multiplier, background, width, height):
    """The same moments from the alphas of every splat at every pixel, through ca_reg's closed form."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    order = torch.argsort(splats.projection.depths)
    dx, dy = ((axis[..., None] - splats.projection.means[order, i]) for i, axis in enumerate((x, y)))
    l11, l21, l22 = splats.projection.factors[order].unbind(1)
    raw = splats.opacities[order] * torch.exp(-0.5 * ((l11 * dx + l21 * dy) ** 2 + (l22 * dy) ** 2))
    alpha = raw + (raw.clamp(max=0.99) - raw).detach()
    alpha = torch.where(raw >= 1 / 255, alpha, 0.0)
    if isinstance(multiplier.mean, torch.Tensor):
        which = splats.indices[order]
        multiplier = Multiplier(multiplier.mean[which], multiplier.variance[which])
    colors = splats.colors[order].expand(*alpha.shape, 3)
    background = background if background.ndim == 1 else background.permute(1, 2, 0)
    mean, variance = pixel_moments(alpha, colors, multiplier, background=background)
    return (mean.permute(2, 0, 1), variance.permute(2, 0, 1), alpha_moments(alpha, multiplier)[0])


def per_gaussian(n):
    g = torch.Generator().manual_seed(5)
    m, v = torch.rand(2, n, generator=g, dtype=torch.float64)
    return Multiplier(m, v)


MULTIPLIERS = {"p": Multiplier.dropout(0.5), "sigma": Multiplier.opacity_noise(0.8), "each": per_gaussian(90)}


@functools.cache
def exact_moments(name, per_pixel):
    scene = random_scene(90, 37, 21, seed=2)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    return scene, dense_moments(splats, MULTIPLIERS[name], backdrop(21, 37) if per_pixel else BACKGROUND, 37, 21)


@pytest.mark.parametrize("name", MULTIPLIERS)
@pytest.mark.parametrize("per_pixel", [False, True])
def test_moments_equal_the_closed_form_per_pixel(name, per_pixel, case):
    scene, exact = exact_moments(name, per_pixel)
    background = (backdrop(21, 37) if per_pixel else BACKGROUND).to(case.dtype)
    s = scene.to(case.dtype)
    splats = splat(*s[:4], s.camera, colors=s.colors)
    ours = render_moments(splats, MULTIPLIERS[name], background=background)
    for mine, other in zip(ours, exact, strict=True):
        case.agrees(mine, other)
    assert (ours.variance >= 0).all()


def test_a_multiplier_may_have_the_shape_of_opacities_in_a_column(case):
    s = random_scene(30, 19, 13, seed=7).to(case.dtype)
    splats = splat(*s[:3], s.opacities[:, None], s.camera, colors=s.colors)
    row = Multiplier.clamped_noise(s.opacities, 0.8)
    column = Multiplier.clamped_noise(s.opacities[:, None], 0.8)
    assert torch.equal(render_moments(splats, column).variance, render_moments(splats, row).variance)


@pytest.mark.parametrize("behind", [BACKGROUND, backdrop(13, 19)], ids=["one color", "per pixel"])
def test_gradients_equal_autograd_through_the_closed_form(behind, case):
    scene = random_scene(40, 19, 13, seed=7)
    weights = torch.randn(7, 13, 19, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gradients = []
    for dtype, route in ((case.dtype, render_moments), (torch.float64, None)):
        s, each = scene.to(dtype), per_gaussian(40)
        leaves = [x.to(dtype).clone().requires_grad_() for x in (*s.tensors(), each.mean, each.variance, behind)]
        splats = splat(*leaves[:4], s.camera, colors=leaves[4])
        multiplier = Multiplier(leaves[5], leaves[6])
        if route is not None:
            images = route(splats, multiplier, background=leaves[7])
        else:
            images = dense_moments(splats, multiplier, leaves[7], 19, 13)
        stacked = torch.cat([x.reshape(-1, 13, 19) for x in images])
        (stacked * weights.to(dtype)).sum().backward()
        gradients.append([x.grad for x in leaves])
    for mine, other in zip(*gradients, strict=True):
        case.same_gradient(mine, other)


def test_a_background_whose_channels_lie_last_has_the_same_gradient(case):
    """The picture is one of whole tiles, which no engine has to pad, and so to copy."""
    scene = random_scene(30, 16, 8, seed=8, size=0.2).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    behind = backdrop(8, 16).to(case.dtype)
    gradients = []
    for background in (behind.clone(), behind.permute(1, 2, 0).contiguous().permute(2, 0, 1)):
        background.requires_grad_()
        moments = render_moments(splats, Multiplier.dropout(0.3), background=background)
        (moments.mean.square().sum() + moments.variance.sum()).backward()
        gradients.append(background.grad)
    assert torch.equal(*gradients)


def test_gradients_in_a_color_or_a_variance_alone(case):
    """Upstream gradients that are absent, or are zero but for one image."""
    scene = random_scene(30, 19, 13, seed=8, size=0.2)
    for pick in ("mean", "variance", "alpha_mean"):
        gradients = []
        for dtype, route in ((case.dtype, render_moments), (torch.float64, dense_moments)):
            s = scene.to(dtype)
            leaves = [x.clone().requires_grad_() for x in s.tensors()]
            splats = splat(*leaves[:4], s.camera, colors=leaves[4])
            if route is render_moments:
                image = getattr(route(splats, Multiplier.dropout(0.3)), pick)
            else:
                names = ("mean", "variance", "alpha_mean")
                black = torch.zeros(3, dtype=torch.float64)
                image = dict(zip(names, route(splats, Multiplier.dropout(0.3), black, 19, 13), strict=True))[pick]
            image.square().sum().backward()
            gradients.append([torch.zeros_like(x) if x.grad is None else x.grad for x in leaves])
        for mine, other in zip(*gradients, strict=True):
            case.same_gradient(mine, other)


def test_moments_are_those_of_all_masks(case):
    """Five Gaussians have 32 masks: the mean and the variance of their renders, with the probability of each."""
    scene = random_scene(5, 17, 11, seed=11, size=0.4)
    scene = scene._replace(means=0.3 * scene.means, opacities=0.2 + 0.5 * scene.opacities)  # no pixel ends early
    p = 0.3
    mean, square = torch.zeros(4, 11, 17).double(), torch.zeros(4, 11, 17).double()
    for mask in range(32):
        kept = torch.tensor([mask >> i & 1 for i in range(5)]).double()
        image, alpha = brute_force(*scene[:3], scene.opacities * kept, scene.colors, scene.camera)
        both = torch.cat([image + (1 - alpha) * BACKGROUND[:, None, None], alpha[None]])
        weight = (1 - p) ** kept.sum() * p ** (5 - kept.sum())
        mean, square = mean + weight * both, square + weight * both**2
    s = scene.to(case.dtype)
    splats = splat(*s[:4], s.camera, colors=s.colors)
    ours = render_moments(splats, Multiplier.dropout(p), background=BACKGROUND.to(case.dtype))
    case.agrees(torch.cat([ours.mean, ours.alpha_mean[None]]), mean)
    case.agrees(ours.variance, (square - mean**2)[:3])


def test_without_randomness_the_mean_is_the_render_and_the_variance_exactly_zero(case):
    scene = random_scene(60, 21, 17, seed=3)
    scene = GaussianScene(*scene[:3], 0.3 * scene.opacities, *scene[4:]).to(case.dtype)  # no pixel ends early
    background = BACKGROUND.to(case.dtype)
    moments = render_moments(
        splat(*scene[:4], scene.camera, colors=scene.colors), Multiplier(1.0, 0.0), background=background
    )
    out = render(*scene[:4], scene.camera, colors=scene.colors, background=background)
    rounding = 20 * torch.finfo(case.dtype).eps  # the same alphas, added up in another order
    torch.testing.assert_close(moments.mean, out.image, rtol=0, atol=rounding)
    torch.testing.assert_close(moments.alpha_mean, out.alpha, rtol=0, atol=rounding)
    assert not moments.variance.any()


def test_float32_variances_stay_close_to_float64(case):
    scene = random_scene(400, 40, 30, seed=4)
    exact = render_moments(splat(*scene[:4], scene.camera, colors=scene.colors), Multiplier.dropout(0.5))
    s = scene.to(case.dtype)
    single = render_moments(splat(*s[:4], s.camera, colors=s.colors), Multiplier.dropout(0.5))
    error = (single.variance - exact.variance).abs().amax(0)
    # A splat within rounding of the 1/255 cut may fall on the other side of it.
    assert (error > 1e-5).double().mean() < 0.01
    assert abs(single.variance.double().mean() / exact.variance.mean() - 1) < 1e-4


@pytest.mark.parametrize("background", [BACKGROUND, backdrop(7, 9)], ids=["one color", "per pixel"])
def test_nothing_in_view(background, case):
    scene = random_scene(3, 9, 7, seed=1).to(case.dtype)
    splats = splat(scene.means - 10 * scene.camera.forward, *scene[1:4], scene.camera, colors=scene.colors)
    background = background.to(case.dtype).clone().requires_grad_()
    moments = render_moments(splats, Multiplier.dropout(0.5), background=background)
    assert torch.equal(moments.mean, background.reshape(3, *background.shape[1:] or (1, 1)).expand(3, 7, 9))
    assert not moments.variance.any()
    moments.mean.sum().backward()
    assert torch.equal(background.grad, torch.full_like(background, 63 * 3 / background.numel()))


def test_a_background_of_another_size_is_refused(case):
    scene = random_scene(3, 9, 7, seed=1).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    with pytest.raises(ValueError, match=r"\(3,\) or \(3, 7, 9\), got \(3, 9, 7\)"):
        render_moments(splats, Multiplier.dropout(0.5), background=backdrop(9, 7))


@pytest.mark.parametrize("background", [torch.tensor([0.5, torch.nan, 0.5]), torch.full((3, 13, 19), torch.inf)])
def test_a_background_that_is_not_finite_is_refused(background, case):
    scene = random_scene(5, 19, 13, seed=7).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    with pytest.raises(ValueError, match=r"background .*in \d+ of \d+ numbers"):
        render_moments(splats, Multiplier.dropout(0.5), background=background)


def test_a_backward_pass_inside_autocast_keeps_its_precision(engine):
    """As of the plain renderer."""
    gradients = []
    for enabled in (False, True):
        scene = random_scene(40, 19, 13, seed=7).to(torch.float32, torch.device("cpu"))
        leaves = [x.clone().requires_grad_() for x in (scene.opacities, scene.colors)]
        splats = splat(*scene[:3], leaves[0], scene.camera, colors=leaves[1])
        out = render_moments(splats, Multiplier.dropout(0.5))
        loss = out.mean.square().sum() + out.variance.sum()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            loss.backward()
        gradients.append([x.grad for x in leaves])
    assert all(torch.equal(plain, cast) for plain, cast in zip(*gradients, strict=True))
