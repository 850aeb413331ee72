import numpy as np
import pytest
import torch

from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.smooth_depth import SmoothDepth


def literal(inverse, image):
    total = 0.0
    for axis in (0, 1):
        weights = np.exp(-np.abs(np.diff(image, axis=axis + 1)).mean(0))
        total += np.mean(np.abs(np.diff(inverse, axis=axis)) * weights)
    return total


def test_it_is_the_formula(take_step):
    step = take_step()
    alpha, depth = step.rendering.alpha.numpy(), step.depth.numpy()
    inverse = np.divide(alpha, depth, out=np.zeros_like(depth), where=depth > 0)
    expected = 0.3 * literal(inverse / inverse.mean(), step.view.image.numpy())
    assert SmoothDepth(0.3)(step).item() == pytest.approx(expected, rel=1e-9)


def test_nothing_drawn_is_no_error(take_step):
    step = take_step(opacity_logits=torch.full((6,), -30.0, dtype=torch.float64, requires_grad=True))
    assert SmoothDepth()(step).item() == 0


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(SmoothDepth(0.3), "means", "opacity_logits", "log_scales")


def test_arguments():
    with pytest.raises(ValueError, match="weight must"):
        LOSSES.make("smooth_depth(-1.0)")
