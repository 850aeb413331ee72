import math
import re

import pytest

from reference_trainer.report.verdict import (
    Rows,
    differences,
    natural_name,
    natural_order,
    run_colors,
    score_columns,
    unique_names,
    verdict,
)
from reference_trainer.training.config import TrainConfig


def rows(name: str, psnr: list[float], ca: list[float], *, split: str = "test", baseline: bool = False) -> Rows:
    """The rows of a strategy, one per seed, with two views."""
    views = [{"split": split, "name": str(i)} for i in range(2)]
    means = [{split: {"psnr": x, "ca_exact_half": y}} for x, y in zip(psnr, ca, strict=True)]
    return Rows(name, baseline, [{"mean": mean, "views": views, "gaussians": 5, "seconds": 1.0} for mean in means])


def test_runs_are_called_and_ordered_as_people_do():
    configs = [
        TrainConfig(),
        TrainConfig(dropout=0.2),
        TrainConfig(dropout=0.2, analytic=True),
        TrainConfig(noise=0.8),
        TrainConfig(dropout=0.2, noise=0.8),
        TrainConfig(regularizer="d2gs"),
        TrainConfig(density="absgrad"),
    ]
    names = ["Baseline", "Dropout 0.2", "Analytic dropout 0.2", "Noise 0.8", "Dropout 0.2 + noise 0.8", "D2gs"]
    assert [natural_name(config) for config in configs] == [*names, "Baseline, absgrad"]
    assert sorted(reversed(configs[:-1]), key=natural_order) == configs[:-1]
    assert natural_order(configs[-1]) > natural_order(configs[4])
    assert natural_order(TrainConfig(regularizer="density + noise(0.8)")) > natural_order(configs[4])  # no noise alone
    assert natural_order(TrainConfig(regularizer="noise + dropout(0.2)")) == natural_order(configs[4])
    ramp = TrainConfig(regularizer="dropout(ramp(0.0, 0.2, 0, 10_000))")
    assert natural_order(ramp) == natural_order(configs[1])
    assert run_colors([ramp]) == run_colors(configs[1:2])


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ([{"seed": 1}, {"seed": 2}], ["Baseline (0)", "Baseline (1)"]),
        ([{}, {}], ["Baseline (0)", "Baseline (1)"]),
        ([{}, {"dropout": 0.5}], ["Baseline", "Dropout 0.5"]),
    ],
)
def test_no_two_runs_share_a_name(changes, names):
    assert unique_names([TrainConfig(**change) for change in changes], ["0", "1"]) == names


def test_one_seed_is_said_to_have_no_spread():
    found, evidence = verdict([rows("Baseline", [20.0], [0.004], baseline=True), rows("Mine", [20.55], [0.001])])
    assert found.startswith("Mine: 0.55 dB higher PSNR")
    assert "75 % less co-adaptation than the baseline" in found
    assert "2 test views" in found
    (rule,) = evidence
    assert "no spread" in rule


@pytest.mark.parametrize("ca", [0.004, 0.0])
def test_equal_scores_are_called_the_same(ca):
    found, _ = verdict([rows("A", [20.0], [ca]), rows("B", [20.0], [ca])])
    assert re.match("B: .*same PSNR .*same co-adaptation as A", found)
    mixed, _ = verdict([rows("A", [20.0], [ca]), rows("B", [20.1], [ca])])
    assert re.match(r"B: 0\.10 dB higher .*same co-adaptation", mixed)


def test_what_is_within_two_standard_errors_is_not_told_apart():
    # The difference of the means is 1 and its standard error sqrt(s^2 / 2 + s^2 / 2) = s; s is half the range times
    # the square root of 2.
    for half, apart in ((0.3, True), (0.4, False)):
        psnr = [[middle - half, middle + half] for middle in (20.0, 21.0)]
        assert (2 * half * math.sqrt(2) < 1) == apart
        found, evidence = verdict([rows("A", psnr[0], [0.004] * 2), rows("B", psnr[1], [0.001] * 2)])
        assert ("1.00 dB higher PSNR" in found) == apart
        assert ("(1.00 dB higher)" in found) != apart
        assert "75 % less co-adaptation than A" in found
        assert evidence[0].startswith("2 seeds")


def test_every_strategy_is_in_the_verdict_or_its_evidence():
    strategies = [rows("Baseline", [20], [0.004], baseline=True), rows("A", [19], [0.003]), rows("B", [21], [0.005])]
    found, evidence = verdict(strategies, ["iterations"])
    assert re.match(r"B \(.*highest PSNR of 2\): 1\.00 dB higher .*25 % more .*baseline", found)
    assert re.match(r"A: 1\.00 dB lower .*25 % less", evidence[0])
    assert "differ in iterations too" in evidence[-1]


