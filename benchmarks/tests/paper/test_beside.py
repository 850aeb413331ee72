import dataclasses

import pytest

from benchmarks.paper import beside
from benchmarks.paper.beside import beside_table, origins_table, rates_table, seeds_table, sizes_table
from benchmarks.paper.claims import CLAIMS
from benchmarks.paper.comparison import RowStore
from benchmarks.paper.page import page
from benchmarks.paper.rows import Rows, resolved
from benchmarks.paper.scenes import PAPER_STEPS


@pytest.fixture
def add(tmp_path):
    """Add one training to the rows of a scene in a folder."""

    def add(scene, psnr, seed=0, ca=5e-3, steps=3_000, test=(), origin=(), **setting):
        Rows(tmp_path / f"{scene}.json", {"scene": scene}).add(
            {"setting": resolved(setting, "3dgs", steps), "seed": seed, "test": {"psnr": psnr, "ca": ca} | dict(test),
             "train": {}, "gaussians": 1_000, "seconds": 60.0, "commit": "0123456789ab", "cpu": "A"} | dict(origin)
        )  # fmt: skip

    return add


def cells(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def test_the_papers_figures_stand_above_ours_of_both_sizes(add, tmp_path):
    for seed in range(2):
        add("lego", 20.0, seed, ca=4e-3)
        add("lego", 21.0 + seed, seed, ca=1e-3, regularizer="dropout(0.2)")
        add("lego", 19.5, seed, ca=2e-3, regularizer="noise(0.8)")
        add("lego", 20.5 + 0.5 * seed, seed, ca=3e-3, regularizer="noise(0.4)")
    add("fern", 20.0)  # plain alone: nothing to compare
    for psnr, of in ((20.0, {}), (20.5, {"regularizer": "dropout(0.2)"}), (20.1, {"regularizer": "noise(0.8)"})):
        add("lego-400", psnr, steps=PAPER_STEPS, **of)
    assert cells(beside_table(RowStore(tmp_path))) == [
        # 24.14 and 23.65 less 23.54 dB; 2.015 and 3.136 of 3.937
        ["Blender", "3dgs", "the paper", "+0.60", "+0.11", "0.51", "0.80", "dropout > noise > plain", "", ""],
        [
            "Blender",
            "3dgs",
            "lego (2)",
            "+1.50 ± 1.00",
            "-0.50 ± 0.00",
            "0.25",
            "0.50",
            "dropout > plain > noise",
            "+0.75 ± 0.50",
            "0.75",
        ],
        ["Blender", "3dgs", "lego-400 (1)", "+0.50", "+0.10", "1.00", "1.00", "dropout > noise > plain", "", ""],
    ]


def test_verdicts_at_both_sizes_and_a_single_seed_has_none(add, tmp_path):
    for seed in range(3):
        for scene, steps in (("fern", 3_000), ("fern-504", PAPER_STEPS)):
            add(scene, 20.0, seed, steps=steps)
            better = steps == 3_000
            add(scene, 20.0 + (seed + 1) * (1 if better else -1), seed, 2e-3, steps, regularizer="dropout(0.2)")
    add("lego-400", 20.0, steps=PAPER_STEPS)
    add("lego-400", 21.0, ca=2e-3, steps=PAPER_STEPS, regularizer="dropout(0.2)")
    (row,) = cells(sizes_table(RowStore(tmp_path)))
    assert row == ["1", CLAIMS["1"].says, "holds (3) → fails (3)", "n/a → as claimed (1)"]
    add("lego-400", 19.0, ca=2e-3, steps=PAPER_STEPS, regularizer="dropout(0.2)")
    assert cells(sizes_table(RowStore(tmp_path)))[0][-1] == "n/a → not as claimed (1)"


def test_verdicts_of_three_seeds_and_of_all(add, tmp_path):
    for seed, gain in enumerate((0.0, 1.0, 0.2, 0.5, 0.5, 0.5)):
        add("fern", 20.0, seed)
        if seed == 3:
            assert seeds_table(RowStore(tmp_path)) == ""
        add("fern", 20.0 + gain, seed, ca=2e-3, regularizer="dropout(0.2)")
    assert cells(seeds_table(RowStore(tmp_path))) == [
        ["1", CLAIMS["1"].says, "fern", "undecided", "**holds**", "6"],
    ]


def test_a_claim_whose_checks_have_unlike_numbers_of_seeds_says_so(add, tmp_path, monkeypatch):
    monkeypatch.setattr(beside, "CLAIMS", {"7": dataclasses.replace(CLAIMS["7"], checks=CLAIMS["7"].checks[:2])})
    for seed in range(5):
        add("fern", 20.0, seed)
        add("fern", 21.0, seed, regularizer="dropout(0.2)")
        if seed < 3:
            add("fern", 21.0, seed, regularizer="dropout(0.1)")
    assert cells(seeds_table(RowStore(tmp_path)))[0][-2:] == ["holds", "3 to 5"]


def test_the_score_at_the_rate_of_the_protocol_is_set_beside_the_formula(add, tmp_path):
    for seed, exact in enumerate((3e-3, 5e-3)):
        add("fern", 20.0, seed, test={"ca_exact": exact, "ca_exact_half": 1e-3}, regularizer="dropout(0.2)")
    assert cells(rates_table(RowStore(tmp_path))) == [["0.2", "0.6", "0.96", "4.00"]]  # 4 * 0.6 * 0.4


def test_rows_are_counted_by_where_they_come_from(add, tmp_path):
    add("fern", 20.0)
    add("fern", 20.0, 1)
    add("fern", 20.0, 2, origin={"commit": "fedcba987654-dirty"})
    add("fern", 20.0, 3, origin={"device": "a card", "commit": None})
    add("fern", 20.0, steps=PAPER_STEPS)
    assert cells(origins_table(RowStore(tmp_path))) == [
        ["fern", "A", "3", "`01234567`: 2, `fedcba98` changed: 1"],
        ["fern", "a card", "1", "`unknown`: 1"],
    ]


def test_a_mark_of_a_table_without_rows_says_so(tmp_path):
    made = page("<!-- paper seeds -->\nstale\n<!-- end -->\n", RowStore(tmp_path))
    assert made.splitlines()[1] == "Not yet measured."


def test_a_mark_of_a_table_names_its_steps(add, tmp_path):
    add("fern", 20.0)
    add("fern-504", 20.0, steps=PAPER_STEPS)
    for steps, scene in (("", "fern"), (f" {PAPER_STEPS}", "fern-504")):
        text = page(f"<!-- paper origins{steps} -->\n<!-- end -->\n", RowStore(tmp_path))
        assert [row[0] for row in cells(text)[1:-1]] == [scene]
