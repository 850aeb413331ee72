import math

import numpy as np
import pytest

from benchmarks.error_map import Seen, ause, fitted, predict


def by_loop(predicted: np.ndarray, error: np.ndarray) -> float:
    """Remove 0, 1, ... 99 % of the pixels, those of the largest prediction or error first, one list after the other."""
    total, n = 0.0, len(error)
    for percent in range(100):
        removed = percent * n // 100
        for sign, by in ((1, predicted), (-1, error)):
            left = sorted(zip(by, error, strict=True), key=lambda pair: pair[0])[: n - removed]
            total += sign * sum(e for _, e in left) / len(left)
    return total / 100 / float(error.mean())


def test_the_area_is_that_of_a_loop_and_0_for_the_error_itself():
    rng = np.random.default_rng(0)
    error, predicted = rng.exponential(size=300), rng.random(300)
    assert ause(predicted, error) == pytest.approx(by_loop(predicted, error))
    assert ause(error**2, error) == ause(error, error, root=True) == 0
    assert ause(-error, error) > ause(predicted, error) > 0


def test_a_prediction_that_knows_nothing_has_the_expected_area():
    """Half of the pixels are wrong by 1: the oracle's curve is (1/2 - r)+ / (1 - r), times 2; at random it stays 1."""
    error = np.repeat([0.0, 1.0], 50_000)
    steps = np.arange(100) / 100
    expected = np.mean(1 - 2 * np.maximum(0.5 - steps, 0) / (1 - steps))
    assert ause(np.zeros(100_000), error) == pytest.approx(expected, abs=0.01)  # ties at random; sigma is about .003


def test_a_fit_finds_the_weights_and_the_unit_of_planted_errors():
    rng = np.random.default_rng(1)
    truth, views = {"constant": 0.03, "deviation": 0.8, "warp": 0.3}, []
    for unit in (0.5, 1.0, 2.0):
        terms = {"constant": np.ones(8000), "deviation": rng.random(8000) * 0.1, "warp": rng.random(8000) * 0.2}
        mean = unit * sum(weight * terms[name] for name, weight in truth.items())
        own = {name: float(x.mean()) for name, x in terms.items()} | {"difference": 2 * float(mean.mean())}
        error = rng.exponential(mean)
        views.append(Seen(terms, {}, error, 2 * error**2, own))
    found = fitted(views, [*truth])
    for name, weight in truth.items():
        assert found.weights[name] == pytest.approx(weight, rel=0.15)  # the units' geometric mean is 1
    assert found.transfer == pytest.approx(0.5, rel=0.05)
    assert found.spread < 0.5
    assert found.expect(views[2]).mean() == pytest.approx(views[2].error.mean(), rel=0.05)
    # An exponential error: mean square twice the square of the mean, and here doubled.
    squares = predict(views[0], truth) ** 2
    assert found.peaked == pytest.approx(4, rel=0.15)
    assert math.isfinite(squares.mean())
