"""Tables of trainings: what is kept says all, and the pages show what is kept."""

import json

import pytest
from pages import ROOT

from benchmarks.trained import keep, table, write
from reference_trainer.training.config import TrainConfig


def a_run(folder, psnr, **settings):
    folder.mkdir(parents=True)
    test = {"psnr": psnr, "ssim": 0.5, "ca": 2e-3, "ca_exact_half": 4e-3}
    found = {"scene": "fern", "config": vars(TrainConfig(iterations=100, **settings)), "mean": {"test": test},
             "gaussians": 31_000, "processor_seconds": 50.0, "machine": {"cpu": "one"}}  # fmt: skip
    (folder / "results.json").write_text(json.dumps(found))
    return folder


def test_rows_are_settings_with_all_their_seeds(tmp_path):
    runs = [a_run(tmp_path / f"a{s}", 20.0 + s, seed=s) for s in (0, 2)]
    runs += [a_run(tmp_path / "b", 23.0, dropout=0.2, regularizer="depth")]
    runs += [a_run(tmp_path / "c", 24.0, dropout=0.2, opacity_decay=0.999)]
    kept = keep(runs)
    assert list(kept["rows"]) == ["none", "dropout(0.2) + depth", "dropout(0.2), opacity_decay=0.999"]
    assert [run["seed"] for run in kept["rows"]["none"]] == [0, 2]
    assert kept["settings"] == {"iterations": 100}
    lines = table(kept).splitlines()
    assert lines[2] == "| none | 2 | 21.0 ± 1.4 | 0.5 ± 0 | 2 ± 0 | 4 ± 0 | 31 ± 0 | 50 ± 0 |"
    assert lines[3].startswith("| `dropout(0.2) + depth` | 1 | 23 |")


def test_a_group_has_settings_of_its_own_and_depth_is_shown_where_all_know_it(tmp_path):
    runs = [a_run(tmp_path / group / "plain" / "seed_0", 20.0, densify_gradient=rate)
            for group, rate in (("fsgs", 5e-4), ("absgs", 1e-3))]  # fmt: skip
    runs += [a_run(tmp_path / "absgs" / "dropout" / "seed_0", 21.0, densify_gradient=1e-3, dropout=0.2)]
    kept = keep(runs, grouped=True)
    assert list(kept["rows"]) == ["fsgs, none", "absgs, none", "absgs, dropout(0.2)"]
    assert kept["settings"]["absgs"]["densify_gradient"] == 1e-3
    assert "AbsRel" not in table(kept)
    for of in kept["rows"].values():
        of[0]["depth_abs_rel"] = 0.5
    assert "| depth AbsRel |" in table(kept)


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_the_pages_show_what_is_kept(page):
    assert write(page, ROOT / "docs" / "data") == page.read_text("utf-8")
