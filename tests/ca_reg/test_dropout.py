"""Dropout and its test-time scaling, against the enumeration of all masks."""

import itertools

import pytest
import torch

from ca_reg.functional import apply_dropout, draw_keep_mask, gaussian_dropout, scale_opacity

OPACITY = torch.tensor([0.1, 0.4, 0.7, 1.0, 0.25, 0.0], dtype=torch.float64)


def mean_over_masks(p, compensate):
    mean = torch.zeros_like(OPACITY)
    for bits in itertools.product([False, True], repeat=len(OPACITY)):
        keep = torch.tensor(bits)
        kept = int(keep.sum())
        probability = (1 - p) ** kept * p ** (len(OPACITY) - kept)
        mean += probability * apply_dropout(OPACITY, keep, p=p, compensate=compensate)
    return mean


@pytest.mark.parametrize("p", [0.0, 0.2, 0.5, 0.9])
def test_scaling_is_the_mean_over_all_masks(p):
    torch.testing.assert_close(mean_over_masks(p, False), scale_opacity(OPACITY, p), rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("p", [0.0, 0.2, 0.5, 0.9])
def test_compensated_dropout_keeps_the_mean(p):
    torch.testing.assert_close(mean_over_masks(p, True), OPACITY, rtol=1e-13, atol=1e-16)


def test_survivors_of_compensated_dropout_may_exceed_one():
    assert apply_dropout(torch.tensor([1.0]), torch.tensor([True]), p=0.5, compensate=True).item() == 2.0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_rates_of_their_own_are_not_rounded_to_16_bits(dtype):
    """There the last three are 1, or 1 - p has one digit."""
    rates = torch.tensor([0.2, 0.7, 0.9985, 0.9999, 1 - 1e-6, 1 - 1e-7])
    opacity, keep = torch.full((6, 1), 0.5, dtype=dtype), torch.tensor([True] * 4 + [False] * 2)
    shares = (1 - rates.double())[:, None]
    torch.testing.assert_close(scale_opacity(opacity, rates), (0.5 * shares).to(dtype))
    raised = torch.where(keep[:, None], 0.5 / shares, 0).to(dtype)
    torch.testing.assert_close(apply_dropout(opacity, keep, p=rates, compensate=True), raised)


@pytest.mark.parametrize("p", [0.05, 0.2, 0.6])
def test_masks_keep_the_stated_fraction_independently(p):
    n = 200_000
    keep = draw_keep_mask(n, p, generator=torch.Generator().manual_seed(1)).double()
    # Means of n Bernoulli and of n/2 products of neighbors; 5 standard deviations each: false alarm 6e-7 a comparison.
    assert abs(keep.mean().item() - (1 - p)) < 5 * (p * (1 - p) / n) ** 0.5
    centered = keep - (1 - p)
    assert abs((centered[::2] * centered[1::2]).mean().item()) < 5 * p * (1 - p) / (n / 2) ** 0.5


def test_masks_do_not_depend_on_the_dtype_of_the_opacities():
    keeps = []
    for dtype in (torch.float16, torch.float32, torch.float64):
        dropped, keep = gaussian_dropout(OPACITY.to(dtype), 0.5, generator=torch.Generator().manual_seed(3))
        assert dropped.dtype == dtype
        keeps.append(keep)
    assert torch.equal(keeps[0], keeps[1])
    assert torch.equal(keeps[1], keeps[2])


def test_a_generator_leaves_the_global_state_alone():
    before = torch.get_rng_state()
    gaussian_dropout(OPACITY, 0.5, generator=torch.Generator().manual_seed(0))
    assert torch.equal(torch.get_rng_state(), before)


def test_rate_zero_returns_the_same_object_and_draws_nothing():
    before = torch.get_rng_state()
    out, keep = gaussian_dropout(OPACITY, 0.0)
    assert out is OPACITY
    assert keep is None
    assert scale_opacity(OPACITY, 0.0) is OPACITY
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("compensate", [False, True])
def test_dropped_opacities_get_exactly_no_gradient_and_the_argument_stays(compensate):
    opacity = OPACITY.clone().requires_grad_()
    keep = torch.tensor([True, False, True, False, True, False])
    out = apply_dropout(opacity, keep, p=0.2, compensate=compensate)
    # Infinite upstream gradients at dropped splats are the hard case: 0 * inf would be nan.
    out.backward(torch.where(keep, 1.0, torch.inf).double())
    assert torch.equal(opacity.grad, keep.double() * (1 / 0.8 if compensate else 1.0))
    assert torch.equal(opacity.detach(), OPACITY)


def test_a_column_of_opacities_behaves_like_a_vector():
    keep = draw_keep_mask(len(OPACITY), 0.5, generator=torch.Generator().manual_seed(2))
    column = apply_dropout(OPACITY[:, None], keep)
    assert column.shape == (len(OPACITY), 1)
    assert torch.equal(column[:, 0], apply_dropout(OPACITY, keep))
    _, drawn = gaussian_dropout(OPACITY[:, None], 0.5)
    assert drawn.shape == (len(OPACITY),)


def test_no_gaussians_are_no_error():
    out, keep = gaussian_dropout(torch.empty(0), 0.5)
    assert out.shape == keep.shape == (0,)


@pytest.mark.parametrize("p", [-0.1, 1.0, float("nan"), float("inf")])
def test_rates_outside_the_range_are_refused(p):
    for call in (lambda: gaussian_dropout(OPACITY, p), lambda: scale_opacity(OPACITY, p), lambda: draw_keep_mask(3, p)):
        with pytest.raises(ValueError, match="p must be"):
            call()


@pytest.mark.parametrize(
    ("opacity", "error", "message"),
    [
        (torch.rand(3, 2), ValueError, "shape"),
        (torch.rand(3, 1, 1), ValueError, "shape"),
        (torch.tensor(0.5), ValueError, "shape"),
        (torch.ones(3, dtype=torch.int64), TypeError, "floating-point"),
        ([0.5, 0.5], TypeError, "tensor"),
    ],
)
def test_what_is_not_an_opacity_is_refused(opacity, error, message):
    for call in (gaussian_dropout, scale_opacity):
        with pytest.raises(error, match=message):
            call(opacity, 0.2)


def test_masks_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"keep .*shape \(6,\)"):
        apply_dropout(OPACITY, torch.ones(5, dtype=torch.bool))
    with pytest.raises(TypeError, match="bool"):
        apply_dropout(OPACITY, torch.ones(6))
