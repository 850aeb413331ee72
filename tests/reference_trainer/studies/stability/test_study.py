"""All cases end as they should; and the report of a study that is made up."""

import json
import math

import pytest
import torch
from PIL import Image

from reference_trainer.studies.stability.case import Case, Probe, decades, single
from reference_trainer.studies.stability.judge import judge
from reference_trainer.studies.stability.study import all_cases, study_stability

SLOW = {"60 digits", "Gaussians on one pixel", "renders K", "4096", "beyond any scene", "HDR"}


def marked(case):
    marks = [pytest.mark.slow] if any(name in case.name for name in SLOW) else []
    return pytest.param(case, marks=marks, id=f"{case.family}: {case.name}")


@pytest.mark.parametrize("case", [marked(case) for case in all_cases()])
def test_every_case_ends_as_it_should(case):
    verdict = judge(case)
    assert verdict.ending != "defect", (verdict.onset, verdict.failure)


def test_names_are_different_and_magnitudes_increase():
    cases = all_cases()
    assert len({(case.family, case.name) for case in cases}) == len(cases)
    for case in cases:
        assert list(case.magnitudes) == sorted(set(case.magnitudes))
        assert case.magnitudes[0] > 0


def grows(x):
    one = torch.ones(3, dtype=torch.float64)
    return Probe(lambda: {"image": one * (1 + 1e-6 * x), "CA": one}, lambda: {"image": one, "CA": one})


def refuses():
    def measured():
        raise ValueError("no | more\nthan this")

    return Probe(measured, dict)


MADE_UP = [
    Case("first", "grows", grows, decades(0, 4), until=100.0, note="by design"),
    single("second", "refuses", refuses, refused="itself"),
    single("second", "is right", lambda: grows(1.0)),
]


def test_numbers_tables_and_picture(tmp_path):
    said = []
    report = study_stability(tmp_path, cases=MADE_UP, say=said.append)
    assert json.loads((tmp_path / "stability.json").read_text()) == report
    text = (tmp_path / "stability.md").read_text()
    assert text in said
    assert said[:2] == ["first", "second"]
    assert [case["ending"] for case in report["cases"]] == ["limit", "refused", "ok"]
    assert report["points"] == 5 + 5 + 2
    assert "3 cases at 12 magnitudes" in text
    assert "ok: 1, refused: 1, limit: 1, defect: 0" in text
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines()]
    assert ["grows", "1e+03", "1e-03", "0"] in rows
    assert ["is right", "one", "1e-06", "0"] in rows
    assert ["second: refuses", "refused", "always", "refused", r"ValueError: no \| more"] in rows
    assert any(row[:2] == ["first: grows", "limit"] and row[3:] == ["inexact: image", "by design"] for row in rows)
    with Image.open(tmp_path / "stability.png") as picture:
        assert len(picture.convert("L").getcolors(1 << 20)) > 20


def test_a_defect_fails_after_everything_is_written(tmp_path):
    nan = Probe(lambda: {"image": torch.tensor([math.nan])}, lambda: {"image": torch.ones(1).double()})
    with pytest.raises(RuntimeError, match="1 cases do not end as they should:\n  third: gives nan"):
        study_stability(tmp_path, cases=[*MADE_UP, single("third", "gives nan", lambda: nan)], say=lambda text: None)
    last = json.loads((tmp_path / "stability.json").read_text())["cases"][-1]
    assert (last["ending"], last["points"][0]["errors"]) == ("defect", {"image": None})
    assert (tmp_path / "stability.md").exists()
    assert (tmp_path / "stability.png").exists()


def test_no_case_is_no_study(tmp_path):
    with pytest.raises(ValueError, match="at least 1 case"):
        study_stability(tmp_path, cases=[])
