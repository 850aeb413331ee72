"""Candidates by held-out views, the chosen one against plain 3DGS and dropout: from rows made by hand."""

from __future__ import annotations

import json
import re
from functools import partial

from pages import lines_missing

from benchmarks import setting
from reference_trainer.evaluation.results import write_json
from reference_trainer.runs.distill import distilled
from reference_trainer.runs.folder import run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.recipes import with_recipe

former = partial(with_recipe, random_background="off", loss="photometric")
"""A recipe as it was up to the twentieth choice."""


def row(scene, candidate, seed, psnr, held_out=None):
    test = {"psnr": psnr, "ssim": 0.8, "lpips": 0.1, "ca_exact_half": 1e-3}
    found = {"scene": scene, "candidate": candidate, "seed": seed, "test": test, "gaussians": 100, "seconds": 60.0}
    return found | ({} if held_out is None else {"held-out": held_out})


def test_the_mean_of_a_candidate_is_over_the_scenes_that_all_have():
    drawn = [row("fern", "drawn", 0, 25.0, 20.0), row("sceaux", "drawn", 0, 20.0, 30.0), row("lego", "drawn", 0, 24.0)]
    other = [row("fern", "expectation", 0, 25.0, 21.0), row("sceaux", "expectation", 0, 20.0, 27.0)]
    rows = [*drawn, row("cape", "drawn", 0, 20.0, 99.0), *other, row("fern", "expectation", 1, 25.0, 90.0)]
    lines = [line for line in setting.choosing(rows).splitlines() if line.startswith("| ")][1:]
    means = {cells[1].strip(): cells[-2].strip() for line in lines if (cells := line.split("|"))}
    assert means == {"drawn": "25.00", "expectation": "24.00"}


def test_a_pair_is_of_one_scene_and_seed(tmp_path):
    def kept(options, psnr):
        own = {"recipe": "3dgs", "iterations": 3_000, **options}
        return [
            {"setting": own, "seed": seed, "test": {"psnr": psnr + seed, "lpips": 0.1}, "gaussians": 200}
            for seed in (0, 1)
        ]

    rows = kept({}, 20.0) + kept({"regularizer": "dropout(0.2)"}, 21.0)
    (tmp_path / "fern.json").write_text(json.dumps({"scene": "fern", "rows": rows}))
    own = [row("fern", "drawn", 0, 22.5), row("fern", "drawn", 1, 20.7), row("fern", "expectation", 0, 10.0)]
    text = setting.judging(own, tmp_path)
    assert "+2.50, -0.30" in text
    assert "+1.10 dB over 2 pairs of 1 scenes" in text
    assert "worst pair: -0.30 dB" in text
    assert "mean over scenes: 0.50" in text
    later = row("fern", "from 1,000", 0, 23.0) | {"seconds": 45.0, "gaussians": 80}
    text = setting.judging([*own, later], tmp_path, chosen="from 1,000")
    assert "mean over scenes: PSNR +0.50 dB" in text
    assert "processor time 0.75, Gaussians 0.80" in text


def test_binocular_is_met_by_seeds_that_all_have(tmp_path):
    other = "Binocular3DGS, dropout"
    rows = [row("fern", name, seed, 25.0 + seed) for name in ("drawn", "from 1,000") for seed in (0, 1, 2)]
    rows += [row("fern", other, 0, 24.0), row("fern", other, 1, 25.0), row("cape", other, 0, 21.0)]
    rows += [row("sceaux", "drawn", 2, 20.0), row("sceaux", "from 1,000", 2, 21.0), row("sceaux", other, 2, 20.5)]
    text = setting.binocular(rows, tmp_path)
    assert "cape" not in text
    assert re.search(r"drawn: .*1 of 2 scenes, .*\+0\.25 dB", text)
    assert re.search(r"from 1,000: .*2 of 2 scenes, .*\+0\.75 dB", text)


def test_other_points_stand_apart():
    rows = [row("fern, random points", "drawn", 0, 18.5, 18.0), row("fern, random points", "from 1,000", 0, 18.0, 17.5)]
    rows += [row("fern", "drawn", 0, 25.0, 23.0), row("cape, random points", "drawn", 0, 15.0, 13.0)]
    assert [line for line in setting.starts(rows).splitlines() if line.startswith("| random")] == [
        "| random points | fern | 18.00 / 18.50 | 17.50 / 18.00 | -0.50 / -0.50 |"
    ]
    assert "18.00" not in setting.choosing(rows)


def test_a_control_is_what_the_later_beginning_gains_alone(tmp_path):
    figures = {"plain": 20.0, "dropout": 21.0, "drawn": 22.0}
    rows = [row("fern", name, 0, psnr) for name, psnr in figures.items()]
    rows += [row("fern", f"{name}, from 1,000", 0, figures[name] + 0.5) for name in ("plain", "dropout")]
    assert setting.controls(rows, tmp_path) == "No control was trained."
    (line,) = [
        x for x in setting.controls([*rows, row("fern", "from 1,000", 0, 23.0)], tmp_path).splitlines() if "fern" in x
    ]
    assert [x.strip() for x in line.split("|")[2:-1]] == [
        "20.00", "20.50 (+0.50)", "21.00", "21.50 (+0.50)", "22.00", "23.00 (+1.00)",
    ]  # fmt: skip


