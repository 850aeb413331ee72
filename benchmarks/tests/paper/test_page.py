"""What is kept of trainings, and the tables and figures that are made of it."""

import dataclasses
import json
import math
import re
from contextlib import contextmanager

import numpy as np
import pytest
from pages import ROOT

from benchmarks.choices import BY_SMOOTH, BY_TODAYS, TWO_BY_TODAYS, pairs_of
from benchmarks.paper import figure as figure_module
from benchmarks.paper.cells import Grid, declared, estimate, is_done, rows_of
from benchmarks.paper.claims import CLAIMS, Check, Claim, chosen
from benchmarks.paper.comparison import RowStore, differences, judged
from benchmarks.paper.figure import course_figure, gains_figure, ranking_figure
from benchmarks.paper.page import claims_table, details, gains, page, scenes_table
from benchmarks.paper.rows import Rows, resolved, value
from benchmarks.paper.scenes import chosen_scenes
from benchmarks.start_scenes import from_today
from reference_trainer.evaluation.style import new_figure
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.plan_rules import DROPOUT_GAINS, FAR_APART_GAINS, SPARSE_GAINS, SPARSE_GAINS_FAR_APART

# What is kept


def row(psnr, seed=0, ca=5e-3, **setting):
    return {"setting": resolved(setting, "3dgs", 3_000), "seed": seed, "test": {"psnr": psnr, "ca": ca},
            "train": {}, "gaussians": 1_000, "seconds": 60.0}  # fmt: skip


def test_rows_are_added_by_several_and_a_later_one_takes_the_place(tmp_path):
    one, other = (Rows(tmp_path / "a.json", {"scene": "a"}) for _ in range(2))
    one.add(row(20.0))
    other.add(row(21.0, seed=1))
    one.add(row(22.0, regularizer="density"))
    one.add(row(23.0))
    again = Rows(tmp_path / "a.json")
    assert again.content["scene"] == "a"
    assert [value(each, "test psnr") for each in again.rows] == [21.0, 22.0, 23.0]
    assert len((tmp_path / "a.json").read_text().splitlines()) == 1 + 3 + 1
    assert {seed: value(each, "test psnr") for seed, each in again.of(resolved({}, "3dgs", 3_000)).items()} == {
        0: 23.0, 1: 21.0,
    }  # fmt: skip
    assert again.of(resolved({}, "3dgs", 2_000)) == {}
    assert math.isnan(value(again.rows[0], "depth abs_rel"))


def test_what_lacks_a_figure_is_not_done(tmp_path):
    scenes = chosen_scenes([], tmp_path, SceneOptions("synthetic"))
    grid = Grid(chosen(["1", "14"], [*scenes]), scenes, seeds=1, out=tmp_path, rows=tmp_path)
    cell, *others = declared(grid)
    assert cell.needs == {"depth"}
    rows_of(grid)["synthetic"].add(row(20.0))
    assert not is_done(cell, rows_of(grid))
    rows_of(grid)["synthetic"].add(row(20.0) | {"depth": {"abs_rel": 0.1}})
    assert is_done(cell, rows_of(grid))
    assert estimate(others[0], rows_of(grid)) == pytest.approx(60.0)  # as long as its like


def test_what_is_kept_of_other_photographs_is_not_taken_for_these(tmp_path):
    """The same scene at another size: neither counted as done, nor continued."""

    def grid(**options):
        scenes = chosen_scenes([], tmp_path, SceneOptions("synthetic", **options))
        return Grid(chosen(["1"], [*scenes]), scenes, out=tmp_path, rows=tmp_path)

    rows_of(grid(downscale=4.0))["synthetic"].add(row(20.0))
    assert len(rows_of(grid(downscale=4.0))["synthetic"].rows) == 1
    for other in ({}, {"downscale": 2.0}):
        with pytest.raises(ValueError, match=r"options {'downscale': 4\.0}, not .*--out"):
            rows_of(grid(**other))


# The tables


