"""Terms of the depth against numpy."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.scene import PointCloud, Scene
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.depth import (
    PatchDepth,
    Pearson,
    SmoothDepth,
    Warp,
    edge_aware_smoothness,
    patch_error,
    warp_horizontally,
)


def literal_pearson(prior, depth, offset):
    """One minus the larger of the correlations with both readings of the prior."""
    readings = [prior] if offset is None else [prior, 1 / (offset - prior)]
    return min(1 - np.corrcoef(reading.ravel(), depth.ravel())[0, 1] for reading in readings)


@pytest.mark.parametrize("offset", [None, 1.001, 1.1, 200.0])
def test_it_is_one_minus_the_correlation(take_step, offset):
    step = take_step()
    expected = 0.7 * literal_pearson(step.view.depth_prior.numpy(), step.depth.numpy(), offset)
    assert Pearson(0.7, offset)(step).item() == pytest.approx(expected, rel=1e-10)


def test_either_reading_may_be_the_better_one(take_step):
    step = take_step()
    depth = step.depth / step.depth.max()
    for prior, best in ((depth, 0), (1.5 - 1 / (depth + 1), 1)):  # the second is 1 / (1.5 - prior) = depth + 1
        step.view = dataclasses.replace(step.view, depth_prior=prior)
        both, first = (Pearson(1.0, offset)(step).item() for offset in (1.5, None))
        assert both == pytest.approx(0, abs=1e-12)
        assert (first > 1e-4) == bool(best)


def test_unknown_pixels_are_left_out(take_step):
    step = take_step()
    prior = step.view.depth_prior.clone()
    prior[:, ::3] = torch.nan
    step.view = dataclasses.replace(step.view, depth_prior=prior)
    known = prior.isfinite().numpy()
    expected = literal_pearson(prior.numpy()[known], step.depth.numpy()[known], 200.0)
    assert Pearson(1.0)(step).item() == pytest.approx(expected, rel=1e-10)


def test_a_picture_without_contrast_correlates_with_nothing(take_step):
    step = take_step(opacity_logits=torch.full((6,), -30.0, dtype=torch.float64, requires_grad=True))
    assert Pearson(1.0)(step).item() == 1


def test_gradients_of_pearson(assert_gradients_of_differences):
    assert_gradients_of_differences(Pearson(0.7, 1.1), "means", "opacity_logits", "log_scales")


def test_arguments_and_priors(three_views, tiny_scene):
    with pytest.raises(ValueError, match=r"weight .*negative, got -1"):
        LOSSES.make("pearson(-1.0)")
    bare = dataclasses.replace(three_views[1], depth_prior=None)
    with pytest.raises(ValueError, match=r"\['b'\] lack.*--depth"):
        Pearson().begin(dataclasses.replace(tiny_scene, train=(three_views[0], bare)))
    metric = dataclasses.replace(bare, depth_prior=torch.tensor([[torch.nan, 750.0]]))
    with pytest.raises(ValueError, match=r"b reaches 750.*200.*offset=None"):
        Pearson().begin(dataclasses.replace(tiny_scene, train=(three_views[0], metric)))
    Pearson(offset=None).begin(dataclasses.replace(tiny_scene, train=(three_views[0], metric)))


def literal_patch(depth, prior, side, tolerance, overall):
    """The formula of the source for one part."""
    normalized = []
    for picture in (depth, prior):
        rows, columns = (size // side for size in picture.shape)
        corners = [(side * i, side * j) for i in range(rows) for j in range(columns)]
        patches = np.stack([picture[top : top + side, left : left + side] for top, left in corners])
        kept = np.stack([prior[top : top + side, left : left + side] for top, left in corners])
        patches = patches[np.isfinite(kept).all((1, 2))]
        whole = patches.std(ddof=1)
        contrast = picture[np.isfinite(prior)].std(ddof=1)
        normalized.append([(x - x.mean()) / ((contrast if overall else x.std(ddof=1)) + 0.01 * whole) for x in patches])
    difference = np.abs(np.array(normalized[0]) - np.array(normalized[1]))
    return np.mean(difference[difference > tolerance] ** 2)


@pytest.mark.parametrize("overall", [False, True])
@pytest.mark.parametrize(("side", "tolerance"), [(2, 0.01), (5, 0.5), (17, 2.5e-4)])
@pytest.mark.parametrize("unknown", [False, True])
def test_it_is_the_formula_patch_by_patch(overall, side, tolerance, unknown):
    g = torch.Generator().manual_seed(side)
    depth, prior = (torch.rand(37, 52, generator=g, dtype=torch.float64) for _ in range(2))
    if unknown:
        prior[3, 4] = prior[20, 50] = torch.nan
    found = patch_error(depth, prior, side, tolerance, overall=overall)
    assert found.item() == pytest.approx(
        literal_patch(depth.numpy(), prior.numpy(), side, tolerance, overall), rel=1e-10
    )


def test_the_local_part_sees_no_scale_and_shift_of_a_patch_and_the_global_part_sees_its_contrast():
    depth = torch.rand(8, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prior = depth.clone()
    prior[:, 8:] = 3 * depth[:, 8:] + 1  # the 0.01 of all patches' deviation in each denominator leaves a few per cent
    assert patch_error(depth, prior, 8, 0.1).item() == 0
    assert patch_error(depth, prior, 8, 0.1, overall=True).item() > 0.1


def test_the_parts_add_up_with_patches_of_sizes_from_the_range(take_step):
    """Of nine pairs of sides 15 draws show three or fewer once in 100,000 seeds."""
    term, seen = PatchDepth(0.5, 0.3, 2.0, smallest=4, largest=6), set()
    for seed in range(15):
        step = take_step(seed=seed)
        near, far = (
            {side: patch_error(step.depth, step.view.depth_prior, side, 2.5e-4, overall=x).item() for side in (4, 5, 6)}
            for x in (False, True)
        )
        values = {(i, j): 0.5 * (0.3 * near[i] + 2 * far[j]) for i in near for j in far}
        value = term(step).item()
        assert value == term(step).item(), "the draw is the step's"
        seen.add(next(sides for sides, x in values.items() if x == pytest.approx(value, rel=1e-12)))
    assert len(seen) > 3


@pytest.mark.parametrize(("which", "learns"), [("hard", "means"), ("soft", "opacity_logits")])
def test_each_pass_renders_as_it_says_and_teaches_one_thing(six, take_step, which, learns):
    leaves = {name: x.clone().requires_grad_() for name, x in six.named() if name != "sh_rest"}
    step = take_step(depth=False, **leaves)
    term = PatchDepth(1.0, smallest=5, largest=5, which=which)
    loss = term(step)
    loss.backward()
    taught = {name for name, x in leaves.items() if x.grad is not None and x.grad.abs().max() > 0}
    assert taught == {learns}
    opacities = torch.full_like(six.opacities, 0.95) if which == "hard" else six.opacities
    depth = render_gaussians(six, step.view.camera, step.background, opacities=opacities, depth=True).depth
    expected = [patch_error(depth, step.view.depth_prior, 5, 2.5e-4, overall=overall) for overall in (False, True)]
    torch.testing.assert_close(loss, 0.1 * expected[0] + expected[1], rtol=1e-9, atol=0)
    assert len(step.observed) == 1, "density control sees the render of the step alone"


def test_gradients_of_patch_depth(assert_gradients_of_differences):
    """Of the local part; through the contrast of the whole picture no gradient goes, see below."""
    assert_gradients_of_differences(PatchDepth(1.0, 0.5, 0.0), "means", "opacity_logits", "log_scales")


def test_the_contrast_of_the_picture_is_a_constant_to_the_global_part():
    g = torch.Generator().manual_seed(0)
    depth, prior = (torch.rand(12, 15, generator=g, dtype=torch.float64) for _ in range(2))
    contrast = depth.std()

    def literal(x):
        pairs = ((x, contrast), (prior, prior.std()))
        one, other = (
            (p - p.mean(1, keepdim=True)) / (spread + 0.01 * p.std())
            for p, spread in (
                (y[:10].reshape(2, 5, 3, 5).transpose(1, 2).reshape(6, 25), spread) for y, spread in pairs
            )
        )
        return (one - other).square().mean()

    leaf = depth.clone().requires_grad_()
    assert torch.autograd.gradcheck(literal, [leaf], fast_mode=True)
    found, expected = (
        torch.autograd.grad(loss, leaf)[0] for loss in (patch_error(leaf, prior, 5, 0.0, overall=True), literal(leaf))
    )
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


def test_nothing_to_compare_is_no_error(take_step):
    blank = torch.full((17, 25), torch.nan, dtype=torch.float64)
    step = take_step()
    step.view = dataclasses.replace(step.view, depth_prior=blank)
    assert PatchDepth()(step).item() == 0
    faint = torch.full((6,), -30.0, dtype=torch.float64, requires_grad=True)
    for which in ("plain", "soft"):  # nothing is rendered: the depth is 0 everywhere
        assert PatchDepth(which=which)(take_step(opacity_logits=faint)).isfinite()


def test_arguments_of_patch_depth():
    for text, message in (
        ("patch_depth(near=-1.0)", "near must be finite and at least 0, got -1.0"),
        ("patch_depth(tolerance=-1.0)", "tolerance must be finite and at least 0, got -1.0"),
        ("patch_depth(smallest=1)", "smallest must be at least 2, got 1"),
        ("patch_depth(smallest=9, largest=8)", "largest must be at least 9, got 8, less than smallest"),
        ("patch_depth(smallest=4.5)", r"'patch_depth\(smallest=4\.5\)': smallest must be an integer, got float"),
        ("patch_depth(largest=17.5)", r"'patch_depth\(largest=17\.5\)': largest must be an integer, got float"),
        ("patch_depth(which='both')", "which must be plain, hard or soft, got 'both'"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)


def literal_smooth_depth(inverse, image):
    total = 0.0
    for axis in (0, 1):
        weights = np.exp(-np.abs(np.diff(image, axis=axis + 1)).mean(0))
        total += np.mean(np.abs(np.diff(inverse, axis=axis)) * weights)
    return total


def test_it_is_the_formula(take_step):
    step = take_step()
    alpha, depth = step.rendering.alpha.numpy(), step.depth.numpy()
    inverse = np.divide(alpha, depth, out=np.zeros_like(depth), where=depth > 0)
    expected = 0.3 * literal_smooth_depth(inverse / inverse.mean(), step.view.image.numpy())
    assert SmoothDepth(0.3)(step).item() == pytest.approx(expected, rel=1e-9)


def test_an_analytic_step_renders_the_depth_of_the_plain_model(take_step):
    step = take_step()
    expected = SmoothDepth(0.3)(step)
    step.rendering = None  # as `Step.expect` leaves it
    torch.testing.assert_close(SmoothDepth(0.3)(step), expected)


def test_nothing_rendered_is_no_error(take_step):
    step = take_step(opacity_logits=torch.full((6,), -30.0, dtype=torch.float64, requires_grad=True))
    assert SmoothDepth()(step).item() == 0


def test_gradients_of_smooth_depth(assert_gradients_of_differences):
    assert_gradients_of_differences(SmoothDepth(0.3), "means", "opacity_logits", "log_scales")


def test_arguments_of_smooth_depth():
    with pytest.raises(ValueError, match="weight must"):
        LOSSES.make("smooth_depth(-1.0)")


def literal_warp(image, disparity):
    """Every row looked up by numpy.interp; zero where a neighbor of the place is outside."""
    height, width = disparity.shape
    columns = np.arange(width)
    warped, inside = np.zeros_like(image), np.zeros((height, width))
    for row in range(height):
        places = columns + disparity[row]
        left = np.floor(places)
        inside[row] = (left >= 0) & (left + 1 < width)
        for channel in range(len(image)):
            warped[channel, row] = np.interp(places, columns, image[channel, row]) * inside[row]
    return warped, inside


def literal_smoothness(disparity, image):
    gray, total = image.sum(0), 0.0
    for axis in (1, 0):
        edges, steps = ((np.roll(x, -1, axis) - np.roll(x, 1, axis))[1:-1, 1:-1] / 2 for x in (gray, disparity))
        total += np.abs(np.exp(-0.33 * np.abs(edges)) * steps).mean()
    return total


def pictures():
    g = torch.Generator().manual_seed(0)
    image = torch.rand(3, 9, 14, generator=g, dtype=torch.float64)
    disparity = 6 * torch.randn(9, 14, generator=g, dtype=torch.float64)
    disparity[4:] = disparity[4:].round()  # on pixels, also on the first and the last of a row
    return image, disparity


def test_warp_and_smoothness_are_the_formulas():
    image, disparity = pictures()
    warped, inside = warp_horizontally(image, disparity)
    expected, mask = literal_warp(image.numpy(), disparity.numpy())
    assert 0.2 < mask.mean() < 0.9
    np.testing.assert_array_equal(inside.numpy(), mask)
    np.testing.assert_allclose((inside * warped).numpy(), expected, atol=1e-12)
    found = edge_aware_smoothness(disparity, image).item()
    assert found == pytest.approx(literal_smoothness(disparity.numpy(), image.numpy()), rel=1e-12)


@pytest.mark.parametrize("hidden", [None, 0.02])
def test_the_term_is_the_formula(six, take_step, hidden):
    step = take_step(seed=3)
    term, camera = Warp(0.7, shift=0.3, smooth=0.2, hidden=hidden), step.view.camera
    places = []
    render = step.render
    step.render = lambda camera, **options: places.append(camera) or render(camera, **options)
    value = term(step).item()
    assert value == term(step).item(), "the shift is the step's"
    shift = (places[0].position - camera.position) @ camera.world_to_camera[0, :3]
    assert 0 < abs(shift) <= 0.3
    assert (places[0].position - camera.position - shift * camera.world_to_camera[0, :3]).abs().max() < 1e-12
    shifted = render_gaussians(six, places[0], step.background, depth=True)
    disparity = (-camera.fx * shift / (step.depth + 1e-5)).numpy()
    warped, inside = literal_warp(shifted.image.numpy(), disparity)
    seen = inside
    if hidden is not None:
        there, depth = literal_warp(shifted.depth.numpy()[None], disparity)[0][0], step.depth.numpy()
        seen = inside * (np.abs(there - depth) < hidden * depth)
        assert 0 < seen.sum() < inside.sum()
    photograph = step.view.image.numpy()
    expected = np.abs(seen * (warped - photograph)).mean() + 0.2 * literal_smoothness(inside * disparity, photograph)
    assert value == pytest.approx(0.7 * expected, rel=1e-9)
    assert len(step.observed) == 1, "density control sees the render of the step alone"


def test_shifts_go_both_ways_up_to_the_largest(take_step):
    """All 40 to one side: once in 10^12 seeds; none beyond 0.8 of the largest: once in 7,500."""
    shifts = []
    for seed in range(40):
        step = take_step(seed=seed)
        rendering, camera = step.rendering, step.view.camera

        def render(moved, rendering=rendering, camera=camera, **_):
            shifts.append(((moved.position - camera.position) @ camera.world_to_camera[0, :3]).item())
            return rendering

        step.render = render
        Warp(shift=0.5)(step)
    assert min(shifts) < 0 < max(shifts)
    assert 0.4 < max(map(abs, shifts)) <= 0.5


def test_the_true_depth_of_a_plane_warps_its_render_onto_the_photograph():
    """An opaque wall of soft spots at z = 2: the error is that of interpolation, and wrong depths err more."""
    g = torch.Generator().manual_seed(0)
    x, y = torch.meshgrid(torch.linspace(-2, 2, 33), torch.linspace(-1, 1, 17), indexing="xy")
    points = torch.stack([x.flatten(), y.flatten(), torch.full((33 * 17,), 2.0)], 1).double()
    colors = torch.rand(len(points), 3, generator=g, dtype=torch.float64)
    wall = Gaussians.from_points(points, colors, torch.full((len(points),), 0.12).double(), sh_degree=0, opacity=0.9)
    wall = dataclasses.replace(wall, log_scales=torch.tensor([0.12, 0.12, 1e-4]).double().log().repeat(len(points), 1))
    camera = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 24.0, 16.0, 48, 32)
    moved = torch.eye(4, dtype=torch.float64)
    moved[0, 3] = -0.2
    black = torch.zeros(3, dtype=torch.float64)
    one, other = (
        render_gaussians(wall, each, black, depth=True)
        for each in (camera, dataclasses.replace(camera, world_to_camera=moved))
    )
    errors = []
    for factor in (1.0, 0.7, 1.4):
        warped, inside = warp_horizontally(other.image, -60 * 0.2 / (factor * one.depth + 1e-5))
        errors.append(((inside * (warped - one.image)).abs().sum() / inside.sum() / 3).item())
    assert errors[0] < 0.01
    assert min(errors[1:]) > 5 * errors[0]


def test_what_a_shifted_camera_does_not_see_is_left_out(take_step):
    """Known pictures of a strip at depth 2 before a wall at depth 4: it is in the way of two columns of the wall."""
    step, columns = take_step(seed=1), torch.arange(25)
    colors = torch.rand(200, generator=torch.Generator().manual_seed(0))

    def seen(moved):
        """The picture and the depth of a camera that a point at depth 1 shows to have moved by so many pixels."""
        strip = (columns + moved / 2 >= 9) & (columns + moved / 2 < 14)
        depth = torch.where(strip, 2.0, 4.0).double()
        texture = colors[(columns + moved / depth).long() + 100 * strip].double()
        return SimpleNamespace(image=texture.expand(3, 17, 25), depth=depth.expand(17, 25))

    def shifted(camera, depth=False):
        assert (camera.position - step.view.camera.position).norm() * camera.fx == pytest.approx(8)
        return seen(8)

    step.view, step.rendering, step.render = dataclasses.replace(step.view, image=seen(0).image), seen(0), shifted
    drawn = 2 * torch.rand((), generator=step.generator("warp")).item() - 1
    errors = [Warp(shift=8 / step.view.camera.fx / drawn, smooth=0.0, hidden=x)(step).item() for x in (None, 0.02)]
    in_the_way = (colors[7:9] - colors[[109, 110]]).abs().sum().item() / 25
    assert errors == pytest.approx([in_the_way, 0], abs=1e-4)


def test_a_relative_shift_counts_in_distances_between_cameras(take_step, three_views):
    """The three cameras stand 0.1 apart."""
    points = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3), "none")
    scene = Scene("three", tuple(three_views), (), points, torch.zeros(3))
    relative, absolute = Warp(shift=0.5, relative=True), Warp(shift=0.05)
    relative.begin(scene)
    assert relative(take_step()).item() == pytest.approx(absolute(take_step()).item(), rel=1e-6)
    for views in (three_views[:1], three_views[:1] * 2):
        relative.begin(dataclasses.replace(scene, train=tuple(views)))
        assert not relative.acts(0)


def test_a_warp_at_every_second_step_costs_nothing_at_the_others():
    (term,) = LOSSES.make("warp(between(1.0, 104), every=2)")
    assert [term.acts(number) for number in range(102, 108)] == [False, False, True, False, True, False]


def test_gradients_of_warp(assert_gradients_of_differences):
    assert_gradients_of_differences(Warp(0.7, smooth=0.2), "means", "opacity_logits", "log_scales", seed=3)


def test_arguments_of_warp():
    for text, message in (
        ("warp(shift=0.0)", "shift must be positive"),
        ("warp(hidden=0.0)", "hidden must be positive"),
        ("warp(every=0)", "every must be at least 1"),
        ("warp(smooth=-1.0)", "smooth must be finite and at least 0, got -1.0"),
        ("warp(-1.0)", "weight must"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
