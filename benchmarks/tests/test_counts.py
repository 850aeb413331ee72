"""What is counted without a card."""

import pytest

from benchmarks.counts import count_lists


@pytest.mark.parametrize("gradient", [False, True])
def test_lists_cost_in_proportion_to_their_entries(gradient, monkeypatch):
    monkeypatch.setattr("ca_reg.lists._CHUNK", 1 << 10)
    short, longer, long = (count_lists(length, 16, gradient=gradient) for length in (100, 200, 400))
    assert long.entries > 3.5 * short.entries
    first, second = longer - short, long - longer
    assert second.elements / second.entries == pytest.approx(first.elements / first.entries, rel=0.1)
    assert second.operations / second.longest == pytest.approx(first.operations / first.longest, rel=0.1)
    assert second.peak / second.entries <= 32
