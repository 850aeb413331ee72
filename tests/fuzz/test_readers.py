"""Every reader against damaged files: it refuses them by name, or returns something whole. `campaign.py` tries more.

To continue a training takes as long as to read fifty files, so that there are fewer of these.
"""

import pytest
from fuzz.harness import fuzz
from fuzz.targets import TARGETS


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_damaged_files(target, tmp_path):
    count = 70 if target.form == "state" else 240
    outcome = fuzz(target, tmp_path, range(count))
    assert not outcome.defects
    assert outcome.refused > 0
    assert outcome.read + outcome.refused == outcome.inputs == count