@pytest.fixture
def store(tmp_path):
    """Dropout helps on one scene, harms on another, and there is one seed of the third."""
    figures = {"a": [(20.0, 21.0), (20.2, 21.1), (19.9, 21.0)], "b": [(20.0, 19.0), (20.2, 19.1)], "c": [(20.0, 20.5)]}
    for scene, pairs in figures.items():
        rows = Rows(tmp_path / f"{scene}.json", {"scene": scene})
        for seed, (plain, dropout) in enumerate(pairs):
            rows.add(row(plain, seed))
            rows.add(row(dropout, seed, ca=2e-3, regularizer="dropout(0.2)"))
    return RowStore(tmp_path)


def test_claims_are_judged_scene_by_scene(store):
    assert judged(CLAIMS["1"], store) == {"a": (3, "holds"), "b": (2, "fails"), "c": (1, "undecided")}
    assert judged(CLAIMS["2"], store) == {}
    lines = {line.split(" | ")[0].strip("| "): line for line in claims_table(store).splitlines()[2:]}
    assert lines["1"].endswith("| depends on the scene | holds: a (3); fails: b (2); undecided: c (1) |")
    assert lines["2"].endswith("| not yet measured | - |")
    assert "systems" not in lines


def test_gains_are_in_the_order_of_their_mean_and_those_that_lack_a_scene_are_last(store):
    for seed, of in store.scenes["a"].of(resolved({}, "3dgs", 3_000)).items():
        store.scenes["a"].add(row(of["test"]["psnr"] + 7.0, seed, regularizer="dropout(0.3)"))
        for name, gain in (("a", 1.5), ("b", 0.5)):
            store.scenes[name].add(row(20.0 + gain, seed, ca=4e-3, regularizer="dropout(0.1)"))
    lines = gains("7", RowStore(store.folder)).splitlines()
    assert lines[0] == "| setting | mean | a | b |"  # of c there is one seed
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| `dropout(0.1)`", "| `dropout(0.2)`", "| `dropout(0.3)`"]
    # 1.0, 0.9, 1.1 and -1.0, -1.1: their means, and two standard errors
    assert lines[3] == "| `dropout(0.2)` | -0.02 dB | +1.00 ± 0.12 dB | -1.05 ± 0.10 dB |"
    assert lines[4].endswith("| +7.00 dB | +7.00 ± 0.00 dB | n/a |")
    assert gains("11", RowStore(store.folder)) == ""


def test_the_table_of_scenes_pools_what_seeds_differ_by_over_settings_and_pairs(tmp_path):
    """Values with a variance of 1, 4 and 1 in each setting; of their differences, 1, 0 and 1."""
    rows = Rows(tmp_path / "a.json")
    for name, psnrs in (("dropout(0.1)", (1, 2, 3)), ("dropout(0.2)", (12, 14, 16)), ("noise(0.8)", (7, 8, 9))):
        for seed, found in enumerate(psnrs):
            rows.add(row(found, seed, regularizer=name))
    rows.add(row(99.0, regularizer="density"))  # of one seed nothing is known
    Rows(tmp_path / "b.json").add(row(20.0))
    lines = scenes_table(RowStore(tmp_path)).splitlines()
    one, two = math.sqrt(6 / 3), math.sqrt(2 / 3)
    assert lines[2] == f"| a | 10 | 0.2 | {one:.2f} dB | {two:.2f} dB | {math.ceil(400 * 2 / 3)} |"
    assert lines[3] == "| b | 1 | 0.0 | n/a | n/a | n/a |"
    assert lines[4] == "| all | 11 | 0.2 | n/a | n/a | n/a |"


def test_details_show_what_is_measured_and_every_check(store):
    text = details("1", store)
    assert "| plain | 3 | 20.03 ± 0.15 | 5 ± 0 | 1 ± 0 |" in text  # no SSIM, which no row has, no seconds
    assert "- `dropout(0.2) - plain`, PSNR: +1 ± 0.12 (claimed: above 0), holds" in text
    assert "- `dropout(0.2) - plain`, CA: -3 ± 0 (claimed: below 0), holds" in text
    assert "PSNR: +0.5 (claimed: above 0), undecided" in text
    assert details("9", store).count("renders") == 0
    assert details("16", store) == details("1", RowStore(store.folder, "inria")) == ""


