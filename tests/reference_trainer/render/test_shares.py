"""Shares of the rendered variance against the closed form on brute-force alpha lists."""

import pytest
import torch
from oracles import random_scene

from ca_reg.functional import Multiplier, contributions
from reference_trainer.render import render_moments, splat, variance_shares
from reference_trainer.render.densification import splat_weights


def dense_shares(splats, multiplier, weights, background):
    """The same shares from the alphas of every splat at every pixel, through ca_reg's closed form."""
    height, width = weights.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    order = torch.argsort(splats.projection.depths)
    dx, dy = ((axis[..., None] - splats.projection.means[order, i]) for i, axis in enumerate((x, y)))
    l11, l21, l22 = splats.projection.factors[order].unbind(1)
    raw = splats.opacities[order] * torch.exp(-0.5 * ((l11 * dx + l21 * dy) ** 2 + (l22 * dy) ** 2))
    alpha = torch.where(raw >= 1 / 255, raw.clamp(max=0.99), 0.0)
    parts = contributions(alpha, splats.colors[order].expand(*alpha.shape, 3), multiplier, background=background)
    return torch.empty_like(weights[0, 0].expand(len(order))).index_copy(
        0, order, (parts.mean(-1) * weights[..., None]).sum((0, 1))
    )


@pytest.mark.parametrize("multiplier", [Multiplier.dropout(0.5), Multiplier.opacity_noise(0.8)], ids=["p", "sigma"])
def test_shares_equal_the_closed_form(multiplier, case):
    scene = random_scene(80, 29, 18, seed=12)
    weights = torch.rand(18, 29, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    exact = dense_shares(splat(*scene[:4], scene.camera, colors=scene.colors), multiplier, weights, background)
    s = scene.to(case.dtype)
    splats = splat(*s[:4], s.camera, colors=s.colors)
    shares = variance_shares(splats, multiplier, weights.to(case.dtype), background=background.to(case.dtype))
    assert shares.dtype == torch.float64
    assert (shares - exact).norm() <= case.gradient * exact.norm()
    assert shares.shape == splats.indices.shape
    assert (shares >= 0).all()


def test_shares_add_up_to_the_weighted_variance(case):
    scene = random_scene(200, 40, 24, seed=13).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    weights = torch.rand(24, 40, generator=torch.Generator().manual_seed(1), dtype=case.dtype)
    total = (render_moments(splats, Multiplier.dropout(0.5)).variance.mean(0) * weights).double().sum()
    rounding = {torch.float64: 1e-12, torch.float32: 1e-5}[case.dtype]
    shares = variance_shares(splats, Multiplier.dropout(0.5), weights)
    torch.testing.assert_close(shares.sum(), total, rtol=rounding, atol=0)


def test_a_splat_whose_color_is_that_behind_it_has_no_share(case):
    scene = random_scene(1, 16, 12, seed=3).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    shares = variance_shares(splats, Multiplier.dropout(0.5), torch.ones(12, 16), background=scene.colors[0])
    assert shares.tolist() == [0.0]


def test_weights_of_another_size_are_refused(case):
    scene = random_scene(3, 9, 7, seed=1).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    with pytest.raises(ValueError, match=r"shape \(7, 9\), got \(9, 7\)"):
        variance_shares(splats, Multiplier.dropout(0.5), torch.ones(9, 7))


def test_inference_mode_does_not_keep_the_gradient_away(case):
    """By which the torch engine finds shares, and every engine the sums of blend weights."""
    scene = random_scene(30, 19, 13, seed=12).to(case.dtype)
    found = []
    for inference in (False, True):
        with torch.inference_mode(inference):
            splats = splat(*(x * 1 for x in scene[:4]), scene.camera, colors=scene.colors * 1)
            weights, background = torch.ones(13, 19, dtype=case.dtype), torch.full((3,), 0.3, dtype=case.dtype)
            shares = variance_shares(splats, Multiplier.dropout(0.5), weights, background=background)
            found.append((shares, splat_weights(splats)))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
    assert all(x.any() for x in found[0])
