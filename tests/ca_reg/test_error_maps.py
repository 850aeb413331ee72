import math

import numpy as np
import pytest
import torch

from ca_reg import error_map
from ca_reg.error_maps import FORMS, expected_error
from ca_reg.functional import Multiplier
from ca_reg.lists import ListMoments, PixelLists

SIZE = (9, 11)


def flat(**values: float) -> dict[str, torch.Tensor]:
    return {name: torch.full(SIZE, value) for name, value in values.items()}


def wall(opacity, view):
    """A half that is covered, in a color that steps, and a half that is not."""
    alpha = torch.zeros(SIZE)
    alpha[:, :6] = opacity.mean()
    return torch.stack([alpha * 0.5, alpha * 0.25, alpha]), alpha


def lists_fn(opacity, view):
    """Three Gaussians at every pixel of the left half, two of them at the others."""
    rows, pixels, count = [], [], SIZE[0] * SIZE[1]
    for pixel in range(count):
        listed = [2, 0, 1] if pixel % SIZE[1] < 6 else [0, 1]
        rows += listed
        pixels += [pixel] * len(listed)
    gaussians = torch.tensor(rows)
    colors = torch.tensor([[0.1, 0.9, 0.4], [0.8, 0.2, 0.6], [0.3, 0.3, 0.3]])
    return PixelLists(gaussians, torch.tensor(pixels), opacity[gaussians], colors, *SIZE)


@pytest.mark.parametrize(("form", "given"), [
    (FORMS[0], {"deviation": 0.03, "warp": 0.1, "hidden": 0.0, "colors": 0.2}),
    (FORMS[0], {"deviation": 0.03, "warp": 0.0, "hidden": 1.0, "colors": 0.2}),
    (FORMS[1], {"deviation": 0.03, "colors": 0.2, "empty": 0.1}),
    (FORMS[2], {"deviation": 0.03, "empty": 0.1}),
    (FORMS[3], {"contrast": 0.03, "empty": 0.1}),
])  # fmt: skip
def test_constant_features_give_the_weighted_sum_whatever_the_blur(form, given):
    """The most demanding form is taken: of the last case's features, the others also have what the later ones need."""
    values = {**given, "empty": given.get("empty", 0.1), "constant": 1.0}
    values["hidden*colors"] = values.get("hidden", 0.0) * values.get("colors", 0.0)
    expected = sum(weight * values[term] for term, weight in form.weights.items())
    found = expected_error(flat(**given, **({} if "empty" in given else {"empty": 0.1})))
    torch.testing.assert_close(found.error, torch.full(SIZE, expected))
    assert found.psnr == pytest.approx(-10 * math.log10(form.peaked * expected**2), abs=1e-4)
    assert found.interval == pytest.approx((found.psnr - 1.2816 * form.spread, found.psnr + 1.2816 * form.spread))


def test_the_unit_scales_the_error_and_shifts_the_psnr():
    features = {"empty": torch.rand(SIZE), "contrast": torch.rand(SIZE)}
    one, three = expected_error(features), expected_error(features, unit=3.0)
    torch.testing.assert_close(three.error, 3 * one.error)
    assert three.psnr == pytest.approx(one.psnr - 20 * math.log10(3), abs=1e-4)


def test_the_psnr_counts_the_mask():
    features = {"empty": torch.zeros(SIZE), "contrast": torch.zeros(SIZE)}
    features["empty"][:, 8:] = 1
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[:, :3] = True  # far from the blurred step
    constant, peaked = FORMS[3].weights["constant"], FORMS[3].peaked
    assert expected_error(features, mask).psnr == pytest.approx(-10 * math.log10(peaked * constant**2), abs=1e-3)
    assert expected_error(features).psnr < expected_error(features, mask).psnr
    assert math.isnan(expected_error(features, torch.zeros(SIZE, dtype=torch.bool)).psnr)


def test_what_is_not_covered_is_expected_to_be_wrong():
    error = error_map(wall, torch.tensor([0.9]), None).error
    assert error[4, 9] > error[4, 2]


def test_moments_go_with_a_renderer_of_another_layout():
    """Those of lists, others in this package's layout, and some in the renderer's own."""
    opacity, lists = torch.tensor([0.9, 0.4, 0.6]), ListMoments(lists_fn)
    image, alpha = wall(opacity, None)

    def turned(*given):
        return {name: x.permute(1, 2, 0) for name, x in lists(*given)._asdict().items() if name != "alpha_mean"}

    for moments in (lists, lambda *given: lists(*given), turned):
        straight = lists if moments is turned else moments
        expected = error_map(wall, opacity, None, moments_fn=(lambda *x: lists(*x)) if moments is turned else straight)
        found = error_map(lambda *_: (image.permute(1, 2, 0), alpha), opacity, None, moments_fn=moments, layout="HWC")
        assert torch.equal(found.error, expected.error)


def test_a_color_divided_by_an_alpha_of_0_is_none():
    def divided(opacity, view):
        image, alpha = wall(opacity, view)
        return image / alpha, alpha

    def filled(opacity, view):
        image, alpha = divided(opacity, view)
        return image.nan_to_num(0.0), alpha

    opacity = torch.tensor([0.9])
    assert torch.equal(error_map(divided, opacity, None).error, error_map(filled, opacity, None).error)