def test_a_declared_scene_counts_only_where_a_claim_names_it(store, monkeypatch):
    for name in ("fern", "lego"):
        (store.folder / f"{name}.json").write_text((store.folder / "a.json").read_text())
    store, tested = RowStore(store.folder), dataclasses.replace(CLAIMS["1"], scenes=("fern",))
    monkeypatch.setitem(CLAIMS, "1", tested)
    assert judged(tested, store).keys() == {"fern", "a", "b", "c"}
    assert re.findall(r"^\*\*(.*)\*\*:", details("1", store), re.MULTILINE) == ["a", "b", "c", "fern"]
    assert gains("1", store).splitlines()[0] == "| setting | mean | a | b | fern |"


def test_a_relative_check_divides_by_the_other_figure(store):
    claim = Claim("", "", (), (Check("test psnr", {"regularizer": "dropout(0.2)"}, {}, -0.04, 0.04, relative=True),))
    assert judged(claim, store)["b"] == (2, "fails")  # -5 and -5.4 %
    assert judged(claim, store)["a"] == (3, "fails")


def test_pages_are_made_again_between_their_marks(store):
    text = "before\n<!-- paper claims -->\nstale words\n<!-- end -->\nafter\n<!-- paper details -->\n<!-- end -->\n"
    made = page(text, store)
    assert made == page(made, store)
    assert made.startswith("before\n<!-- paper claims -->\n|  | claim |")
    assert details("1", store) in made
    # Half of their settings at most, or no path.
    assert "\nNot yet measured after 3,000 steps: 2, 3, 4, 5, 7, 8, 9, 10, 11, 14, 15, 16, 17" in made
    assert "stale" not in made


def test_a_mark_names_one_comparison_and_its_iterations(store):
    text = "<!-- paper details 1 100 -->\n<!-- end -->\n"
    rows = Rows(store.folder / "a.json")
    for setting in CLAIMS["1"].settings:
        rows.add({**row(25.0), "setting": resolved(setting, "3dgs", 100)})
    assert page(text, store).count("| 1 | 25 |") == 2
    assert "Not yet measured." in page(text.replace("100", "50"), store)


@pytest.fixture
def figures(monkeypatch):
    """The figures that were plotted."""
    figures = []

    @contextmanager
    def held(path):
        with new_figure(path) as figure:
            yield figure
        figures.append(figure)

    monkeypatch.setattr(figure_module, "new_figure", held)
    return figures


def test_the_figure_plots_means_of_differences_where_three_places_are_kept(store, figures):
    gained = [0.5, 0.4, 0.9]
    with pytest.raises(ValueError, match="no line"):
        gains_figure(store, store.folder / "gains.png")
    rows = Rows(store.folder / "a.json")
    for seed, plain in enumerate((20.0, 20.2, 19.9)):
        rows.add(row(plain + gained[seed], seed, regularizer="dropout(0.1)"))
    gains_figure(RowStore(store.folder), store.folder / "gains.png")
    assert [len(panel.containers) for panel in figures[0].axes] == [1, 0]  # the others have two places at most
    (bars,) = figures[0].axes[0].containers
    line, _, (errors,) = bars
    assert bars.get_label() == "a"
    assert np.allclose(line.get_xydata(), [(0.0, 0.0), (0.1, np.mean(gained)), (0.2, 1.0)])
    assert np.allclose(np.ptp(errors.get_segments()[1], 0), (0.0, 4 * np.std(gained, ddof=1) / math.sqrt(3)))
    assert (store.folder / "gains.png").stat().st_size > 1_000


