import numpy as np
import pytest

from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.flat import Flat


@pytest.mark.parametrize("limit", [1.0, 4.0, 1e6])
def test_it_is_the_mean_excess_of_the_ratio(six, take_step, limit):
    scales = np.exp(six.log_scales.numpy())
    expected = 0.3 * np.mean([max(max(row) / min(row) - limit, 0) for row in scales])
    assert Flat(0.3, limit)(take_step()).item() == pytest.approx(expected, rel=1e-12)


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(Flat(0.3, 2.0), "log_scales")


def test_arguments():
    for text, message in (("flat(-1.0)", "weight must"), ("flat(1.0, 0.5)", "limit must be finite and at least 1")):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
