"""Rendered moments against the closed form on brute-force alpha lists, and against sampling."""

import pytest
import torch
from oracles import GaussianScene, random_scene
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from ca_reg.functional import Multiplier, alpha_moments, pixel_moments
from reference_trainer.render import moments, render, splat
from reference_trainer.render.footprints import PIXELS
from reference_trainer.render.moments import render_moments

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
    return (mean.permute(2, 0, 1), variance.permute(2, 0, 1), *alpha_moments(alpha, multiplier))


def per_gaussian(n):
    g = torch.Generator().manual_seed(5)
    m, v = torch.rand(2, n, generator=g, dtype=torch.float64)
    return Multiplier(m, v)


@pytest.mark.parametrize(
    "multiplier", [Multiplier.dropout(0.5), Multiplier.opacity_noise(0.8), per_gaussian(90)], ids=["p", "sigma", "each"]
)
@pytest.mark.parametrize("background", [BACKGROUND, backdrop(21, 37)], ids=["one colour", "per pixel"])
def test_moments_equal_the_closed_form_per_pixel(multiplier, background):
    scene = random_scene(90, 37, 21, seed=2)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    ours = render_moments(splats, multiplier, background=background)
    for mine, other in zip(ours, dense_moments(splats, multiplier, background, 37, 21), strict=True):
        torch.testing.assert_close(mine, other, rtol=0, atol=1e-13)


@pytest.mark.parametrize("behind", [BACKGROUND, backdrop(13, 19)], ids=["one colour", "per pixel"])
def test_gradients_equal_autograd_through_the_closed_form(behind):
    scene = random_scene(40, 19, 13, seed=7)
    g = torch.Generator().manual_seed(0)
    weights = torch.randn(8, 13, 19, generator=g, dtype=torch.float64)
    gradients = []
    for route in (render_moments, None):
        leaves = [x.clone().requires_grad_() for x in (*scene.tensors(), *torch.rand(2, 40, generator=g).double())]
        background = behind.clone().requires_grad_()
        splats = splat(*leaves[:4], scene.camera, colors=leaves[4])
        multiplier = per_gaussian(40)
        multiplier = Multiplier(multiplier.mean.requires_grad_(), multiplier.variance.requires_grad_())
        if route is not None:
            images = route(splats, multiplier, background=background)
        else:
            images = dense_moments(splats, multiplier, background, 19, 13)
        stacked = torch.cat([x.reshape(-1, 13, 19) for x in images])
        (stacked * weights).sum().backward()
        gradients.append([x.grad for x in (*leaves[:5], multiplier.mean, multiplier.variance, background)])
    for mine, other in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-11)


def test_dropout_mean_is_the_scaled_render_and_variance_the_limit_of_sampling():
    scene = random_scene(150, 16, 12, seed=9, size=0.15)
    g = torch.Generator().manual_seed(1)
    moments = render_moments(splat(*scene[:4], scene.camera, colors=scene.colors), Multiplier.dropout(0.5))
    # Masked renders stop at a transmittance of 1e-4, so a sample is off by at most that.
    samples = torch.stack(
        [
            render(
                *scene[:3],
                scene.opacities * (torch.rand(150, generator=g) < 0.5),
                scene.camera,
                colors=scene.colors,
            ).image
            for _ in range(600)
        ]
    )
    # 600 samples: the relative standard error of an image mean of variances is below 1/sqrt(600) = 4 %, and the image
    # holds several independent splats; 5 such errors are passed by chance less than once in a million.
    assert abs(samples.var(0).mean() / moments.variance.mean() - 1) < 0.2
    error = (samples.mean(0) - moments.mean) / (moments.variance / 600).sqrt().clamp(min=1e-5)
    assert error.square().mean() < 2


def test_without_randomness_the_mean_is_the_render_and_the_variance_exactly_zero():
    scene = random_scene(60, 21, 17, seed=3)
    scene = GaussianScene(*scene[:3], 0.3 * scene.opacities, *scene[4:])  # no pixel ends early
    moments = render_moments(
        splat(*scene[:4], scene.camera, colors=scene.colors), Multiplier(1.0, 0.0), background=BACKGROUND
    )
    out = render(*scene[:4], scene.camera, colors=scene.colors, background=BACKGROUND)
    torch.testing.assert_close(moments.mean, out.image, rtol=0, atol=1e-13)
    torch.testing.assert_close(moments.alpha_mean, out.alpha, rtol=0, atol=1e-13)
    assert not moments.variance.any()


