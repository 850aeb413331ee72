"""What a candidate changes by the median of the views: from rows made by hand."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from pages import ROOT, lines_missing

from benchmarks.by_views import difference, table, tables
from benchmarks.setting import TODAY


def row(candidate: str, seed: int, held_out: list[float], test: list[float]) -> dict[str, Any]:
    """Return a row of fern; LPIPS is a hundredth of PSNR."""
    psnr = {split: dict(zip("abc", of, strict=False)) for split, of in (("held-out", held_out), ("test", test))}
    splits = {split: {"psnr": of, "lpips": {x: y / 100 for x, y in of.items()}} for split, of in psnr.items()}
    return {"scene": "fern", "candidate": candidate, "seed": seed, "gaussians": 10, "seconds": 2.0} | splits


def test_one_view_of_three_does_not_choose_but_counts_where_it_judges():
    before = [row("before", 0, [20.0, 20.0, 20.0], [30.0, 30.0]), row("before", 1, [22.0, 20.0, 20.0], [32.0, 30.0])]
    after = [row("after", 0, [22.0, 21.0, 10.0], [31.0, 30.0]), row("after", 1, [22.0, 21.0, 10.0], [31.0, 20.0])]
    assert difference(before, after, "held-out", "psnr") == pytest.approx(1.0)
    assert difference(before, after, "test", "psnr") == pytest.approx(-2.5)
    after += [row("after", 2, [50.0] * 3, [50.0] * 2)]  # a seed that the reference lacks
    cells = [x.strip() for x in table([*before, *after], "before", "after").splitlines()[4].split("|")[1:-1]]
    assert cells == ["fern", "2", "+1.00", "+0.010", "-2.50", "-0.025", "1.00", "1.00"]


@pytest.mark.parametrize("name", ["by_views", "ray_extent_first", "ray_extent"])
def test_the_page_has_the_tables_of_its_rows(name):
    rows = json.loads((ROOT / "benchmarks" / "data" / f"{name}.json").read_text("utf-8"))
    assert lines_missing("\n".join(tables(rows)), "choices.md") == []


def test_what_the_recipe_gains_as_run_trains_is_what_was_measured():
    """The figures in docs/settings.md against the rows, of single trainings of the six scenes."""
    rows = json.loads((ROOT / "benchmarks" / "data" / "by_views.json").read_text("utf-8"))
    plain, own = ({r["scene"]: r for r in rows if (r["candidate"], r["seed"]) == (x, 0)} for x in ("plain", TODAY))
    gains, sharpness = (
        [difference([plain[scene]], [own[scene]], "test", figure) for scene in plain] for figure in ("psnr", "lpips")
    )
    text = " ".join((ROOT / "docs" / "settings.md").read_text("utf-8").split())
    said = re.search(r"six gained (\S+) to (\S+) dB over plain ones, (\S+) in .*?LPIPS (\S+) higher", text)
    least, most, mean, blur = map(float, said.groups())
    assert len(gains) == 6
    assert [least, most, mean] == pytest.approx([min(gains), max(gains), sum(gains) / 6], abs=0.051)
    assert blur == pytest.approx(sum(sharpness) / 6, abs=0.00051)
