"""DNGaussian's patch-normalized depth against loops over the patches in numpy."""

import dataclasses

import numpy as np
import pytest
import torch

from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.patch_depth import PatchDepth, patch_error


def literal(depth, prior, side, tolerance, overall):
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
    assert found.item() == pytest.approx(literal(depth.numpy(), prior.numpy(), side, tolerance, overall), rel=1e-10)


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


def test_gradients(assert_gradients_of_differences):
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
    for which in ("plain", "soft"):  # nothing is drawn: the depth is 0 everywhere
        assert PatchDepth(which=which)(take_step(opacity_logits=faint)).isfinite()


def test_arguments():
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
