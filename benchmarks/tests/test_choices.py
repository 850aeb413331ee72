"""What candidates of the later choices gain over the recipe with the same start: from rows made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from statistics import fmean

import pytest
from pages import lines_missing

from benchmarks import setting
from benchmarks.choices import (
    BY_DEFAULT,
    CHOICES,
    SLOWER_MEANS,
    SMOOTH_AND_EVEN,
    UNEVEN,
    from_same_start,
    gains_of,
    pairs_of,
    tables,
)
from benchmarks.start_scenes import from_today
from benchmarks.tests.test_setting import row
from reference_trainer.training.plan_rules import ONE_EXPOSURE_GAINS


def test_a_candidate_of_the_later_choices_gains_with_the_start_of_the_recipe():
    start = "fern, dense and few"
    rows = [row(start, "from 1,000", seed, 25.0 + seed, 20.0 + seed) for seed in (0, 1, 2)]
    rows += [row(start, f"from 1,000 + {name}", 0, 26.5, 22.0) for name in ("warp", "rate 0.3")]
    rows += [row("fern", "from 1,000 + warp", 0, 99.0, 99.0)]
    for choice, gains in ((CHOICES["third"], "+2.00 / +1.50, 1.00"), (CHOICES["fourth"], "+1.00 / +0.50, 1.00")):
        (line,) = [x for x in gains_of(rows, choice).splitlines() if x.startswith(("| warp", "| rate"))]
        assert [x.strip() for x in line.split("|")[2:-1]] == [gains, gains.partition(",")[0], "1"]


def test_the_fifth_choice_gains_at_shared_pixels_over_the_later_seeds():
    start, name = "fern, dense and few", "from 1,000 + warp + hidden left out"
    rows = [row(start, "from 1,000", seed, 25.0 + seed, 0.0) | {"shared": 20.0 + seed} for seed in (0, 3, 4, 5)]
    rows += [row(start, name, 0, 30.0, 0.0) | {"shared": 26.0}, row("cape, dense and few", name, 0, 9.0, 0.0)]
    (line,) = [x for x in gains_of(rows, CHOICES["fifth"]).splitlines() if x.startswith("| warp")]
    assert [x.strip() for x in line.split("|")[2:-1]] == ["+2.00 / +1.00, 1.00", "+2.00 / +1.00", "1"]


def test_the_later_choices_gain_over_all_seeds_of_the_recipe():
    start = "fern, dense and few"
    rows = [row(start, "from 1,000", seed, 25.0 + seed, 20.0 + seed) for seed in range(6)]
    rows += [row(start, "from 1,000 + means x4", seed, 28.0 + seed, 23.0 + seed) for seed in (0, 1)]
    rows += [row("fern, filled", "from 1,000", 0, 27.0, 23.5)]
    for table, gains in (
        (gains_of(rows, CHOICES["sixth"]), "+0.50 / +0.50"),
        (gains_of(rows, CHOICES["sixth, second round"]), "+1.00 / +1.00"),
        (gains_of(rows, replace(CHOICES["sixth"], tried=(0, 2))), None),
        (gains_of(rows, CHOICES["seventh"]), "+1.00 / -0.50"),
    ):
        lines = [
            [x.strip() for x in line.split("|")[2:-1]]
            for line in table.splitlines()
            if "means" in line or "filled" in line
        ]
        assert lines == ([] if gains is None else [[f"{gains}, 1.00", gains, "1"]])


def test_settings_from_the_same_start_are_met_by_seeds_that_both_have():
    start = "fern, dense and few"
    rows = [row(start, "plain", seed, 20.0 + seed) for seed in (3, 4)]
    rows += [row(start, "from 1,000", seed, psnr) for seed, psnr in ((3, 25.0), (4, 23.0), (5, 99.0))]
    rows += [row("fern", "plain", 5, 20.0)]  # of another start
    text = from_same_start(rows, BY_DEFAULT)
    assert "| fern | 2 | 23.50 ± 0.71 | 24.00 ± 1.41 | +2.00, -1.00 |" in text
    assert "2 pairs of 1 scenes: +0.50 dB" in text
    assert "worst pair: -1.00 dB" in text
    assert from_same_start(rows, SLOWER_MEANS).startswith("Nothing")


@pytest.mark.parametrize("name", ["setting.json", "quality.json"])
def test_the_pages_have_the_tables_of_its_rows(name):
    rows = json.loads((setting.REFERENCES.parent / name).read_text("utf-8"))
    assert lines_missing("\n".join(tables(rows)), "choices.md", "setting.md") == []


def test_what_the_plan_says_of_one_exposure_is_what_was_measured():
    """On the scenes whose photographs differ, and no other."""
    rows = json.loads((setting.REFERENCES.parent / "setting.json").read_text("utf-8"))
    gains = {
        scene: fmean(b - a for a, b in pairs) for scene, pairs in pairs_of(rows, SMOOTH_AND_EVEN, from_today).items()
    }
    assert gains.keys() == set(UNEVEN)
    assert pytest.approx(gains, abs=0.051) == ONE_EXPOSURE_GAINS
