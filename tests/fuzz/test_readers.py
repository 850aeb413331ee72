"""Every reader against damaged files: it refuses them by name, or returns something whole. `campaign.py` tries more."""

import pytest
from fuzz.harness import fuzz
from fuzz.targets import TARGETS

targets = pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)


@targets
def test_damaged_files(target, tmp_path):
    outcome = fuzz(target, tmp_path, range(120))
    assert not outcome.defects
    assert outcome.refused > 0
    assert outcome.read + outcome.refused == outcome.inputs == 120


@pytest.mark.slow
@targets
def test_many_damaged_files(target, tmp_path):
    assert not fuzz(target, tmp_path, range(1000, 2000)).defects
