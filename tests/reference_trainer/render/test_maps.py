"""Color variance of a rendering against its definition."""

import torch
from oracles import brute_force, random_scene

from reference_trainer.evaluation.metrics import color_variance_map
from reference_trainer.render import splat


def test_color_variance_equals_weighted_sums_of_the_brute_force_renderer(case):
    scene = random_scene(120, 37, 26, seed=6)
    sums, alpha = brute_force(*scene[:4], torch.cat([scene.colors, scene.colors**2], dim=1), scene.camera)
    inside = alpha > 0
    mean, square = sums[:3] / alpha.clamp(min=1e-30), sums[3:] / alpha.clamp(min=1e-30)
    expected = torch.where(inside, (square - mean**2).mean(0), 0.0)  # float64: the cancellation is harmless here
    s = scene.to(case.dtype)
    variance, covered = color_variance_map(splat(*s[:4], s.camera, colors=s.colors))
    assert (covered != inside).double().mean() <= case.crossing
    case.agrees(variance, expected)


def test_colors_that_hardly_differ_are_told_apart():
    """In float32 the squares of 0.9 have roundings of 6e-8, as large as this variance."""
    scene = random_scene(120, 37, 26, seed=6)
    scene = scene._replace(colors=0.9 + 1e-3 * scene.colors)
    sums, alpha = brute_force(*scene[:4], torch.cat([scene.colors, scene.colors**2], dim=1), scene.camera)
    inside = alpha > 0.1
    expected = (sums[3:] / alpha - (sums[:3] / alpha) ** 2).mean(0)[inside]
    s = scene.to(torch.float32)
    variance, _ = color_variance_map(splat(*s[:4], s.camera, colors=s.colors))
    # The colors themselves are rounded by 6e-8, that is 6e-5 of their differences.
    torch.testing.assert_close(variance[inside].double().mean(), expected.mean(), rtol=2e-3, atol=0.0)


def test_nothing_in_view_has_no_color_variance():
    scene = random_scene(5, 9, 7, seed=0)
    variance, covered = color_variance_map(
        splat(scene.means - 10 * scene.camera.forward, *scene[1:4], scene.camera, colors=scene.colors)
    )
    assert not covered.any()
    assert not variance.any()
