"""All cases end as they should; and the report of a study that is made up."""

import json
import math

import pytest
import torch
from PIL import Image

from reference_trainer.render import renderer
from reference_trainer.studies.engines import engines_on
from reference_trainer.studies.stability.case import Case, Probe, decades, single
from reference_trainer.studies.stability.judge import judge
from reference_trainer.studies.stability.quantities import splats_of
from reference_trainer.studies.stability.scenes import base_scene
from reference_trainer.studies.stability.study import all_cases, judged, study_stability

SLOW = {"60 digits", "Gaussians on one pixel", "renders K", "4096", "beyond any scene", "HDR"}


def marked(case):
    marks = [pytest.mark.slow] if any(name in case.name for name in SLOW) else []
    return pytest.param(case, marks=marks, id=f"{case.family}: {case.name}")


@pytest.mark.parametrize("case", [marked(case) for case in all_cases()])
def test_every_case_ends_as_it_should(case):
    for record in judged(case, engines_on(torch.device("cpu"))):
        assert record["ending"] != "defect", (record["engine"], record["onset"], record["failure"])


def test_what_draws_is_judged_with_every_engine_against_one_reference():
    drawn, references = [], []

    def measured():
        drawn.append(splats_of(base_scene(3).to(torch.float32)).engine.name)
        return {"image": torch.ones(2)}

    def reference():
        references.append(1)
        return {"image": torch.ones(2).double()}

    case = Case("f", "n", lambda magnitude: Probe(measured, reference))
    assert [x["engine"] for x in judged(case, ("loops", "torch"))] == drawn == ["loops", "torch"]
    assert len(references) == 1
    assert [x["engine"] for x in judged(Case("f", "n", grows, draws=False), ("loops", "torch"))] == [None]


def test_cases_that_say_that_they_draw_nothing_draw_nothing(monkeypatch):
    quick = [case for case in all_cases() if not case.draws and not any(name in case.name for name in SLOW)]
    assert len(quick) > 30
    monkeypatch.setattr(renderer, "engine_for", lambda like: pytest.fail(f"drew {like.dtype}"))
    for case in quick:
        judge(case)


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
    single("second", "refuses", refuses, refused="itself", draws=False),
    single("second", "is right", lambda: grows(1.0), draws=False),
]


def test_numbers_tables_and_picture(tmp_path):
    said = []
    report = study_stability(tmp_path, cases=MADE_UP, say=said.append)
    assert json.loads((tmp_path / "stability.json").read_text()) == report
    text = (tmp_path / "stability.md").read_text()
    assert text in said
    assert said[:2] == ["first", "second"]
    assert [(case["engine"], case["ending"]) for case in report["cases"]] == [
        ("loops", "limit"), ("torch", "limit"), (None, "refused"), (None, "ok")
    ]  # fmt: skip
    assert report["points"] == 2 * (5 + 5) + 2
    assert "22 magnitudes" in text
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines()]
    for engine in ("loops", "torch"):
        assert [engine, "3", "1", "1", "1", "0"] in rows
        assert ["grows", engine, "1e+03", "1e-03", "0"] in rows
    assert ["is right", "", "one", "1e-06", "0"] in rows
    assert ["second: refuses", "", "refused", "always", "refused", r"ValueError: no \| more"] in rows
    ending = next(row for row in rows if row[:3] == ["first: grows", "torch", "limit"])
    assert ending[4:] == ["inexact: image", "by design"]
    with Image.open(tmp_path / "stability.png") as picture:
        assert len(picture.convert("L").getcolors(1 << 20)) > 20


def test_a_defect_fails_after_everything_is_written(tmp_path):
    nan = Probe(lambda: {"image": torch.tensor([math.nan])}, lambda: {"image": torch.ones(1).double()})
    cases = [*MADE_UP, single("third", "gives nan", lambda: nan, draws=False)]
    with pytest.raises(RuntimeError, match="1 cases do not end as they should:\n  third: gives nan"):
        study_stability(tmp_path, cases=cases, say=lambda text: None)
    last = json.loads((tmp_path / "stability.json").read_text())["cases"][-1]
    assert (last["ending"], last["points"][0]["errors"]) == ("defect", {"image": None})
    assert (tmp_path / "stability.md").exists()
    assert (tmp_path / "stability.png").exists()


def test_no_case_is_no_study(tmp_path):
    with pytest.raises(ValueError, match="at least 1 case"):
        study_stability(tmp_path, cases=[])
