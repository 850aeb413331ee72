"""Every reader against damaged files: it refuses them by name, or returns something whole. `campaign.py` tries more.

To continue a training takes as long as to read fifty files, so that there are fewer of these.
"""

import pytest
from fuzz.harness import fuzz
from fuzz.targets import TARGETS

targets = pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)


@pytest.mark.slow
@targets
def test_damaged_files(target, tmp_path):
    count = 20 if target.form == "state" else 120
    outcome = fuzz(target, tmp_path, range(count))
    assert not outcome.defects
    assert outcome.refused > 0
    assert outcome.read + outcome.refused == outcome.inputs == count


@pytest.mark.slow
@targets
def test_many_damaged_files(target, tmp_path):
    count = 50 if target.form == "state" else 120
    assert not fuzz(target, tmp_path, range(1000, 1000 + count)).defects
