"""The first-order map against renders of every Gaussian alone by the brute-force renderer."""

import pytest
import torch
from oracles import brute_force, random_scene

from ca_reg.functional import Multiplier, first_order_variance
from reference_trainer.evaluation.metrics import first_order_map
from reference_trainer.render import splat


def alone(scene):
    """Alpha (n, H, W) of every Gaussian, from renders in which it is the only one."""
    n = len(scene.opacities)
    return torch.stack(
        [brute_force(*(x[i : i + 1] for x in scene[:4]), torch.ones(1, 1).double(), scene.camera)[1] for i in range(n)]
    )


def each(n):
    g = torch.Generator().manual_seed(5)
    return Multiplier(*torch.rand(2, n, generator=g, dtype=torch.float64))


@pytest.mark.parametrize("multiplier", [Multiplier.dropout(0.3), each(40)], ids=["p", "each"])
def test_it_is_the_sum_of_squares_over_the_gaussians_seen_alone(multiplier):
    scene = random_scene(40, 29, 21, seed=3, size=0.2)
    scene.opacities[-1] = 1.0
    scene.scales[-1] = 0.5
    alphas = alone(scene)
    assert alphas.max() > 0.9899  # the clamp takes part
    found = first_order_map(splat(*scene[:4], scene.camera, colors=scene.colors), multiplier)
    spread = torch.as_tensor(multiplier.variance, dtype=torch.float64).expand(40)
    expected = torch.einsum("n,nc,nhw->chw", spread, scene.colors**2, alphas**2)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)
    of_pixels = scene.colors.expand(21, 29, 40, 3)  # the formula has no order: any will do
    canonical = first_order_variance(alphas.permute(1, 2, 0), of_pixels, Multiplier(1.0, spread))
    torch.testing.assert_close(found, canonical.permute(2, 0, 1), rtol=0, atol=1e-13)


def test_the_lists_of_every_engine_will_do(case):
    scene = random_scene(120, 32, 24, seed=4)
    single = scene.to(case.dtype)
    one, other = (first_order_map(splat(*s[:4], s.camera, colors=s.colors), each(120)) for s in (scene, single))
    assert other.dtype == case.dtype
    # A splat within rounding of the 1/255 cut may fall on the other side of it, which changes a pixel by 1.5e-5.
    torch.testing.assert_close(other.double(), one, rtol=1e-4, atol=2e-5)


def test_nothing_in_view_has_no_variance():
    scene = random_scene(5, 9, 7, seed=0)
    splats = splat(scene.means - 10 * scene.camera.forward, *scene[1:4], scene.camera, colors=scene.colors)
    assert torch.equal(first_order_map(splats, each(5)), torch.zeros(3, 7, 9, dtype=torch.float64))
