"""The study of the paper's claims: its grid, the rule of its verdicts, what is kept, and a run of seconds."""

import dataclasses
import itertools
import json
import math
import re
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from commands import refused
from oracles import brute_force, random_scene
from pages import ROOT
from stand_ins.engine import Here

from ca_reg.regularizers import REGULARIZERS
from reference_trainer.cli import main
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.runs import grid as grid_module
from reference_trainer.runs.engines.engine import Failure
from reference_trainer.runs.figures import new_figure
from reference_trainer.runs.grid import Running
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.studies.paper import cells as cells_module
from reference_trainer.studies.paper import figure as figure_module
from reference_trainer.studies.paper.cells import Grid, declared, depths, estimate, is_done, renders, rows_of, run_cells
from reference_trainer.studies.paper.claims import CLAIMS, Check, Claim, chosen
from reference_trainer.studies.paper.comparison import Kept, judged
from reference_trainer.studies.paper.figure import gains_figure, ranking_figure
from reference_trainer.studies.paper.page import claims_table, details, gains, page, scenes_table
from reference_trainer.studies.paper.rows import Rows, config_of, resolved, value
from reference_trainer.studies.paper.scenes import SCENES, chosen_scenes
from reference_trainer.studies.paper.verdict import overall, verdict

ALL = Grid(CLAIMS, SCENES)
"""Everything."""


# The grid


def test_every_training_is_declared_once_and_covers_its_claims():
    cells = declared(ALL)
    assert len({json.dumps([cell.scene, cell.setting, cell.seed], sort_keys=True) for cell in cells}) == len(cells)
    assert len({cells_module._folder(ALL, cell) for cell in cells}) == len(cells)
    there = {(cell.scene, json.dumps(cell.setting, sort_keys=True), cell.seed): cell for cell in cells}
    for claim in CLAIMS.values():
        compared = [setting for check in claim.checks for setting in (check.a, check.b)]
        assert all(setting in claim.settings for setting in compared)
        for scene, setting, seed in itertools.product(claim.scenes, claim.settings, range(3)):
            found = resolved(setting, "3dgs", 3_000)
            assert claim.needs <= there[scene, json.dumps(found, sort_keys=True), seed].needs
    seeds = [cell.seed for cell in cells]
    assert seeds == sorted(seeds)  # one seed of everything first
    assert list(CLAIMS)[:17] == [str(number) for number in range(1, 18)]


def test_every_training_is_one_that_the_trainer_takes():
    for cell in declared(Grid(CLAIMS, SCENES, seeds=1)):
        config = config_of(cell.setting, cell.seed)
        config.check()
        assert config.iterations == 3_000
        options = SCENES[cell.scene].options_for(cell.setting, config.loss)
        needs_depth = cell.setting["recipe"] in ("fsgs", "dngaussian")
        assert (options.depth is not None) == needs_depth
        assert options.views == cell.setting.get("views")


def test_the_schemes_are_those_of_the_registry():
    used = {str(setting.get("regularizer", "")).partition("(")[0] for setting in CLAIMS["schemes"].settings}
    assert used - {""} == set(REGULARIZERS)


@pytest.mark.slow
@pytest.mark.data
def test_the_declared_scenes_start_without_their_test_views(data_root):
    widths, views = {}, {}
    for name, scene in chosen_scenes((), data_root, SceneOptions("")).items():
        loaded = scene.options.load()
        widths[name] = loaded.train[0].camera.width
        views[name] = len(loaded.train), len(loaded.test)
        seen = loaded.points.seen_by or frozenset()
        assert not seen & {view.name for view in loaded.test}
        assert (loaded.test[0].mask is not None) == (name == "dtu-scan65")
    few, dtu, near = (3, 3), (3, 25), (3, 2)
    assert list(views.values()) == [few, few, (8, 25), dtu, near, near, dtu]
    assert widths.pop("synthetic") == 160
    assert all(252 <= width <= 400 for width in widths.values())


def test_unknown_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no claim 18; choose of 1, 2"):
        chosen(["1", "18"])
    with pytest.raises(ValueError, match="no declared scene garden; choose of synthetic, fern"):
        chosen_scenes(["garden"], tmp_path, SceneOptions(""))
    with pytest.raises(ValueError, match="declared scenes or --path, not both"):
        chosen_scenes(["fern"], tmp_path, SceneOptions("mine"))


