"""All cases end as they should; and the report of a study that is made up."""

import math

import pytest
import torch
from PIL import Image

from reference_trainer.render import renderer
from reference_trainer.studies.stability import stability_study as module
from reference_trainer.studies.stability.cases import Case, Probe, all_cases, decades, single
from reference_trainer.studies.stability.quantities import base_scene, splats_of
from reference_trainer.studies.stability.stability_study import judge, judge_with, stability_study, study_stability

SLOW = {"Gaussians on one pixel", "renders K", "4096", "beyond any scene", "HDR", "(torch)"}


def marked(name):
    marks = [pytest.mark.slow] if any(part in name for part in SLOW) else []
    return pytest.param(name, marks=marks)


@pytest.mark.parametrize("name", [marked(name) for name in stability_study().cases])
def test_every_case_ends_as_it_should(name):
    record = judge_with(**stability_study().cases[name])
    assert name.startswith(f"{record['family']}: {record['name']}")
    assert record["ending"] != "defect", (record["onset"], record["points"])


@pytest.fixture
def made_up(monkeypatch):
    """A study of other cases."""

    def use(*cases):
        monkeypatch.setattr(module, "all_cases", lambda: cases)

    return use


def test_what_renders_is_judged_with_every_engine_against_one_reference(made_up):
    rendered, references = [], []

    def measured():
        rendered.append(splats_of(base_scene(3).to(torch.float32)).engine.name)
        return {"image": torch.ones(2)}

    def reference():
        references.append(1)
        return {"image": torch.ones(2).double()}

    made_up(Case("f", "n", lambda magnitude: Probe(measured, reference)), Case("f", "m", grows, renders=False))
    records = [judge_with(**settings) for settings in stability_study().cases.values()]
    assert [record["engine"] for record in records] == [*rendered, None] == ["numba", "torch", None]
    assert len(references) == 1


def test_cases_that_say_that_they_render_nothing_render_nothing(monkeypatch):
    quick = [case for case in all_cases() if not case.renders and not any(part in case.name for part in SLOW)]
    assert len(quick) >= 3
    monkeypatch.setattr(renderer, "engine_for", lambda device, dtype: pytest.fail(f"rendered {dtype}"))
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
    single("second", "refuses", refuses, refused="itself", renders=False),
    single("second", "is right", lambda: grows(1.0), renders=False),
]


def test_numbers_tables_and_picture(made_up, tmp_path, said):
    made_up(*MADE_UP)
    records = study_stability(tmp_path)
    assert [(case["engine"], case["ending"]) for case in records.values()] == [
        ("numba", "limit"), ("torch", "limit"), (None, "refused"), (None, "ok")
    ]  # fmt: skip
    text = (tmp_path / "stability.md").read_text()
    assert text in said
    assert "22 magnitudes" in text  # 2 (5 + 5) + 2
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines()]
    for engine in ("numba", "torch"):
        assert [engine, "3", "1", "1", "1", "0"] in rows
        assert ["grows", engine, "1e+03", "1e-03", "0"] in rows
    assert ["is right", "", "one", "1e-06", "0"] in rows
    assert ["second: refuses", "", "refused", "always", "refused", r"ValueError: no \| more"] in rows
    ending = next(row for row in rows if row[:3] == ["first: grows", "torch", "limit"])
    assert ending[4:] == ["inexact: image", "by design"]
    with Image.open(tmp_path / "stability.png") as picture:
        assert len(picture.convert("L").getcolors(1 << 20)) > 20


def test_a_defect_fails_after_everything_is_written(made_up, tmp_path):
    nan = Probe(lambda: {"image": torch.tensor([math.nan])}, lambda: {"image": torch.ones(1).double()})
    made_up(*MADE_UP, single("third", "gives nan", lambda: nan, renders=False))
    with pytest.raises(RuntimeError, match=r"^1 cases .*:\n  third: gives nan"):
        study_stability(tmp_path)
    assert {path.name[10:] for path in tmp_path.glob("stability.*")} == {"json", "md", "png"}
