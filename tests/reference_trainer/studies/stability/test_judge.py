"""The judge on cases whose onset and way of failing are known."""

import math

import pytest
import torch

from reference_trainer.studies.stability.cases import Case, Probe, decades, single
from reference_trainer.studies.stability.stability_study import (
    GRADIENT_TOLERANCE,
    VALUE_TOLERANCE,
    judge,
    relative_error,
)


def growing(x, *, name="image", rate=1e-6):
    """A probe whose relative error is ``rate`` times the magnitude."""
    one = torch.ones(5, dtype=torch.float64)
    return Probe(lambda: {name: one * (1 + rate * x)}, lambda: {name: one})


def failure(verdict):
    """The first point that is not right."""
    return next((point for point in verdict["points"] if point["status"] != "ok"), None)


@pytest.mark.parametrize(("name", "tolerance"), [("image", VALUE_TOLERANCE), ("d means", GRADIENT_TOLERANCE)])
def test_the_onset_is_found_to_seven_percent(name, tolerance):
    verdict = judge(Case("f", "n", lambda x: growing(x, name=name), decades(0, 6), until=100.0, note="known"))
    assert tolerance / 1e-6 <= verdict["onset"] <= 1.08 * tolerance / 1e-6
    assert verdict["ending"] == "limit"
    assert failure(verdict)["magnitude"] == verdict["onset"]
    assert failure(verdict)["wrong"] == [name]
    magnitudes = [point["magnitude"] for point in verdict["points"]]
    assert magnitudes == sorted(magnitudes)
    assert set(decades(0, 6)) <= set(magnitudes)


def test_what_stays_right_has_no_onset():
    verdict = judge(Case("f", "n", growing, decades(-3, 2)))
    assert (verdict["ending"], verdict["onset"], failure(verdict)) == ("ok", None, None)


def test_a_limit_that_comes_too_early_is_a_defect():
    assert judge(Case("f", "n", growing, decades(0, 6), until=2000.0))["ending"] == "defect"
    assert judge(single("f", "n", lambda: growing(1e9)))["ending"] == "defect"


def raising(error):
    def measured():
        raise error

    return lambda x: Probe(measured, lambda: {})


@pytest.mark.parametrize("error", [ValueError("too bright"), TypeError("too bright")])
def test_an_error_that_was_foreseen_is_a_refusal(error):
    verdict = judge(single("f", "n", lambda: raising(error)(1.0), refused="its checks"))
    assert (verdict["ending"], verdict["onset"], failure(verdict)["status"]) == ("refused", 1.0, "refused")
    assert failure(verdict)["message"] == f"{type(error).__name__}: too bright"
    assert judge(single("f", "n", lambda: raising(error)(1.0)))["ending"] == "defect"


@pytest.mark.parametrize("error", [RuntimeError("x"), ZeroDivisionError("x"), IndexError("x"), AssertionError("x")])
def test_any_other_error_is_a_crash_and_a_defect(error):
    verdict = judge(single("f", "n", lambda: raising(error)(1.0), refused="its checks"))
    assert (verdict["ending"], failure(verdict)["status"]) == ("defect", "crash")


@pytest.mark.parametrize(("beyond", "ending"), [("refused", "defect"), ("limit", "defect"), ("overflow", "limit")])
def test_what_is_not_finite_is_allowed_as_overflow_alone(beyond, ending):
    def probe(x):
        return Probe(lambda: {"image": torch.tensor([x**20])}, lambda: {"image": torch.tensor([x]).double() ** 20})

    verdict = judge(Case("f", "n", probe, (1.0, 10.0, 1000.0), until=1.0, beyond=beyond))
    assert failure(verdict)["status"] == "not finite"
    assert verdict["ending"] == ending
    assert 10 ** (38 / 20) < verdict["onset"] < 1.16 * 10 ** (38.6 / 20)


def test_relative_errors():
    reference = torch.tensor([3.0, 4.0], dtype=torch.float64)
    assert relative_error(reference + torch.tensor([0.0, 0.5]), reference) == pytest.approx(0.1)
    assert relative_error(torch.full((2,), 0.25), torch.zeros(2)) == pytest.approx(0.25 * math.sqrt(2))
    assert relative_error(torch.tensor([math.nan, 4.0]), torch.tensor([math.nan, 4.0])) == 0
    assert relative_error(torch.tensor([3.0, math.nan]), reference) == math.inf
    assert relative_error(torch.tensor([3.0, math.inf]), reference) == math.inf
    assert relative_error(torch.zeros(0), torch.zeros(0)) == 0
    with pytest.raises(ValueError, match="shapes differ"):
        relative_error(torch.zeros(3), reference)
