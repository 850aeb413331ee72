import numpy as np
import pytest

from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.scale import Scale


@pytest.mark.parametrize("limit", [0.0, 0.5, 1e6])
def test_it_is_the_mean_squared_excess_of_the_longest_axis(six, take_step, limit):
    scales = np.exp(six.log_scales.numpy())
    expected = 0.3 * np.mean([max(max(row) - limit, 0) ** 2 for row in scales])
    assert Scale(0.3, limit)(take_step()).item() == pytest.approx(expected, rel=1e-12)


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(Scale(0.3, 0.5), "log_scales")


def test_arguments():
    for text, message in (("scale(-1.0)", "weight must"), ("scale(1.0, -0.5)", "limit must be finite and at least 0")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