def test_without_test_views_nothing_is_said_about_quality():
    pair = [rows(name, [30.0], [ca], split="around") for name, ca in (("A", 0.004), ("B", 0.002))]
    found, evidence = verdict(pair)
    assert re.match("B: 50 % less .*A around", found)
    assert "quality" in evidence[-1]
    nothing, none = verdict([])
    assert nothing.startswith("No verdict")
    assert none == []
    assert "exact CA 4.00e-3" in verdict(pair[:1])[0]


def test_scores_on_different_test_views_are_said_to_be():
    one, two = rows("A", [20.0], [0.004]), rows("B", [21.0], [0.004])
    two.results[0]["views"].append({"split": "test", "name": "another"})
    found, evidence = verdict([one, two])
    assert re.match(r"B: 1\.00 dB higher .*own test views", found)
    assert "not tested on the same" in evidence[-1]
    one, two = (rows(name, [30.0], [0.004], split="around") for name in "AB")
    for each, name in ((one, "0001"), (two, "0002")):  # views around them have the same numbers
        each.results[0]["views"].append({"split": "train", "name": name})
    assert "not trained on" in verdict([one, two])[1][-1]


def test_what_has_no_score_is_not_the_best():
    strategies = [rows(name, [30.0], [ca], split="around") for name, ca in (("A", 4e-3), ("B", math.nan), ("C", 2e-3))]
    found, evidence = verdict(strategies)
    assert re.match(r"C \(.*least co-adaptation of 2\): 50 % less .*A", found)
    assert evidence[0].startswith("B: no score")
    assert re.match("C: no score .*B around", verdict(strategies[1:])[0])


def test_the_best_and_the_better_are_marked_where_that_is_a_merit():
    columns = score_columns([rows("A", [20.0], [0.004]), rows("B", [20.5], [0.005]), rows("C", [20.5], [math.nan])])
    psnr, ca, gaussians, _ = columns
    assert [cell["best"] for cell in psnr["cells"]] == [False, True, True]
    assert [cell["best"] for cell in ca["cells"]] == [True, False, False]
    assert (psnr["cells"][1]["delta"], psnr["cells"][1]["better"]) == ("+0.50", True)
    assert (ca["cells"][1]["delta"], ca["cells"][1]["better"]) == ("+1.00", False)
    assert ca["cells"][2] == {"text": "n/a", "best": False}
    assert not any(cell["best"] or "delta" in cell for cell in gaussians["cells"])


def test_what_an_older_version_did_not_measure_has_no_interval():
    old, new = rows("Old", [20.0], [0.004]), rows("New", [20.0], [0.004])
    new.results[0]["mean"]["test"] |= {"psnr_expected": 19.0, "psnr_low": 17.5, "psnr_high": 20.5}
    (cells,) = (of["cells"] for of in score_columns([old, new]) if of["title"] == "expected PSNR (dB)")
    assert cells[0] == {"text": "n/a", "best": False}
    assert (cells[1]["text"], cells[1]["interval"]) == ("19.0", "17.5 to 20.5")


def test_two_trainings_are_told_apart_by_three_seeds_and_not_by_fewer():
    one = rows("One", [20.0, 20.1, 20.2], [0.005, 0.0049, 0.0051])
    two = rows("Two", [20.5, 20.7, 20.6], [0.0051, 0.005, 0.0049])
    psnr, ca, *_ = differences(one, two)
    error = 2 * math.sqrt(2 * 0.1**2 / 3)
    assert psnr["score"] == "test PSNR (dB)"
    assert psnr["difference"] == f"+0.50 ± {error:.2f}"
    assert (psnr["told apart"], ca["told apart"]) == ("yes, better", "no")
    assert (psnr["One"], psnr["Two"]) == ("20.10 ± 0.10", "20.60 ± 0.10")
    assert differences(two, one)[0]["told apart"] == "yes, worse"

    single = Rows("Two", False, two.results[:2])
    assert {row["told apart"] for row in differences(one, single)} == {"unknown"}
    assert "±" not in differences(one, single)[0]["difference"]
    assert [row["score"] for row in differences(one, rows("B", [1.0] * 3, [1.0] * 3, split="train"))] == [
        "Gaussians",
        "seconds",
    ]
