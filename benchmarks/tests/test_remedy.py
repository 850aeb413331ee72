"""The paired study: views that choose are no test views, differences are of the same seed, and what is kept."""

import json
from pathlib import Path

import pytest
import torch
from heard import hearing

from benchmarks import remedy
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.studies.study import run_study


def test_held_out_views_of_the_built_in_scene_are_none_of_its_test_views(monkeypatch):
    monkeypatch.setattr(remedy, "synthetic_scene", lambda **given: synthetic_scene(20, 15, **given))
    options = SceneOptions(downscale=8)
    scene, plain = remedy.held_out(options, 1), load_scene(options, seed=1)
    assert [view.name for view in scene.train] == [view.name for view in plain.train]
    places = [torch.stack([view.camera.position for view in each.test]) for each in (scene, plain)]
    assert torch.cdist(*places).min() > 0.1
    assert len(scene.test) == 4


def test_settings_are_chosen_on_the_choosing_scenes_alone():
    arms = ["dropout=0.2", "dropout=0.3"]
    with pytest.raises(ValueError, match=r"choose .*synthetic, fern, lego"):
        remedy.remedy_study("choose", arms, scenes=["fern", "fountain"], seeds=1)
    with pytest.raises(ValueError, match="one more arm"):
        remedy.remedy_study("choose", arms[:1], scenes=["fern"], seeds=1)
    cases = remedy.remedy_study("final", arms, scenes=["fern", "fountain"], seeds=2, data="data").cases
    assert len(cases) == 8
    assert cases["fountain, seed 1: dropout=0.3"]["options"]["path"] == "data/fountain"


def test_differences_are_paired_by_seed():
    """Gains of 1 and 2 dB although the seeds are 10 dB apart; the third seed has no reference."""
    rows = [("a", 0, 20.0), ("b", 0, 21.0), ("a", 1, 30.0), ("b", 1, 32.0), ("b", 2, 50.0)]
    records = {
        f"{arm} {seed}": {"scene": "s", "arm": arm, "seed": seed, "psnr": psnr, "ca_exact": 1e-3, "gaussians": 1000,
                          "processor_seconds": 10.0 if arm == "a" else 15.0}
        for arm, seed, psnr in rows
    }  # fmt: skip
    study = remedy.remedy_study("choose", ["dropout=0.2", "dropout=0.3"], scenes=["fern"], seeds=1)
    line = next(line for line in study.report(records).splitlines() if line.startswith("| `b`"))
    assert "| +1.000, +2.000 | +1.500 ± 0.500 | 1.50 |" in line


def test_what_is_trained_alike_differs_by_nothing_and_is_kept(tmp_path, monkeypatch):
    monkeypatch.setitem(remedy.SCENES, "synthetic", SceneOptions(downscale=8))
    monkeypatch.setattr(remedy, "synthetic_scene", lambda **given: synthetic_scene(20, 15, **given))
    arms = ["iterations=3; dropout=0.2", "iterations=3; dropout=0.2; noise=0.0", "iterations=3"]
    study = remedy.remedy_study("choose", arms, scenes=["synthetic"], seeds=1)
    records = run_study(study, tmp_path)
    quality = [record["psnr"] for record in records.values()]
    assert quality[0] == quality[1] != quality[2]
    with hearing() as messages:
        assert run_study(study, tmp_path) == records
    assert not any(line.startswith("[") for line in messages)


def test_the_overview_has_means_of_pairs_and_says_where_a_scene_lacks():
    rows = [("a", "s", 0, 20.0), ("b", "s", 0, 21.0), ("a", "t", 0, 30.0), ("a", "t", 1, 32.0), ("b", "t", 0, 32.0),
            ("b", "t", 1, 33.0), ("c", "s", 0, 29.0)]  # fmt: skip
    records = [
        {"scene": scene, "arm": arm, "seed": seed, "psnr": psnr, "ca_exact": 1e-3 if arm == "a" else 5e-4,
         "gaussians": 1000, "processor_seconds": 10.0} for arm, scene, seed, psnr in rows
    ]  # fmt: skip
    _, _, *lines = remedy.overview(records).splitlines()
    assert lines == [
        "| `b` | +1.000 (1) | +1.500 ± 0.500 (2) | +1.250 | 0.50 | 1.00 | 1.00 |",
        "| `c` | +9.000 (1) | - | - | 0.50 | 1.00 | 1.00 |",
    ]
    assert "| `a` | -1.000 (1) | -1.500 ± 0.500 (2) | -1.250 | 2.00 | 1.00 | 1.00 |" in remedy.overview(records, "b")


@pytest.mark.parametrize(
    ("file", "reference"),
    [
        ("remedy", ""),
        ("remedy_final", ""),
        ("remedy_final", "dropout=0.2; opacity_decay=0.995; iterations=2100"),
        ("remedy_final", "dropout=0.2; opacity_decay=0.995"),
        ("remedy_default", "dropout=0.2; iterations=3000; opacity_reset_every=3000"),
    ],
)
def test_the_page_shows_the_tables_of_the_data(file, reference):
    here = Path(__file__).parents[1]
    table = remedy.overview(json.loads((here / "data" / f"{file}.json").read_text("utf-8"))["records"], reference)
    assert table in (here / "remedy.md").read_text("utf-8")
