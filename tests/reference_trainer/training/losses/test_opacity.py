import numpy as np
import pytest
import torch

from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.opacity import Opacity


def test_it_is_the_mean(six, take_step):
    assert Opacity(0.3)(take_step()).item() == pytest.approx(0.3 * six.opacities.numpy().mean(), rel=1e-12)


def test_with_a_split_it_is_the_formula_of_dngaussian(six, take_step):
    o = six.opacities.numpy()
    expected = 1 - np.mean(o[o > 0.4] ** 2) + np.mean((1 - o[o < 0.4]) ** 2)
    assert Opacity(0.3, 0.4)(take_step()).item() == pytest.approx(0.3 * expected, rel=1e-12)


@pytest.mark.parametrize(("logit", "expected"), [(3.0, 1 - 0.9525741268**2), (-3.0, 1 + 0.9525741268**2)])
def test_an_empty_part_counts_nothing(take_step, logit, expected):
    step = take_step(opacity_logits=torch.full((6,), logit, dtype=torch.float64))
    assert Opacity(1.0, 0.2)(step).item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("split", [None, 0.4])
def test_gradients(assert_gradients_of_differences, split):
    assert_gradients_of_differences(Opacity(0.3, split), "opacity_logits")


def test_arguments():
    for text, message in (("opacity(-1.0)", "weight must"), ("opacity(1.0, 1.0)", r"split must be in \(0, 1\)")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
