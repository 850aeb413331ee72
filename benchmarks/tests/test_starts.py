"""Trainings from other points: which rows a table compares, from rows made by hand."""

from __future__ import annotations

import json

import pytest
from pages import lines_missing

from benchmarks import dense_start, starts
from benchmarks.setting import LATER, REFERENCES, rows_of
from reference_trainer.training.plan_rules import DENSE_GAINS


def row(scene, candidate, psnr, held_out=None, seed=0):
    found = {"scene": scene, "candidate": candidate, "seed": seed, "test": {"psnr": psnr}, "gaussians": 100}
    return found | ({} if held_out is None else {"held-out": held_out})


def cells(table, first):
    (line,) = [line for line in table.splitlines() if line.startswith(f"| {first}")]
    return [cell.strip() for cell in line.split("|")[1:-1]]


FEW = "few measured points, random added"


def test_a_start_gains_over_the_first_on_the_scenes_that_it_has():
    rows = [row(f"fern, {FEW}", "drawn", 23.0, 21.0), row(f"cape, {FEW}", "drawn", 18.0, 14.0)]
    rows += [row("fern, dense", "from 1,000", 25.0, 24.0), row("sceaux, dense", "from 1,000", 99.0, 99.0)]
    rows += [row(f"fern, {FEW}", "from 1,000", 22.5, 20.5, seed=1)]
    table = starts.choice(rows, [FEW, "dense"])
    assert cells(table, "dense") == ["dense", "from 1,000", "24.00 / 25.00", "-", "+3.00 / +2.00", "1"]
    assert cells(table, "few") == [FEW, "from 150", "21.00 / 23.00", "14.00 / 18.00", "+0.00 / +0.00", "2"]


def test_a_scene_without_measured_points_has_random_ones_alone_and_nothing_to_keep():
    rows = [row("dtu-scan65, random points", "drawn", 16.0, 14.5), row("dtu-scan65, dense", "from 1,000", 20.5, 14.7)]
    table = starts.choice(rows, [FEW, "dense and few"])
    assert cells(table, "dense and few")[-2:] == ["+0.20 / +4.50", "1"]
    rows += [row("lego", "drawn", 24.0), row("lego, dense", "from 1,000", 24.5)]  # declared with random points
    assert cells(starts.judgement(rows, "dense and few"), "lego") == ["lego", "1", "24.00", "24.50", "+0.50"]


def test_a_judgement_pairs_seeds():
    rows = [row(f"fern, {FEW}", "drawn", 23.0 + seed, seed=seed) for seed in (0, 1, 2)]
    rows += [row("fern, dense and few", "from 1,000", 25.5 + seed, seed=seed) for seed in (1, 2, 3)]
    table = starts.judgement(rows, "dense and few")
    assert cells(table, "fern")[-1] == "+2.50, +2.50"
    assert "1 scenes: +2.5 dB; the least: +2.5 dB" in table


def test_a_longer_sweep_is_met_by_the_seeds_of_the_one_before():
    rows = [row("cape, dense and few", "from 1,000", 21.0, 14.0, seed=seed) for seed in (0, 1, 2)]
    rows += [row("cape, farther", "from 1,000", 22.0 + seed, 14.5, seed=seed) for seed in (1, 2, 3)]
    rows += [row("cape, farther", "plain", 99.0), row("fern, dense and few", "plain", 99.0)]
    (line,) = [line for line in starts.changed(rows, "farther").splitlines() if line.startswith("| cape")]
    found = [cell.strip() for cell in line.split("|")[1:-1]]
    assert found == ["cape", "recipe", "2", "21.00 ± 0.00", "23.50 ± 0.71", "+2.00, +3.00", "+0.50, +0.50"]


def test_cameras_of_three_photographs_alone():
    rows = [row("fern-own", "drawn", 19.0), row("fern-own, dense and few", "from 1,000", 21.0)]
    assert cells(starts.own_cameras([*rows, row("sceaux-own", "drawn", 16.0)]), "fern")[1:4] == [
        "19.00",
        "21.00",
        "+2.00",
    ]


def test_what_the_plan_says_of_a_dense_start_is_what_was_measured():
    rows = json.loads((REFERENCES.parent / "setting.json").read_text("utf-8"))
    for scene, gain in DENSE_GAINS.items():
        without, there = (
            rows_of(rows, f"{scene}{start}", LATER)[0]["test"]["psnr"]
            for start in ("" if scene in ("fountain", "herz-jesu") else ", SIFT", ", dense and SIFT")
        )
        assert gain == pytest.approx(there - without, abs=0.051)


def test_the_page_has_the_tables_of_its_rows():
    rows = json.loads((REFERENCES.parent / "setting.json").read_text("utf-8"))
    points = json.loads((REFERENCES.parent / "dense_start.json").read_text("utf-8"))["rows"]
    assert lines_missing("\n".join([*starts.tables(rows), dense_start.table(points)]), "dense_start.md") == []