def test_options_that_would_change_nothing_are_refused(capsys):
    assert "options of a scene apply to one of your own" in refused(
        ["study", "paper", "--list", "--images", "images_8"], capsys
    )


def test_one_claim_on_a_scene_of_ones_own(tmp_path, capsys):
    main(["study", "paper", "--claims", "1", "7", "--path", str(tmp_path / "mine"), "--images", "small", "--seeds", "2",
          "--iterations", "1000", "--out", str(tmp_path), "--list"])  # fmt: skip
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "mine, 3dgs, seed 0: 1 min"
    assert lines[1].startswith("mine, 3dgs, dropout(0.2), seed 0: ")
    assert lines[-1].startswith("all: 14 trainings, 14 left: ")


# The rule


@pytest.mark.parametrize(
    ("differences", "low", "high", "expected"),
    [
        ([1.0, 1.1, 0.9], 0, math.inf, "holds"),  # 1 ± 0.12
        ([1.0, 1.1, 0.9], -math.inf, 0, "fails"),
        ([1.0, -0.5, 0.4], 0, math.inf, "undecided"),  # 0.3 ± 0.87
        ([0.02, -0.03, 0.04], -0.1, 0.1, "holds"),  # 0.01 ± 0.042
        ([0.3, 0.31, 0.29], -0.1, 0.1, "fails"),
        ([0.09, 0.12, 0.06], -0.1, 0.1, "undecided"),  # 0.09 ± 0.035
        ([5.0], 0, math.inf, "undecided"),
        ([], 0, math.inf, "undecided"),
        ([0.0, 0.0], 0, math.inf, "fails"),  # what changes nothing helps nothing
    ],
)
def test_the_verdict_of_differences(differences, low, high, expected):
    assert verdict(differences, low, high) == expected


def test_the_verdict_of_checks_and_of_scenes():
    assert overall(["holds", "holds"], needs_all=True) == "holds"
    assert overall(["holds", "undecided"], needs_all=True) == "undecided"
    assert overall(["holds", "undecided", "fails"], needs_all=True) == "fails"
    assert overall(["holds", "holds", "undecided"]) == "holds"
    assert overall(["holds", "holds", "holds", "fails"]) == "depends on the scene"
    assert overall(["holds", "undecided"]) == "undecided"
    assert overall(["fails", "fails", "undecided"]) == "fails"
    assert overall([]) == overall([], needs_all=True) == "undecided"


def test_false_alarms_are_as_often_as_stated():
    """Where nothing changes, "helps" holds in 9.2 % of cases: Student's t, 2 degrees of freedom, beyond 2."""
    draws = np.random.default_rng(0).normal(size=(4_000, 3)).tolist()
    found = [verdict(each, 0, math.inf) for each in draws]
    # Four deviations of a share of 0.0918 among 4,000 are 0.018: left by chance once in 15,000.
    assert found.count("holds") / 4_000 == pytest.approx(0.0918, abs=0.018)
    assert found.count("fails") / 4_000 == pytest.approx(0.0918, abs=0.018)
    # Of seven scenes four or more must hold and none fail: sum of C(7, k) p^k (1 - 2 p)^(7 - k) = 0.0014. Of 571 groups
    # 0.8 are expected, and 8 or more are there once in 1e5.
    scenes = [overall(found[i : i + 7]) for i in range(0, 3_994, 7)]
    assert len(scenes) == 571
    assert scenes.count("holds") < 8


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
        with pytest.raises(ValueError, match=r"holds trainings with the options {'downscale': 4.0}, not .*--out"):
            rows_of(grid(**other))


# The tables


@pytest.fixture
def kept(tmp_path):
    """Dropout helps on one scene, harms on another, and there is one seed of the third."""
    figures = {"a": [(20.0, 21.0), (20.2, 21.1), (19.9, 21.0)], "b": [(20.0, 19.0), (20.2, 19.1)], "c": [(20.0, 20.5)]}
    for scene, pairs in figures.items():
        rows = Rows(tmp_path / f"{scene}.json", {"scene": scene})
        for seed, (plain, dropout) in enumerate(pairs):
            rows.add(row(plain, seed))
            rows.add(row(dropout, seed, ca=2e-3, regularizer="dropout(0.2)"))
    return Kept(tmp_path)