@pytest.mark.parametrize(("rendered", "message"), [
    ((torch.rand(3, *SIZE) * 255, torch.ones(SIZE)), "divide by 255"),
    ((torch.rand(3, *SIZE), torch.full(SIZE, 30.0)), "depth map"),
    ((torch.full((3, *SIZE), torch.nan), torch.ones(SIZE)), "nan"),
])  # fmt: skip
def test_what_no_score_would_take_is_refused(rendered, message):
    with pytest.raises(ValueError, match=message):
        error_map(lambda opacity, view: rendered, torch.ones(2), None)


def test_a_map_of_opacities_in_training_can_be_shown():
    error = error_map(wall, torch.full((4,), 0.9, requires_grad=True), None).error
    assert error.numpy().shape == SIZE


def test_moments_and_lists_are_asked_where_they_are_offered():
    moments, asked = ListMoments(lists_fn), []

    def render_fn(opacity, view):
        asked.append(opacity)
        mean = moments(opacity, view, Multiplier(1.0, 0.0), None)
        return mean.mean, mean.alpha_mean

    opacity = torch.tensor([0.5, 0.6, 0.7])
    with_lists = error_map(render_fn, opacity, None, moments_fn=moments, p=0.2)
    torch.testing.assert_close(asked[0], 0.8 * opacity)
    only_moments = error_map(render_fn, opacity, None, moments_fn=lambda *given: moments(*given), p=0.2)
    # In numpy, far from the step: left, Gaussians 2, 0, 1 in this order.
    alphas, colors = np.array([0.7, 0.5, 0.6]), np.array([[0.3, 0.3, 0.3], [0.1, 0.9, 0.4], [0.8, 0.2, 0.6]])
    deviation = _deviation_by_enumeration(alphas, colors, 0.2)
    weights = 0.8 * alphas * np.cumprod([1, *(1 - 0.8 * alphas[:-1])])
    share = weights / weights.sum()
    spread = math.sqrt((share[:, None] * (colors - share @ colors) ** 2).sum(0).mean())
    values = {"constant": 1.0, "deviation": deviation, "colors": spread, "empty": 1 - weights.sum()}
    for form, found in ((FORMS[1], with_lists), (FORMS[2], only_moments)):
        expected = sum(weight * values[term] for term, weight in form.weights.items())
        assert found.error[4, 1].item() == pytest.approx(expected, rel=1e-4)


def _deviation_by_enumeration(alphas, colors, rate):
    """Over all masks, root of the variance's mean over RGB."""
    mean, square = np.zeros(3), np.zeros(3)
    for mask in range(2 ** len(alphas)):
        keep = np.array([mask >> i & 1 for i in range(len(alphas))])
        a = alphas * keep
        pixel = (a * np.cumprod([1, *(1 - a[:-1])])) @ colors
        probability = np.prod(np.where(keep, 1 - rate, rate))
        mean, square = mean + probability * pixel, square + probability * pixel**2
    return math.sqrt((square - mean**2).mean())


def test_the_colors_of_lists_are_those_of_a_loop(generator):
    opacity = torch.rand(3, generator=generator)
    lists = lists_fn(opacity, None)
    found = ListMoments(lists_fn).color_variance(opacity, None)
    for pixel in (0, 5, 6, 98):
        listed = lists.gaussians[lists.pixels == pixel].tolist()
        passed, weights = 1.0, []
        for i in listed:
            weights.append(passed * opacity[i].item())
            passed *= 1 - opacity[i].item()
        share = np.array(weights) / sum(weights)
        colors = lists.colors[listed].numpy()
        expected = (share[:, None] * (colors - share @ colors) ** 2).sum(0).mean()
        assert found[divmod(pixel, SIZE[1])].item() == pytest.approx(expected, rel=1e-5)


def test_a_small_picture_is_smoothed_as_well():
    assert expected_error({"empty": torch.rand(2, 3), "contrast": torch.rand(2, 3)}).error.isfinite().all()


def test_errors_say_what_is_missing():
    with pytest.raises(ValueError, match="empty, got deviation"):
        expected_error(flat(deviation=0.1))
    with pytest.raises(ValueError, match="share one shape"):
        expected_error({"empty": torch.zeros(3, 4), "contrast": torch.zeros(4, 4)})
    for mask in (torch.ones(SIZE, dtype=torch.int64), torch.ones(SIZE[0], dtype=torch.bool)):  # both index rows
        with pytest.raises(ValueError, match="mask must be"):
            expected_error(flat(empty=0.1, contrast=0.1), mask)
    with pytest.raises(TypeError, match=r"empty .*torch tensor"):
        expected_error({"empty": 0.5, "contrast": torch.zeros(4, 4)})
    with pytest.raises(ValueError, match="alpha"):
        error_map(lambda opacity, view: torch.zeros(3, 4, 4), torch.ones(2), None)
    with pytest.raises(ValueError, match=r"\bp .*\[0, 1\)"):
        error_map(wall, torch.ones(2), None, p=1.0)
    with pytest.raises(ValueError, match=r"opacity .*torch\.sigmoid"):
        error_map(wall, torch.tensor([-2.0, 3.0]), None)