def test_the_page_has_the_tables_of_its_rows():
    rows = json.loads((setting.REFERENCES.parent / "setting.json").read_text("utf-8"))
    assert lines_missing("\n".join(setting.tables(rows)), "choices.md") == []


def test_the_recipe_is_what_was_chosen():
    for iterations in (2_000, 3_000):
        config = with_recipe("sparse", iterations=iterations)
        assert setting.candidate(config) == setting.TODAY
        assert setting.candidate(config, SceneOptions("data/lego")) == f"{setting.LATER} + smooth 0.1"
    first = former("sparse", iterations=2_000, densify_from=100)
    assert setting.candidate(first) == setting.CHOSEN
    assert setting.candidate(with_recipe("3dgs", iterations=3_000)) == "plain"
    assert setting.candidate(with_recipe("3dgs", iterations=3_000, densify_from=1_000)) == "plain, from 1,000"


def test_a_candidate_of_the_second_choice_gains_over_the_mean_of_the_seeds():
    rows = [row("fern", "drawn", seed, 25.0, held_out) for seed, held_out in enumerate((20.0, 21.0, 22.0))]
    rows += [row("fern", "flat", 0, 25.0, 21.5), row("cape", "drawn", 0, 20.0, 14.0), row("cape", "flat", 0, 1.0, 13.0)]
    (line,) = [x for x in setting.second(rows).splitlines() if x.startswith("| flat")]
    assert [x.strip() for x in line.split("|")[2:-1]] == ["+0.50", "-1.00", "-0.25", "2"]
    assert "flat" not in setting.second(rows, (0, 1))  # no seed 1


def test_a_rate_of_the_means_by_pixels_is_another_on_every_scene():
    names = [setting.candidate(former("sparse", iterations=3_000, means_rate=rate)) for rate in (6.4e-4, 2.5e-4, 5e-4)]
    assert names == [f"from 1,000 + means {how}" for how in ("x4", "by pixels", "by pixels")]


def test_a_distillation_is_named_by_the_number_of_its_models(tmp_path):
    (run := tmp_path / "run").mkdir()
    scene = SceneOptions("fern", points="dense_and_few.ply")
    write_json(run / "config.json", run_settings(scene, former("sparse")))
    for count, name in enumerate(("distilled, alone", "distilled of two", "distilled of three"), 1):
        members = ", ".join([repr(str(run / "point_cloud.ply"))] * count)
        options, config = distilled([run] * count)
        assert config.loss == f"photometric + distillation({members})"
        assert setting.candidate(config, options) == f"from 1,000 + {name}"
    assert setting.candidate(former("sparse", iterations=6_000)) == "from 1,000 + twice the steps"
    write_json(run / "config.json", run_settings(scene, former("sparse", iterations=1_500)))
    assert setting.candidate(*reversed(distilled([run] * 2))).endswith(" two, half the steps")
    write_json(run / "config.json", run_settings(scene, with_recipe("3dgs", iterations=3_000)))
    assert setting.candidate(*reversed(distilled([run] * 2))) == "plain + distilled of two"
    write_json(run / "config.json", run_settings(scene, with_recipe("sparse")))
    assert setting.candidate(*reversed(distilled([run] * 2))) == f"{setting.TODAY} + distilled of two"


def test_a_distillation_of_two_kinds_is_named_by_the_second(tmp_path):
    for folder, of in (
        ("recipe", former("sparse")),
        ("slow", former("sparse", means_rate=4e-5)),
        ("other", with_recipe("binocular", dropout=0.2, loss="photometric + warp(1.0, relative=True)")),
    ):
        (tmp_path / folder).mkdir()
        write_json(tmp_path / folder / "config.json", run_settings(SceneOptions("fern", points="dense.ply"), of))
    for folder, name in (("slow", "means x1/4"), ("other", "Binocular3DGS, dropout, relative shift")):
        options, config = distilled([tmp_path / "recipe", tmp_path / folder])
        assert setting.candidate(config, options) == f"from 1,000 + distilled with {name}"


def test_a_warp_is_named_by_what_it_leaves_out():
    hidden = "shift=0.15, relative=True, hidden=0.02"
    for loss, name in (
        ("shift=0.36", "warp"),
        (hidden, "warp + hidden left out"),
        (f"{hidden}, every=2", "warp + hidden left out + every second step"),
    ):
        config = former("sparse", iterations=3_000, loss=f"photometric + warp(between(1.0, 2000), {loss})")
        assert setting.candidate(config) == f"from 1,000 + {name}"
