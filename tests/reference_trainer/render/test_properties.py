"""The loops against the torch engine in float64, over random scenes of any kind."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import GaussianScene, random_scene

from ca_reg.functional import Multiplier
from reference_trainer.render import rasterize, render_moments, splat, use_engine, variance_shares
from reference_trainer.render.constants import MIN_ALPHA, MIN_TRANSMITTANCE

pytest.importorskip("numba")
PIXEL, GRADIENT = 2e-4, 2e-3


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """Whatever engine was chosen before."""
    monkeypatch.setenv("CA_REG_ENGINE", "auto")


@st.composite
def scenes(draw_):
    """Small scenes, from an empty one to needles, from one pixel to a few tiles, opacities from nothing to above 1."""
    n, width, height = (draw_(st.integers(low, high)) for low, high in ((0, 30), (1, 35), (1, 27)))
    size = math.exp(draw_(st.floats(-7.0, 0.5)))
    scene = random_scene(n, width, height, draw_(st.integers(0, 10**6)), size=size)
    stretch = torch.tensor([1.0, draw_(st.sampled_from([1.0, 1e-3, 30.0])), 1.0], dtype=torch.float64)
    opacities = scene.opacities * draw_(st.sampled_from([1.0, 0.1, 1.3]))
    scene = scene._replace(scales=scene.scales * stretch, opacities=opacities)
    return GaussianScene(*(x.float().double() for x in scene[:5]), scene.camera.to(dtype=torch.float32))


def decided(splats):
    """The pixels where rounding decides nothing: no alpha at the 1/255 cut, no end of the light; and all alphas."""
    height, width = splats.lists.height, splats.lists.width
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    order = torch.argsort(splats.projection.depths)
    means, factors = splats.projection.means[order], splats.projection.factors[order]
    dx, dy = x[..., None] - means[:, 0], y[..., None] - means[:, 1]
    l11, l21, l22 = factors.unbind(1)
    raw = splats.opacities[order] * torch.exp(-0.5 * ((l11 * dx + l21 * dy) ** 2 + (l22 * dy) ** 2))
    alpha = torch.where(raw >= MIN_ALPHA, raw.clamp(max=0.99), 0.0)
    light = (1 - alpha).cumprod(-1)
    at_cut = (raw / MIN_ALPHA - 1).abs() < 5e-3
    at_end = ((light / MIN_TRANSMITTANCE - 1).abs() < 0.02).any(-1)
    # How far off a pixel may be where it does: a splat at the cut is worth 1/255, one at the end up to 0.99 x 0.01.
    return ~(at_cut.any(-1) | at_end).detach(), at_cut.sum(-1).detach() / 255 + 0.01 * at_end.detach()


def results(scene, engine, dtype, weights, mask, random):
    """Images, gradients of a weighted sum over some pixels, and shares."""
    use_engine(engine)
    s, g = scene.to(dtype), torch.Generator().manual_seed(0)
    n, shape = len(scene.opacities), (3, scene.camera.height, scene.camera.width)
    extra = [torch.rand(n, generator=g, dtype=torch.float64) for _ in range(2)]
    behind = torch.rand(shape, generator=g, dtype=torch.float64)
    leaves = [x.float().to(dtype).requires_grad_() for x in (*s.tensors(), *extra, behind)]
    splats = splat(*leaves[:4], s.camera, colors=leaves[4])
    if random:
        out = render_moments(splats, Multiplier(leaves[5], leaves[6]), background=leaves[7])
        images = torch.cat([out.mean, out.variance, out.alpha_mean[None]])
    else:
        out = rasterize(splats, background=torch.tensor([0.2, 0.9, 0.5]), depth=True)
        images = torch.cat([out.image, out.alpha[None], out.depth[None]])
    if mask is None:
        mask, _ = decided(splats)
    if images.requires_grad:
        (images * (weights[: len(images)] * mask).to(dtype)).sum().backward()
    shares = variance_shares(splats, Multiplier.dropout(0.5), mask.to(dtype))
    return splats, images.detach().double(), [x.grad for x in leaves], shares, mask


def agree(random, scene):
    """Assert that the loops are the torch engine: images, gradients and shares."""
    shape = (8, scene.camera.height, scene.camera.width)
    weights = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    splats, exact, gradients, shares, mask = results(scene, "torch", torch.float64, weights, None, random)
    ours, image, mine, parts, _ = results(scene, "numba", torch.float32, weights, mask, random)
    assert (splats.engine.name, ours.engine.name) == ("torch", "numba")
    assert torch.equal(splats.indices, ours.indices)
    assert torch.isfinite(image).all()
    error = (image - exact).abs() / exact.abs().clamp(min=1.0)
    assert (error[:, mask] <= PIXEL).all()
    _, doubt = decided(splats)
    assert (error <= PIXEL + 3.5 * doubt).all()  # colors of up to 1, depths of up to 3.5
    scale = max((float(x.norm()) for x in gradients if x is not None), default=0.0)
    for one, other in zip(mine, gradients, strict=True):
        assert (one is None) == (other is None)
        if other is not None:
            assert torch.isfinite(one).all()
            assert (one.double() - other).norm() <= GRADIENT * other.norm() + 1e-6 * scale
    assert (parts - shares).norm() <= GRADIENT * shares.norm() + 1e-9


@pytest.mark.parametrize("random", [False, True], ids=["rendered", "moments"])
@settings(max_examples=12, deadline=None, derandomize=True)
@given(scene=scenes())
def test_the_loops_are_the_torch_engine(random, scene):
    agree(random, scene)


@pytest.mark.slow
@pytest.mark.parametrize("random", [False, True], ids=["rendered", "moments"])
@settings(max_examples=300, deadline=None, derandomize=True)
@given(scene=scenes())
def test_the_loops_are_the_torch_engine_in_many_scenes(random, scene):
    agree(random, scene)