def test_float32_stays_close_to_float64():
    scene = random_scene(400, 40, 30, seed=4)
    exact = render_moments(splat(*scene[:4], scene.camera, colors=scene.colors), Multiplier.dropout(0.5))
    s = scene.to(torch.float32)
    single = render_moments(splat(*s[:4], s.camera, colors=s.colors), Multiplier.dropout(0.5))
    error = (single.variance - exact.variance).abs().amax(0)
    # A splat within rounding of the 1/255 cut may fall on the other side of it.
    assert (error > 1e-5).double().mean() < 0.01
    assert abs(single.variance.double().mean() / exact.variance.mean() - 1) < 1e-4


@pytest.mark.parametrize("background", [BACKGROUND, backdrop(7, 9)], ids=["one colour", "per pixel"])
def test_nothing_in_view(background):
    scene = random_scene(3, 9, 7, seed=1)
    splats = splat(scene.means - 10 * scene.camera.forward, *scene[1:4], scene.camera, colors=scene.colors)
    background = background.clone().requires_grad_()
    moments = render_moments(splats, Multiplier.dropout(0.5), background=background)
    assert torch.equal(moments.mean, background.reshape(3, *background.shape[1:] or (1, 1)).expand(3, 7, 9))
    assert not moments.variance.any()
    moments.mean.sum().backward()
    assert torch.equal(background.grad, torch.full_like(background, 63 * 3 / background.numel()))


def test_a_background_of_another_size_is_refused():
    scene = random_scene(3, 9, 7, seed=1)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    with pytest.raises(ValueError, match=r"\(3,\) or \(3, 7, 9\), got \(3, 9, 7\)"):
        render_moments(splats, Multiplier.dropout(0.5), background=backdrop(9, 7))


@pytest.mark.parametrize("rows", [1, 7])
def test_lists_taken_in_parts_have_the_same_gradients(rows, monkeypatch):
    scene = random_scene(60, 19, 13, seed=7)
    weights = torch.randn(8, 13, 19, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def gradients():
        leaves = [x.clone().requires_grad_() for x in scene.tensors()]
        images = render_moments(splat(*leaves[:4], scene.camera, colors=leaves[4]), per_gaussian(60))
        (torch.cat([x.reshape(-1, 13, 19) for x in images]) * weights).sum().backward()
        return [x.grad for x in leaves]

    whole = gradients()
    monkeypatch.setattr(moments, "moment_block_size", lambda device: rows * PIXELS)
    for mine, other in zip(gradients(), whole, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-11, atol=1e-13)


class LargestTensor(TorchDispatchMode):
    """Notes the number of elements of the largest tensor that any operation returns."""

    elements = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for x in tree_flatten(result)[0]:
            if isinstance(x, torch.Tensor):
                self.elements = max(self.elements, x.untyped_storage().nbytes() // x.element_size())
        return result


def test_no_tensor_grows_with_the_pixel_gaussian_pairs_of_a_long_list(monkeypatch):
    n, pairs = 900, 20 * PIXELS
    scene = random_scene(n, 8, 8, seed=3, size=1.0)
    monkeypatch.setattr(moments, "moment_block_size", lambda device: pairs)
    monkeypatch.setattr(moments, "block_size", lambda device: pairs)
    leaves = [x.clone().requires_grad_() for x in scene.tensors()]
    splats = splat(*leaves[:4], scene.camera, colors=leaves[4])
    longest = splats.lists.lengths.max()
    assert longest > 500
    with LargestTensor() as largest:
        images = render_moments(splats, Multiplier.dropout(0.5))
        images.variance.sum().backward()
    # Either a row of 14 numbers per Gaussian, or four buffers of what is held at once.
    assert largest.elements <= max(16 * (n + 1), 8 * pairs) < PIXELS * longest


@pytest.mark.parametrize("background", [torch.tensor([0.5, torch.nan, 0.5]), torch.full((3, 13, 19), torch.inf)])
def test_a_background_that_is_not_finite_is_refused(background):
    scene = random_scene(5, 19, 13, seed=7)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    with pytest.raises(ValueError, match=r"background must be finite, got nan or infinity in \d+ of \d+ numbers"):
        render_moments(splats, Multiplier.dropout(0.5), background=background)


def test_a_backward_pass_inside_autocast_keeps_its_precision():
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
