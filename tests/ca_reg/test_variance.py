"""The color variance, against numpy's weighted moments in float64."""

import numpy as np
import pytest
import torch

from ca_reg import Reason
from ca_reg.functional import color_variance


def test_agrees_with_the_papers_formula_in_float64():
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(5, 7, 9, generator=generator, dtype=torch.float64)
    weights[torch.rand(5, 7, 9, generator=generator) < 0.3] = 0
    weights[2, 3] = 0
    colors = torch.rand(5, 7, 9, 3, generator=generator, dtype=torch.float64)
    result = color_variance(weights, colors)

    w, c = weights.numpy(), colors.numpy()
    expected, covered = np.zeros((5, 7)), w.sum(-1) > 0
    for i, j in np.argwhere(covered):
        mean = np.average(c[i, j], axis=0, weights=w[i, j])
        square = np.average(c[i, j] ** 2, axis=0, weights=w[i, j])
        expected[i, j] = (square - mean**2).mean()
    np.testing.assert_allclose(result.variance.numpy(), expected, rtol=1e-10, atol=1e-15)
    np.testing.assert_array_equal(result.covered.numpy(), covered)
    np.testing.assert_allclose(result.value.item(), expected[covered].mean(), rtol=1e-10)
    assert result.reason is Reason.OK


def test_padding_and_order_do_not_matter():
    weights, colors = torch.rand(4, 6, dtype=torch.float64), torch.rand(4, 6, 3, dtype=torch.float64)
    padded = torch.cat([weights, torch.zeros(4, 3)], 1), torch.cat([colors, torch.rand(4, 3, 3)], 1)
    order = torch.randperm(6)
    value = color_variance(weights, colors).value
    torch.testing.assert_close(color_variance(*padded).value, value)
    torch.testing.assert_close(color_variance(weights[:, order], colors[:, order]).value, value)


def test_equal_colors_have_no_variance_even_in_float32():
    # E[c^2] - E[c]^2 gives up to 1e-7 here, of either sign.
    result = color_variance(torch.rand(100, 20), torch.full((100, 20, 3), 0.9))
    assert result.variance.min() >= 0
    assert result.variance.max() < 1e-13


def test_without_coverage_the_reason_says_so():
    result = color_variance(torch.zeros(4, 5), torch.rand(4, 5, 3))
    assert result.reason is Reason.EMPTY
    assert result.value.isnan()
    assert (result.variance == 0).all()


def test_is_differentiable():
    weights = torch.rand(2, 4, dtype=torch.float64).requires_grad_()
    colors = torch.rand(2, 4, 3, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda w, c: color_variance(w, c).value, (weights, colors))


def test_uncovered_pixels_leave_the_gradient_finite():
    weights = torch.zeros(2, 4).index_fill_(0, torch.tensor([0]), 0.2).requires_grad_()
    color_variance(weights, torch.rand(2, 4, 3)).value.backward()
    assert weights.grad.isfinite().all()


@pytest.mark.parametrize(
    ("weights", "colors", "message"),
    [
        (torch.rand(4, 5), torch.rand(4, 6, 3), "shape of weights"),
        (torch.rand(4, 5), torch.rand(4, 5, 4), "RGB last"),
        (-torch.rand(4, 5), torch.rand(4, 5, 3), "at least 0"),
        (torch.full((4, 5), torch.nan), torch.rand(4, 5, 3), "at least 0"),
    ],
)
def test_wrong_arguments_are_refused(weights, colors, message):
    with pytest.raises(ValueError, match=message):
        color_variance(weights, colors)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused_in_the_padding_too(bad):
    weights, colors = torch.full((4, 3), 0.2), torch.full((4, 3, 3), 0.5)
    weights[2, 1] = 0.0
    colors[2, 1, 0] = bad
    with pytest.raises(ValueError, match=r"colors .*finite"):
        color_variance(weights, colors)
    weights[2, 1] = bad
    with pytest.raises(ValueError, match=r"weights .*finite"):
        color_variance(weights, torch.full((4, 3, 3), 0.5))
