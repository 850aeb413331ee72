"""The regression gate on reports made up for it."""

import copy
import math

import pytest

from benchmarks.speed_report import regressions


@pytest.fixture
def old():
    return {
        "device": "cpu",
        "machine": {"threads": 2},
        "ratios": {"small: forward / baseline": 0.2, "medium: forward / baseline": 0.1},
        "errors": {"small: image, mean": 1e-7, "small: gradient of means": 4e-5},
    }


def changed(report, group, name, value):
    new = copy.deepcopy(report)
    new[group][name] = value
    return new


def test_small_changes_pass(old):
    assert regressions(old, old) == []
    new = changed(old, "ratios", "small: forward / baseline", 0.29)
    assert regressions(changed(new, "errors", "small: image, mean", 1.9e-7), old) == []


def test_times_are_loose_and_errors_are_tight(old):
    slow = changed(old, "ratios", "small: forward / baseline", 0.31)
    assert regressions(slow, old) == [
        "small: forward / baseline: ratio 0.31, was 0.2 (1.55 times as large; allowed 1.5)"
    ]
    worse = changed(slow, "errors", "small: image, mean", 3e-7)
    assert len(regressions(worse, old)) == 2
    assert regressions(worse, old, time_factor=2.0, error_factor=4.0) == []


@pytest.mark.parametrize("value", [None, math.nan])
def test_an_error_that_is_no_number_fails(old, value):
    assert regressions(changed(old, "errors", "small: image, mean", value), old) == [
        "small: image, mean: error nan, was 1e-07 (nan times as large; allowed 2)"
    ]


def test_an_error_that_was_zero_must_stay_so(old):
    exact = changed(old, "errors", "small: image, mean", 0.0)
    assert regressions(exact, exact) == []
    assert regressions(old, exact) == ["small: image, mean: error 1e-07, was 0"]


def test_the_largest_error_of_an_image_may_be_one_pair_on_the_edge(old):
    before = changed(old, "errors", "small: image, max", 5e-5)
    assert regressions(changed(before, "errors", "small: image, max", 3.9e-3), before) == []
    assert len(regressions(changed(before, "errors", "small: image, max", 4e-3), before)) == 1
    assert (
        regressions(
            changed(before, "errors", "small: image, max", 4e-3), changed(before, "errors", "small: image, max", 3e-3)
        )
        == []
    )


def test_only_what_both_have_is_compared(old):
    new = copy.deepcopy(old)
    new["ratios"] = {"large: forward / baseline": 9.0}
    assert regressions(new, old) == []
    with pytest.raises(ValueError, match="in common"):
        regressions({**new, "errors": {}}, old)


@pytest.mark.parametrize("change", [{"device": "cuda"}, {"machine": {"threads": 1}}])
def test_other_devices_and_threads_are_not_compared(old, change):
    with pytest.raises(ValueError, match=r"number of threads, .*cpu with 2"):
        regressions({**old, **change}, old)
