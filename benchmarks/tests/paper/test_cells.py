"""The grid of the paper's claims: what it declares, what is measured of a model, and a run of seconds."""

import dataclasses
import itertools
import json
import math
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
import torch
from oracles import brute_force, random_scene
from stand_ins.executor import Here

from benchmarks.paper import cells as cells_module
from benchmarks.paper.__main__ import main
from benchmarks.paper.cells import Grid, declared, depths, is_done, renders, rows_of, run_cells
from benchmarks.paper.claims import CLAIMS, chosen
from benchmarks.paper.comparison import RowStore, judged
from benchmarks.paper.rows import Rows, config_of, resolved, value
from benchmarks.paper.scenes import PAPER_SIZE, SCENES, chosen_scenes
from ca_reg.regularizers import REGULARIZERS
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.runs import grid as grid_module
from reference_trainer.runs.executors import Failure
from reference_trainer.runs.grid import Running
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.training.assembly import check

EVERY = SCENES | PAPER_SIZE
ALL = Grid(CLAIMS, EVERY)
"""Everything."""


# The grid


def test_a_row_names_the_commit_of_this_checkout():
    root = Path(__file__).parents[3]
    if not (root / ".git").exists():
        pytest.skip("needs a checkout")
    head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    commit = cells_module.commit()
    assert commit is not None
    assert head.stdout.startswith(commit.removesuffix("-dirty"))


def test_every_training_is_declared_once_and_covers_its_claims():
    cells = declared(ALL)
    assert len({json.dumps([cell.scene, cell.setting, cell.seed], sort_keys=True) for cell in cells}) == len(cells)
    assert len({cells_module.folder_of(ALL, cell) for cell in cells}) == len(cells)
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
    for cell in declared(Grid(CLAIMS, EVERY, seeds=1)):
        config = config_of(cell.setting, cell.seed)
        check(config)
        assert config.iterations == 3_000
        options = EVERY[cell.scene].options_for(cell.setting, config.loss)
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
        loaded = load_scene(scene.options)
        widths[name] = loaded.train[0].camera.width
        views[name] = len(loaded.train), len(loaded.test)
        seen = loaded.points.seen_by or frozenset()
        assert not seen & {view.name for view in loaded.test}
        assert (loaded.test[0].mask is not None) == (name in ("dtu-scan65", "dtu-scan65-400", "cape"))
    assert views == {
        "synthetic": (3, 3), "fern": (3, 3), "lego": (8, 25), "dtu-scan65": (3, 25), "dtu-scan24": (3, 25),
        "fountain": (3, 2), "herz-jesu": (3, 2), "sceaux": (3, 4), "cape": (3, 8),
        "fern-504": (3, 3), "lego-400": (8, 25), "dtu-scan65-400": (3, 25), "dtu-scan24-384": (3, 25),
    }  # fmt: skip
    assert widths.pop("synthetic") == 160
    assert all(width == int(name.rpartition("-")[2]) for name, width in widths.items() if name in PAPER_SIZE)
    assert all(252 <= width <= 400 for name, width in widths.items() if name not in PAPER_SIZE)


def test_unknown_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no claim 18; .*1, 2"):
        chosen(["1", "18"])
    with pytest.raises(ValueError, match=r"scene garden; .*fern"):
        chosen_scenes(["garden"], tmp_path, SceneOptions(""))
    with pytest.raises(ValueError, match="--path, not both"):
        chosen_scenes(["fern"], tmp_path, SceneOptions("mine"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--list", "--images", "images_8"], "options of a scene apply to one of your own"),
        (["--path", "synthetic", "--seeds", "0"], "at least 1 seed, got 0"),
    ],
)
def test_mistakes_are_refused_in_one_line(arguments, expected, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert expected in capsys.readouterr().err


def test_one_claim_on_a_scene_of_ones_own(tmp_path, capsys):
    main(["--claims", "1", "7", "--path", str(tmp_path / "mine"), "--images", "small", "--seeds", "2",
          "--iterations", "1000", "--out", str(tmp_path), "--list"])  # fmt: skip
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "mine, 3dgs, seed 0: 1 min"
    assert lines[1].startswith("mine, 3dgs, dropout(0.2), seed 0: ")
    assert lines[-1].startswith("all: 14 trainings, 14 left: ")


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
    assert all({*map(len, each["course"].values())} == {6} for each in rows)
    assert all(math.isfinite(value(each, f"course psnr/train {sixth}")) for each in rows for sixth in range(1, 7))
    assert [math.isfinite(value(each, "renders five")) for each in rows] == [False, True, False] * 2
    kept = RowStore(tmp_path / "rows", "3dgs", 20)
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


def test_a_training_that_is_made_again_for_another_claim_is_measured_for_the_first_one_as_well(tmp_path, monkeypatch):
    scenes = chosen_scenes([], tmp_path, SceneOptions("synthetic", downscale=8))
    made = []

    def measured(cell, *_):
        made.append((cell.name, cell.needs))
        return {"setting": dict(cell.setting), "seed": cell.seed} | {need: {} for need in cell.needs}

    monkeypatch.setattr(grid_module, "train_run", lambda *_: {"mean": {"test": {"psnr": 20.0}}, "seconds": 1.0})
    monkeypatch.setattr(cells_module, "measured", measured)
    for claim in ("5", "9"):
        claims = chosen([claim], [*scenes])
        assert not run_cells(Grid(claims, scenes, "3dgs", 20, 1, tmp_path / "out", tmp_path / "rows"), Running(Here()))
    assert len(made) == 4
    assert made[3] == ("synthetic, 3dgs, dropout(0.2), seed 0", {"path", "renders"})


def test_seeds_beyond_three_are_only_for_what_three_leave_undecided(tmp_path, monkeypatch):
    """Claim 11 asks for differences below 0.2 dB: degree 0 has none, those of 1 and 2 lie at the limit."""
    scenes = chosen_scenes([], tmp_path, SceneOptions("synthetic", downscale=8))
    grid = Grid(chosen(["11"], [*scenes]), scenes, "3dgs", 20, 8, tmp_path / "out", tmp_path / "rows", sequential=True)
    apart = {0: [0.0] * 8, 1: [0.1, 0.2, 0.3] * 3, 2: [0.1, 0.2, 0.3] * 3, None: [0.0] * 8}

    def measured(cell, *_):
        gain = apart[cell.setting.get("sh_degree")][cell.seed]
        return {"setting": dict(cell.setting), "seed": cell.seed, "test": {"psnr": 20.0 + gain}}

    monkeypatch.setattr(grid_module, "train_run", lambda *_: {"mean": {"test": {"psnr": 20.0}}, "seconds": 1.0})
    monkeypatch.setattr(cells_module, "measured", measured)

    def seeds():
        return dict(Counter(row["setting"].get("sh_degree") for row in rows_of(grid)["synthetic"].rows))

    assert len(declared(grid)) == 4 * 3 + 4 * 5  # of what is not trained nothing is decided
    assert run_cells(grid, Running(Here())) == {}
    assert seeds() == {0: 3, 1: 8, 2: 8, None: 8}
    assert all(is_done(cell, rows_of(grid)) for cell in declared(grid))
    shutil.rmtree(tmp_path / "rows")
    apart[2] = [1.0] * 8  # one check fails, and with it the claim
    assert run_cells(grid, Running(Here())) == {}
    assert seeds() == {0: 3, 1: 3, 2: 3, None: 3}


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