def test_the_ranking_plots_the_best_setting_first_and_the_score_beside_it(store, figures):
    with pytest.raises(ValueError, match="claim 11: nothing"):
        ranking_figure(store, ["7", "11"], store.folder / "ranking.png")
    rows = Rows(store.folder / "a.json")
    for seed, of in rows.of(resolved({}, "3dgs", 3_000)).items():
        better = row(of["test"]["psnr"] + 3.0 + seed, seed, regularizer="dropout(0.3)")
        for each, score in ((of, 8e-3), (better, 2e-3)):
            rows.add(each | {"test": each["test"] | {"ca_exact_half": score}})
    ranking_figure(RowStore(store.folder), ["7"], store.folder / "ranking.png")
    gained, score = figures[0].axes
    assert [tick.get_text() for tick in gained.get_yticklabels()] == ["dropout 0.2", "dropout 0.3"]  # 0.3 lacks b
    assert [bars.get_label() for bars in gained.containers] == ["a", "b"]
    on_a, on_b = (bars[0].get_xydata() for bars in gained.containers)
    assert np.allclose(on_a[:, 0], (1.0, 4.0))
    assert np.allclose(on_b[:, 0], -1.05)
    assert gained.yaxis_inverted()
    assert list(on_a[:, 1] // 0.5) == [-1, 1]  # above the middles of their rows, 0 and 1
    (errors,) = gained.containers[0][2]
    assert np.allclose(np.ptp(errors.get_segments()[1], 0), (4 / math.sqrt(3), 0.0))  # 3, 4 and 5 dB
    assert np.allclose(score.lines[0].get_xdata(), (math.nan, -75.0), equal_nan=True)


def test_the_course_of_trainings_is_plotted_where_two_seeds_are_kept(store, figures):
    with pytest.raises(ValueError, match="claim late: nothing"):
        course_figure(store, ["late"], store.folder / "course.png")
    rows = Rows(store.folder / "b.json")  # of a there is no noise
    for seed in range(2):
        for regularizer in ({}, {"regularizer": "dropout(0.2)"}, {"regularizer": "noise(0.8)"}):
            course = {str(sixth): (sixth + seed) * (1e-3 if not regularizer else 5e-4) for sixth in range(1, 7)}
            shown = {"psnr/test": {sixth: 1e4 * x for sixth, x in course.items()}}
            rows.add(row(20.0, seed, **regularizer) | {"path": course, "course": shown})
    course_figure(RowStore(store.folder), ["late"], store.folder / "course.png")
    ca, psnr = figures[0].axes
    assert [bars.get_label() for bars in ca.containers] == ["without a regularizer", "dropout 0.2", "opacity noise 0.8"]
    plain, dropout, _ = (bars[0].get_xydata() for bars in ca.containers)
    assert np.allclose(plain, [(sixth, sixth + 0.5) for sixth in range(1, 7)])
    assert np.allclose(dropout[:, 1], plain[:, 1] / 2)
    assert np.allclose(psnr.containers[0][0].get_ydata(), 10 * plain[:, 1])
    (errors,) = ca.containers[0][2]
    assert np.allclose(np.ptp(errors.get_segments()[1], 0), (0.0, 2.0))  # of two seeds 1 apart, two errors each way


@pytest.mark.parametrize(
    "path",
    sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")]),
    ids=lambda path: f"{path.parent.name}/{path.name}",
)
def test_the_pages_show_what_is_kept(path):
    assert page(path.read_text("utf-8"), RowStore(ROOT / "benchmarks" / "data" / "paper")) == path.read_text("utf-8")


FOLDERS = {"the built-in scene": "synthetic", "DTU scan24": "dtu-scan24", "DTU scan65": "dtu-scan65"}


def test_what_dropout_gained_is_what_was_measured():
    """The figures of the rule against the kept rows of the study."""
    store = RowStore(ROOT / "benchmarks" / "data" / "paper")
    for number, measured in (*DROPOUT_GAINS.items(), (3, FAR_APART_GAINS)):
        views = {} if number == 3 else {"views": number}
        for (name, rate), gain in measured.items():
            check = Check("test psnr", {"regularizer": f"dropout({rate})"} | views, views)
            found = differences(check, FOLDERS.get(name, name), store)
            assert gain == pytest.approx(np.mean(found), abs=0.051)


def test_no_scene_is_left_out_of_what_is_said_of_dropout():
    """Above all none where it loses: every scene with three pairs of plain and dropout 0.2."""
    store = RowStore(ROOT / "benchmarks" / "data" / "paper")
    check = Check("test psnr", {"regularizer": "dropout(0.2)"}, {})
    scenes = {path.stem for path in (ROOT / "benchmarks" / "data" / "paper").glob("*.json")}
    measured = {scene for scene in scenes if len(differences(check, scene, store)) >= 3}
    said = {FOLDERS.get(name, name) for name, rate in (*DROPOUT_GAINS[3], *FAR_APART_GAINS) if rate == 0.2}
    assert said == measured, "plan_rules.py, DROPOUT_GAINS[3] or FAR_APART_GAINS"


def test_what_the_recommended_setting_gained_is_what_was_measured():
    """Today's recipe from today's start, the ranges of the rule with one exposure and without."""
    rows = json.loads((ROOT / "benchmarks" / "data" / "setting.json").read_text("utf-8"))
    alone, started = (
        {scene: [after - before for before, after in of] for scene, of in pairs_of(rows, titles, from_today).items()}
        for titles in (BY_SMOOTH, BY_TODAYS)
    )
    found = {scene: [*gains, *alone[scene]] for scene, gains in started.items()}
    said = {FOLDERS.get(name, name): ends for name, ends in (SPARSE_GAINS | SPARSE_GAINS_FAR_APART).items()}
    assert said == {scene: pytest.approx((min(gains), max(gains)), abs=0.051) for scene, gains in found.items()}
    every = [gain for gains in started.values() for gain in gains]
    for page_of in ("README.md", "docs/settings.md"):
        text = " ".join((ROOT / page_of).read_text("utf-8").split())
        figures = re.search(
            r"gained (\d\.\d) dB .*?in the mean of (\d+) pairs of nine scenes, and lost (\d\.\d+) dB", text
        )
        assert figures, page_of
        mean, count, worst = map(float, figures.groups())
        assert (count, len(started)) == (len(every), 9)
        assert mean == pytest.approx(np.mean(every), abs=0.051)
        assert -worst == pytest.approx(min(every), abs=0.0051)


def test_what_two_models_gained_is_what_was_measured():
    """The figures in docs/settings.md, and of one model in the same pairs, which are those of its first three seeds."""
    rows = json.loads((ROOT / "benchmarks" / "data" / "setting.json").read_text("utf-8"))
    two, one = (
        [after - before for of in pairs_of(rows, titles, from_today).values() for before, after in of[:3]]
        for titles in (TWO_BY_TODAYS, BY_TODAYS)
    )
    text = " ".join((ROOT / "docs" / "settings.md").read_text("utf-8").split())
    said = re.search(
        r"gained (\d\.\d\d) dB over plain trainings in (\d+) pairs \(one training (\d\.\d\d)\), at least (\d\.\d)", text
    )
    mean, count, single, least = map(float, said.groups())
    assert (len(two), len(one)) == (count, count)
    assert [mean, single] == pytest.approx([np.mean(two), np.mean(one)], abs=0.0051)
    assert least == pytest.approx(min(two), abs=0.051)


def test_what_opacity_decay_gained_is_what_was_measured():
    """The figures in docs/settings.md against the kept records of the search."""
    records = json.loads((ROOT / "benchmarks" / "data" / "remedy_default.json").read_text("utf-8"))["records"]
    found = {(each["scene"], each["seed"], "opacity_decay=0.995" in each["arm"]): each["psnr"] for each in records}
    text = (ROOT / "docs" / "settings.md").read_text("utf-8")
    for scene in ("fern", "herz-jesu", "lego"):
        gains = [found[scene, seed, True] - found[scene, seed, False] for seed in range(3)]
        error = np.std(gains, ddof=1) / 3**0.5
        shown = re.search(rf"{scene} \+(\d\.\d+) ± (\d\.\d+)", text)
        assert [float(x) for x in shown.groups()] == pytest.approx([np.mean(gains), error], abs=0.0051)
