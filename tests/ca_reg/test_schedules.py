"""Schedules at and between their corners."""

import pytest

from ca_reg.schedules import Constant, ExponentialDecay, LinearRamp, StartStop, as_schedule


def test_constant_is_constant():
    assert [Constant(0.3)(step) for step in (0, 1, 10**9)] == [0.3] * 3


def test_ramp_is_exact_at_its_ends_and_linear_between():
    ramp = LinearRamp(0.1, 0.3, 100, 300)
    assert [ramp(step) for step in (0, 100, 300, 10**9)] == [0.1, 0.1, 0.3, 0.3]
    assert ramp(150) == pytest.approx(0.15)
    assert ramp(250) == pytest.approx(0.25)


def test_a_ramp_may_fall():
    assert LinearRamp(0.4, 0.0, 0, 10)(5) == pytest.approx(0.2)


def test_a_ramp_may_lie_beyond_all_floats():
    ramp = LinearRamp(0.1, 0.3, 10**400, 10**400 + 1)
    assert [ramp(step) for step in (0, 10**400 + 1)] == [0.1, 0.3]


def test_start_stop_is_half_open():
    schedule = StartStop(0.2, start=10, stop=20)
    assert [schedule(step) for step in (0, 9, 10, 19, 20, 100)] == [0.0, 0.0, 0.2, 0.2, 0.0, 0.0]
    assert StartStop(0.2)(0) == StartStop(0.2)(10**9) == 0.2


def test_a_decay_falls_by_a_constant_factor_and_is_half_open():
    decay = ExponentialDecay(0.08, 0.02, 10, 14)
    assert [decay(step) for step in (0, 9, 14, 100)] == [0.0] * 4
    assert [decay(step) for step in (10, 11, 12, 13)] == pytest.approx([0.08 * 4 ** (-k / 4) for k in range(4)])


def test_numbers_become_constants_and_callables_stay():
    assert as_schedule(0.2) == Constant(0.2)
    ramp = LinearRamp(0.0, 1.0, 0, 1)
    assert as_schedule(ramp) is ramp


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Constant(float("nan")), "value must be finite"),
        (lambda: LinearRamp(0.0, 0.2, 10, 10), "must come after"),
        (lambda: ExponentialDecay(0.2, 0.1, 10, 10), "must come after"),
        (lambda: ExponentialDecay(0.2, 0.0, 0, 10), "above 0"),
        (lambda: ExponentialDecay(10**400, 0.1, 0, 10), "value .*finite, got 1000"),
        (lambda: LinearRamp(0.0, 0.2, -1, 10), "at least 0"),
        (lambda: StartStop(0.2, start=5, stop=5), "must come after"),
    ],
)
def test_schedules_that_make_no_sense_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_decay_without_an_end_is_refused():
    with pytest.raises(TypeError, match=r"stop .*got NoneType"):
        ExponentialDecay(0.2, 0.1, 0, None)
