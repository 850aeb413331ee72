"""FSGS's depth correlation against numpy's."""

import dataclasses

import numpy as np
import pytest
import torch

from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.pearson import Pearson


def literal(prior, depth, offset):
    """One minus the larger of the correlations with both readings of the prior."""
    readings = [prior] if offset is None else [prior, 1 / (offset - prior)]
    return min(1 - np.corrcoef(reading.ravel(), depth.ravel())[0, 1] for reading in readings)


@pytest.mark.parametrize("offset", [None, 1.001, 1.1, 200.0])
def test_it_is_one_minus_the_correlation(take_step, offset):
    step = take_step()
    expected = 0.7 * literal(step.view.depth_prior.numpy(), step.depth.numpy(), offset)
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
    expected = literal(prior.numpy()[known], step.depth.numpy()[known], 200.0)
    assert Pearson(1.0)(step).item() == pytest.approx(expected, rel=1e-10)


def test_a_picture_without_contrast_correlates_with_nothing(take_step):
    step = take_step(opacity_logits=torch.full((6,), -30.0, dtype=torch.float64, requires_grad=True))
    assert Pearson(1.0)(step).item() == 1


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(Pearson(0.7, 1.1), "means", "opacity_logits", "log_scales")


def test_arguments_and_priors(three_views, tiny_scene):
    with pytest.raises(ValueError, match="weight must not be negative, got -1"):
        LOSSES.make("pearson(-1.0)")
    bare = dataclasses.replace(three_views[1], depth_prior=None)
    with pytest.raises(ValueError, match=r"\['b'\] lack.*--depth"):
        Pearson().begin(dataclasses.replace(tiny_scene, train=(three_views[0], bare)))
    metric = dataclasses.replace(bare, depth_prior=torch.tensor([[torch.nan, 750.0]]))
    with pytest.raises(ValueError, match=r"prior of b reaches 750.*got 200.*offset=None"):
        Pearson().begin(dataclasses.replace(tiny_scene, train=(three_views[0], metric)))
    Pearson(offset=None).begin(dataclasses.replace(tiny_scene, train=(three_views[0], metric)))
