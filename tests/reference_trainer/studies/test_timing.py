"""The clock of the studies."""

from reference_trainer.studies.timing import in_turns


def test_calls_are_made_in_turns_and_the_first_round_is_not_timed(device):
    made = []
    seconds = in_turns({name: lambda name=name: made.append(name) for name in "ab"}, 3, device)
    assert made == ["a", "b"] * 4
    assert [len(x) for x in seconds.values()] == [3, 3]
