"""Exponents of made-up measurements."""

import math

import numpy as np
import pytest

from benchmarks.growth_report import fit_exponent, fits


def test_a_power_law_is_recovered_exactly():
    fit = fit_exponent({x: 0.3 * x**1.37 for x in (1e3, 1e4, 1e5, 1e6)})
    assert fit.exponent == pytest.approx(1.37, rel=1e-12)
    assert fit.std_error == pytest.approx(0, abs=1e-12)
    assert fit(2e5) == pytest.approx(0.3 * 2e5**1.37)


def test_only_the_upper_half_counts():
    xs = [10.0**k for k in range(8)]
    fit = fit_exponent({x: 5.0 if x < 1e4 else 5e-4 * x for x in xs})
    assert (fit.start, fit.end, fit.points) == (1e4, 1e7, 4)
    assert fit.exponent == pytest.approx(1)


def test_slope_and_error_are_those_of_the_normal_equations():
    x, y = np.array([2.0, 5.0, 11.0, 40.0]), np.array([1.1, 2.0, 6.3, 17.0])
    upper = np.log(x[1:]), np.log(y[1:])
    design = np.stack([np.ones(3), upper[0]], axis=1)
    solution, (residual,), _, _ = np.linalg.lstsq(design, upper[1], rcond=None)
    covariance = residual / (3 - 2) * np.linalg.inv(design.T @ design)
    fit = fit_exponent(dict(zip(x.tolist(), y.tolist(), strict=True)))
    assert fit.exponent == pytest.approx(solution[1], rel=1e-12)
    assert fit.std_error == pytest.approx(math.sqrt(covariance[1, 1]), rel=1e-9)


def test_noisy_timings_lie_within_their_error():
    # 8 points, of which 4 are fitted: t has 2 degrees of freedom. With a fraction of 0.95 within 4.30 errors, fewer
    # than 180 of 200 happen once in 600 (binomial, 3.2 deviations); the seed is fixed.
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        timings = {10.0**k: 10.0 ** (0.8 * k) * math.exp(rng.normal(0, 0.05)) for k in range(8)}
        fit = fit_exponent(timings)
        inside += abs(fit.exponent - 0.8) < 4.303 * fit.std_error
    assert inside >= 180


def test_two_points_have_no_error_and_no_fit():
    assert fit_exponent({1.0: 1.0, 2.0: 2.0}) is None


def test_what_was_left_out_or_has_no_memory_is_not_fitted():
    points = [
        {"x": x, "medians": {"numba": {"forward": x, "forward+backward": x**2}}, "memory": {"numba": None}}
        for x in (1.0, 2.0, 4.0)
    ]
    found = fits([*points, {"x": 8.0, "skipped": "too large"}])
    assert list(found) == ["numba, forward, time", "numba, forward+backward, time"]
    assert found["numba, forward+backward, time"]["exponent"] == pytest.approx(2)
    assert found["numba, forward, time"]["end"] == 4
