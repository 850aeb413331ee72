"""Timing in turns."""

import itertools

from reference_trainer.studies.clocks import in_turns


def test_calls_are_made_in_turns_and_the_first_round_is_not_timed():
    made = []
    calls = {name: lambda name=name: made.append(name) for name in "ab"}
    assert in_turns(calls, 3, itertools.count().__next__) == {"a": [1] * 3, "b": [1] * 3}
    assert made == ["a", "b"] * 4