def test_claims_are_judged_scene_by_scene(kept):
    assert judged(CLAIMS["1"], kept) == {"a": (3, "holds"), "b": (2, "fails"), "c": (1, "undecided")}
    assert judged(CLAIMS["2"], kept) == {}
    lines = {line.split(" | ")[0].strip("| "): line for line in claims_table(kept).splitlines()[2:]}
    assert lines["1"].endswith("| depends on the scene | holds: a (3); fails: b (2); undecided: c (1) |")
    assert lines["2"].endswith("| not yet measured | - |")
    assert "systems" not in lines


def test_gains_are_in_the_order_of_their_mean_and_those_that_lack_a_scene_are_last(kept):
    for seed, of in kept.scenes["a"].of(resolved({}, "3dgs", 3_000)).items():
        kept.scenes["a"].add(row(of["test"]["psnr"] + 7.0, seed, regularizer="dropout(0.3)"))
        for name, gain in (("a", 1.5), ("b", 0.5)):
            kept.scenes[name].add(row(20.0 + gain, seed, ca=4e-3, regularizer="dropout(0.1)"))
    lines = gains("7", Kept(kept.folder)).splitlines()
    assert lines[0] == "| setting | mean | a | b |"  # of c there is one seed
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| `dropout(0.1)`", "| `dropout(0.2)`", "| `dropout(0.3)`"]
    # 1.0, 0.9, 1.1 and -1.0, -1.1: their means, and two standard errors
    assert lines[3] == "| `dropout(0.2)` | -0.02 dB | +1.00 ± 0.12 dB | -1.05 ± 0.10 dB |"
    assert lines[4].endswith("| +7.00 dB | +7.00 ± 0.00 dB | n/a |")
    assert gains("11", Kept(kept.folder)) == ""


def test_the_table_of_scenes_pools_what_seeds_differ_by_over_settings_and_pairs(tmp_path):
    """Values with a variance of 1, 4 and 1 in each setting; of their differences, 1, 0 and 1."""
    rows = Rows(tmp_path / "a.json")
    for name, psnrs in (("dropout(0.1)", (1, 2, 3)), ("dropout(0.2)", (12, 14, 16)), ("noise(0.8)", (7, 8, 9))):
        for seed, found in enumerate(psnrs):
            rows.add(row(found, seed, regularizer=name))
    rows.add(row(99.0, regularizer="density"))  # of one seed nothing is known
    Rows(tmp_path / "b.json").add(row(20.0))
    lines = scenes_table(Kept(tmp_path)).splitlines()
    one, two = math.sqrt(6 / 3), math.sqrt(2 / 3)
    assert lines[2] == f"| a | 10 | 0.2 | {one:.2f} dB | {two:.2f} dB | {math.ceil(400 * 2 / 3)} |"
    assert lines[3] == "| b | 1 | 0.0 | n/a | n/a | n/a |"


def test_details_show_what_is_measured_and_every_check(kept):
    text = details("1", kept)
    assert "| plain | 3 | 20.03 ± 0.15 | 5 ± 0 | 1 ± 0 |" in text  # no SSIM, which no row has, no seconds
    assert "- `dropout(0.2) - plain`, PSNR: +1 ± 0.12 (claimed: above 0), holds" in text
    assert "- `dropout(0.2) - plain`, CA: -3 ± 0 (claimed: below 0), holds" in text
    assert "PSNR: +0.5 (claimed: above 0), undecided" in text
    assert details("9", kept).count("renders") == 0
    assert details("16", kept) == details("1", Kept(kept.folder, "inria")) == ""


def test_a_declared_scene_counts_only_where_a_claim_names_it(kept, monkeypatch):
    for name in ("fern", "lego"):
        (kept.folder / f"{name}.json").write_text((kept.folder / "a.json").read_text())
    kept, tested = Kept(kept.folder), dataclasses.replace(CLAIMS["1"], scenes=("fern",))
    monkeypatch.setitem(CLAIMS, "1", tested)
    assert judged(tested, kept).keys() == {"fern", "a", "b", "c"}
    assert re.findall(r"^\*\*(.*)\*\*:", details("1", kept), re.MULTILINE) == ["a", "b", "c", "fern"]
    assert gains("1", kept).splitlines()[0] == "| setting | mean | a | b | fern |"


def test_a_relative_check_divides_by_the_other_figure(kept):
    claim = Claim("", "", (), (Check("test psnr", {"regularizer": "dropout(0.2)"}, {}, -0.04, 0.04, relative=True),))
    assert judged(claim, kept)["b"] == (2, "fails")  # -5 and -5.4 %
    assert judged(claim, kept)["a"] == (3, "fails")


def test_pages_are_made_again_between_their_marks(kept):
    text = "before\n<!-- paper claims -->\nstale words\n<!-- end -->\nafter\n<!-- paper details -->\n<!-- end -->\n"
    made = page(text, kept)
    assert made == page(made, kept)
    assert made.startswith("before\n<!-- paper claims -->\n|  | claim |")
    assert details("1", kept) in made
    # Half of their settings at most, or no path.
    assert "\nNot yet measured after 3,000 steps: 2, 3, 4, 5, 7, 8, 9, 10, 11, 14, 15, 16, 17" in made
    assert "stale" not in made


def test_a_mark_names_one_comparison_and_its_iterations(kept):
    text = "<!-- paper details 1 100 -->\n<!-- end -->\n"
    rows = Rows(kept.folder / "a.json")
    for setting in CLAIMS["1"].settings:
        rows.add({**row(25.0), "setting": resolved(setting, "3dgs", 100)})
    assert page(text, kept).count("| 1 | 25 |") == 2
    assert "Not yet measured." in page(text.replace("100", "50"), kept)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were drawn."""
    figures = []

    @contextmanager
    def held(path):
        with new_figure(path) as figure:
            yield figure
        figures.append(figure)

    monkeypatch.setattr(figure_module, "new_figure", held)
    return figures


def test_the_figure_draws_means_of_differences_where_three_places_are_kept(kept, drawn):
    gained = [0.5, 0.4, 0.9]
    with pytest.raises(ValueError, match="no line to draw"):
        gains_figure(kept, kept.folder / "gains.png")
    rows = Rows(kept.folder / "a.json")
    for seed, plain in enumerate((20.0, 20.2, 19.9)):
        rows.add(row(plain + gained[seed], seed, regularizer="dropout(0.1)"))
    gains_figure(Kept(kept.folder), kept.folder / "gains.png")
    assert [len(panel.containers) for panel in drawn[0].axes] == [1, 0]  # other scenes and axes have two places at most
    (bars,) = drawn[0].axes[0].containers
    line, _, (errors,) = bars
    assert bars.get_label() == "a"
    assert np.allclose(line.get_xydata(), [(0.0, 0.0), (0.1, np.mean(gained)), (0.2, 1.0)])
    assert np.allclose(np.ptp(errors.get_segments()[1], 0), (0.0, 4 * np.std(gained, ddof=1) / math.sqrt(3)))
    assert (kept.folder / "gains.png").stat().st_size > 1_000


def test_the_ranking_draws_the_best_setting_first_and_the_score_beside_it(kept, drawn):
    with pytest.raises(ValueError, match="claim 11: nothing to rank"):
        ranking_figure(kept, ["7", "11"], kept.folder / "ranking.png")
    rows = Rows(kept.folder / "a.json")
    for seed, of in rows.of(resolved({}, "3dgs", 3_000)).items():
        better = row(of["test"]["psnr"] + 3.0 + seed, seed, regularizer="dropout(0.3)")
        for each, score in ((of, 8e-3), (better, 2e-3)):
            rows.add(each | {"test": each["test"] | {"ca_exact_half": score}})
    ranking_figure(Kept(kept.folder), ["7"], kept.folder / "ranking.png")
    gained, score = drawn[0].axes
    assert [tick.get_text() for tick in gained.get_yticklabels()] == ["dropout(0.2)", "dropout(0.3)"]  # 0.3 lacks b
    assert [bars.get_label() for bars in gained.containers] == ["a", "b"]
    on_a, on_b = (bars[0].get_xydata() for bars in gained.containers)
    assert np.allclose(on_a[:, 0], (1.0, 4.0))
    assert np.allclose(on_b[:, 0], -1.05)
    assert gained.yaxis_inverted()
    assert list(on_a[:, 1] // 0.5) == [-1, 1]  # above the middles of their rows, 0 and 1
    (errors,) = gained.containers[0][2]
    assert np.allclose(np.ptp(errors.get_segments()[1], 0), (4 / math.sqrt(3), 0.0))  # 3, 4 and 5 dB
    assert np.allclose(score.lines[0].get_xdata(), (math.nan, -75.0), equal_nan=True)


@pytest.mark.parametrize("path", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.name)
def test_the_pages_show_what_is_kept(path):
    assert page(path.read_text("utf-8"), Kept(ROOT / "docs" / "data" / "paper")) == path.read_text("utf-8")


# What is measured of a model


def few():
    """Three Gaussians at random, and a model of them that was trained with dropout, in float64."""
    s = random_scene(3, 16, 12, seed=1, size=0.4)
    colors = ((s.colors - 0.5) / SH_C0)[:, None]
    parts = s.means, s.scales.log(), s.quaternions, torch.logit(s.opacities), colors, torch.zeros(3, 0, 3)
    return s, TrainedModel(Gaussians(*parts).map(torch.Tensor.double), torch.zeros(3).double(), "dropout(0.2)")


def test_the_mean_of_all_masks_is_what_the_exact_render_is():
    """Three Gaussians, eight masks: the PSNR of D is that of the enumerated mean."""
    s, model = few()
    mean = 0
    for mask in itertools.product([0.0, 1.0], repeat=3):
        kept = torch.tensor(mask, dtype=torch.float64)
        parts = (x.double() for x in (s.means, s.quaternions, s.scales, s.opacities * kept, s.colors))
        camera = s.camera.to(dtype=torch.float64)
        image = brute_force(*parts, camera)[0]
        mean = mean + image * math.prod(0.8 if x else 0.2 for x in mask)
    photograph = torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    view = View("v", camera, photograph)
    found = renders(model, view, 0, draws=400)
    assert found["mean"] == pytest.approx(psnr(mean.clamp(0, 1), photograph), rel=1e-5)
    # 400 draws: the mean image errs by a twentieth of the deviation of one, and its PSNR by hundredths of a decibel.
    assert found["five"] == pytest.approx(found["mean"], abs=0.1)
    assert found["one"] < found["five"]
    scaled = brute_force(*(x.double() for x in (s.means, s.quaternions, s.scales, 0.8 * s.opacities, s.colors)), camera)
    assert found["scaled"] == pytest.approx(psnr(scaled[0].clamp(0, 1), photograph), rel=1e-5)


def test_the_renders_of_a_model_of_noise():
    """Its mean opacities are those of the module with ``scale``; its exact mean is that of many draws."""
    s, model = few()
    photograph = torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    view = View("v", s.camera.to(dtype=torch.float64), photograph)
    found = renders(dataclasses.replace(model, regularizer="noise(0.8)"), view, 0, draws=400)
    assert found["five"] == pytest.approx(found["mean"], abs=0.1)  # as above
    test = dataclasses.replace(model, regularizer="noise(0.8, scale=True)").test_rendering(view)
    assert found["scaled"] == pytest.approx(psnr(test.image.clamp(0, 1), photograph), rel=1e-5)


def test_depth_is_compared_with_another_model_where_that_is_opaque_and_the_mask_counts():
    s, model = few()
    view = View("v", s.camera.to(dtype=torch.float64), torch.zeros(3, 12, 16, dtype=torch.float64))
    dense = dataclasses.replace(
        model,
        gaussians=dataclasses.replace(model.gaussians, opacity_logits=torch.full((3,), 4.0).double()),
        regularizer="",
    )
    assert depths(dense, view, dense) == {"abs_rel": 0, "rmse": 0, "mae": 0, "log10": 0}
    one, truth = (x.test_rendering(view, depth=True) for x in (model, dense))
    opaque = truth.alpha > 0.8
    assert 0.05 < opaque.double().mean() < 0.95
    mask = torch.zeros(12, 16)
    mask[:, 6:] = 1
    for chosen_mask, counts in ((None, opaque), (mask, opaque & (mask == 1))):
        d, t = ((x.depth / x.alpha.clamp_min(1e-6))[counts] for x in (one, truth))
        found = depths(model, dataclasses.replace(view, mask=chosen_mask), dense)
        assert found["mae"] == pytest.approx((d - t).abs().mean().item())
        assert found["abs_rel"] == pytest.approx(((d - t).abs() / t).mean().item())


# Runs


@pytest.mark.slow
def test_two_claims_on_the_built_in_scene(tmp_path, monkeypatch, capsys):
    """Twenty iterations, two seeds; interrupted after three trainings, the same call does the others."""
    scenes = chosen_scenes([], tmp_path, SceneOptions("synthetic", downscale=5))
    grid = Grid(chosen(["1", "5", "9", "14"], [*scenes]), scenes, "3dgs", 20, 2, tmp_path / "out", tmp_path / "rows")
    running, trained = Running(Here()), []

    def train(*arguments):
        if len(trained) == 3:
            raise KeyboardInterrupt
        trained.append(arguments[1])
        return original(*arguments)

    original = grid_module.train_run
    with monkeypatch.context() as patch:
        patch.setattr(grid_module, "train_run", train)
        with pytest.raises(KeyboardInterrupt):
            run_cells(grid, running)
    first = Rows(tmp_path / "rows" / "synthetic.json").rows
    assert len(first) == 3
    assert [each["seed"] for each in first] == [0, 0, 0]  # one seed of everything
    failed = run_cells(grid, running)
    assert not failed
    rows = Rows(tmp_path / "rows" / "synthetic.json").rows
    assert rows[:3] == first  # not trained again
    assert len(rows) == len(declared(grid)) == 6
    assert all(is_done(cell, rows_of(grid)) for cell in declared(grid))
    assert not list((tmp_path / "out" / "synthetic").glob("*/seed_*"))
    assert all(len(json.dumps(each)) < 1_500 for each in rows)
    assert all(0 < value(each, "depth abs_rel") < 2 and list(each["path"]) == list("123456") for each in rows)
    assert [math.isfinite(value(each, "renders five")) for each in rows] == [False, True, False] * 2
    kept = Kept(tmp_path / "rows", "3dgs", 20)
    assert judged(CLAIMS["9"], kept).keys() == judged(CLAIMS["14"], kept).keys() == {"synthetic"}
    nothing = Here()
    run_cells(grid, Running(nothing))
    assert not nothing.tasks


def test_a_training_that_fails_stops_no_other(tmp_path, monkeypatch):
    scenes = chosen_scenes([], tmp_path, SceneOptions("synthetic", downscale=8))
    grid = Grid(chosen(["1"], [*scenes]), scenes, "3dgs", 20, 1, tmp_path / "out", tmp_path / "rows")

    def train(options, config, out, *_):
        if config.regularizer:
            raise ValueError("no luck")
        out.mkdir(parents=True, exist_ok=True)
        return {"mean": {"test": {"psnr": 20.123456789}}, "gaussians": 7, "processor_seconds": 1.0, "seconds": 1.0,
                "machine": {"ca_reg": "0", "cpu": "one"}}  # fmt: skip

    monkeypatch.setattr(grid_module, "train_run", train)
    failed = run_cells(grid, Running(Here()))
    assert [type(why) for why in failed.values()] == [Failure]
    assert list(failed) == ["synthetic, 3dgs, dropout(0.2), seed 0"]
    (only,) = Rows(tmp_path / "rows" / "synthetic.json").rows
    assert only["test"] == {"psnr": 20.1235}


@pytest.mark.slow
@pytest.mark.data
def test_where_depth_is_not_known_a_model_of_all_photographs_comes_first(data_root, tmp_path, monkeypatch):
    grid = Grid(chosen(["14"]), chosen_scenes(["fern"], data_root, SceneOptions("")), "3dgs", 20, 1, tmp_path, tmp_path)
    trained, against = [], []

    def train(options, config, out, *_):
        trained.append((out.relative_to(tmp_path.resolve()).parts, options.test, config.iterations))
        return {"mean": {"test": {"psnr": 20.0}}, "seconds": 1.0}

    def measured(cell, run, results, dense, device):
        against.append(dense)
        return {"setting": dict(cell.setting), "seed": cell.seed, "depth": {}}

    monkeypatch.setattr(grid_module, "train_run", train)
    monkeypatch.setattr(cells_module, "measured", measured)
    assert run_cells(grid, Running(Here())) == {}
    first, *others = trained
    assert first == (("fern", "dense"), "none", 40)
    assert [where[1] for where, *_ in others] == ["3dgs", "3dgs_dropout_0.2", "3dgs_noise_0.8"]
    assert {(test, steps) for _, test, steps in others} == {("auto", 20)}
    assert set(against) == {tmp_path / "fern" / "dense"}
    assert len(Rows(tmp_path / "fern.json").rows) == 3
